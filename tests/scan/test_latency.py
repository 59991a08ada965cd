"""The lag between what the image and the tracker saw."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from sonosweep.errors import ScanError
from sonosweep.geometry import invert_pose, pose_from_parts
from sonosweep.io.sequence import read_sequence
from sonosweep.scan.latency import estimate_lag, estimate_latency
from sonosweep.scan.motion_signal import image_motion_signal, tracker_motion_signal

# Straight lines between samples 20 ms apart, of a movement with a period of 1.3 s.
INTERPOLATION_S = 1e-3
HALF_PIXEL = 0.5


def movement(times_s):
    """The position (mm) of a hand that moves up and down, never twice the same."""
    t = torch.as_tensor(times_s, dtype=torch.float64)
    faster_and_faster = torch.sin(2 * (t - 100) + 0.15 * (t - 100) ** 2)
    return 5 * torch.sin(2 * math.pi * t / 1.3) + 8 * faster_and_faster


def frame_times(generator, count=200):
    """About 12 frames per second, unevenly."""
    gaps = 0.085 + 0.01 * torch.rand(count, generator=generator, dtype=torch.float64)
    return 100 + gaps.cumsum(0)


def samples_at(frame_times_s):
    """50 tracker samples per second, from 3 s before the frames to 3 s after."""
    return torch.arange(97, float(frame_times_s[-1]) + 3, 0.02, dtype=torch.float64)


def line_frames(depths_px, rows=120, columns=90, tilt=0.1, seed=0):
    """Frames of noise with one slanting bright line, whose depth in the middle is given."""
    generator = np.random.default_rng(seed)
    row, column = np.arange(rows)[:, None], np.arange(columns)
    stack = []
    for depth in np.asarray(depths_px):
        line = 200 * np.exp(-0.5 * ((row - depth - tilt * (column - (columns - 1) / 2)) / 1.5) ** 2)
        stack.append((line + generator.integers(0, 20, line.shape)).astype(np.uint8))
    return np.stack(stack)


@given(st.integers(0, 1000), st.floats(-1.0, 1.0), st.sampled_from([-3.0, 0.5]))
@settings(max_examples=20)
def test_the_lag_of_a_delayed_signal_is_the_delay(seed, lag_s, gain):
    """A signal that shows now what the other showed lag_s ago is lag_s late, either sign."""
    times = frame_times(torch.Generator().manual_seed(seed))
    samples = samples_at(times)

    found = estimate_lag(gain * movement(times - lag_s) + 7, times, movement(samples), samples)

    assert found.lag_s == pytest.approx(lag_s, abs=INTERPOLATION_S)
    assert found.correlation == pytest.approx(math.copysign(1, gain), abs=1e-3)
    assert found.half_lags_s == pytest.approx((lag_s, lag_s), abs=3 * INTERPOLATION_S)
    assert found.uncertainty_s < INTERPOLATION_S
    assert abs(found.runner_up_correlation) < 0.99
    assert found.samples == len(times)


@given(st.floats(-0.8, 0.8))
@settings(max_examples=10)
def test_exchanging_the_signals_turns_the_lag_round(lag_s):
    """If the first is late against the second, the second is early against the first."""
    times = frame_times(torch.Generator().manual_seed(1))
    samples = samples_at(times)
    a, b = movement(times - lag_s), movement(samples)

    forth, back = estimate_lag(a, times, b, samples), estimate_lag(b, samples, a, times)

    assert back.lag_s == pytest.approx(-forth.lag_s, abs=1e-6)


def test_noise_makes_the_lag_uncertain():
    """The stated uncertainty of a noisy signal is of the size of its error."""
    generator = torch.Generator().manual_seed(3)
    times = frame_times(generator)
    samples = samples_at(times)
    errors, stated = [], []
    for _ in range(40):
        noise = 4 * torch.randn(len(times), generator=generator, dtype=torch.float64)
        found = estimate_lag(movement(times - 0.06) + noise, times, movement(samples), samples)
        errors.append(found.lag_s - 0.06)
        stated.append(found.uncertainty_s)

    # Forty draws know a standard deviation to about a tenth.
    assert 0.7 < np.mean(stated) / np.sqrt(np.mean(np.square(errors))) < 1.4


def test_a_movement_that_repeats_itself_is_ambiguous():
    """After a period of a pure sine the correlation is as high again, and it is said."""
    times = frame_times(torch.Generator().manual_seed(4))
    samples = samples_at(times)

    found = estimate_lag(
        torch.sin(2 * math.pi * times / 1.3), times, torch.sin(2 * math.pi * samples / 1.3), samples
    )

    assert abs(found.runner_up_correlation) == pytest.approx(1, abs=0.01)


def test_a_known_sign_decides():
    """Half a period apart a sine looks like its mirror image; the sign tells them apart."""
    times = frame_times(torch.Generator().manual_seed(5))
    samples = samples_at(times)
    a = torch.sin(2 * math.pi * times / 1.3)
    b = torch.sin(2 * math.pi * samples / 1.3)

    rising = estimate_lag(a, times, b, samples, max_lag_s=0.5, sign=1)
    falling = estimate_lag(a, times, b, samples, max_lag_s=0.9, sign=-1)

    assert rising.lag_s == pytest.approx(0, abs=INTERPOLATION_S)
    assert abs(falling.lag_s) == pytest.approx(0.65, abs=3 * INTERPOLATION_S)
    assert falling.correlation < -0.99


@given(st.integers(0, 100), st.floats(20, 90))
@settings(max_examples=20)
def test_the_line_is_found_between_the_pixels(seed, depth):
    """The depth of a slanting line in the middle column is known to a fraction of a pixel."""
    found = image_motion_signal(line_frames([depth, depth], seed=seed))

    torch.testing.assert_close(
        found, torch.full((2,), depth, dtype=torch.float64), atol=HALF_PIXEL, rtol=0
    )


def test_a_second_echo_does_not_pull_the_line():
    """A bright reverberation in a third of the columns leaves the line where it is."""
    frames = line_frames([40.0, 41.0, 42.0])
    frames[:, 100:104, 60:] = 250

    found = image_motion_signal(frames)

    torch.testing.assert_close(found.diff(), torch.ones(2).double(), atol=HALF_PIXEL, rtol=0)


def test_frames_without_a_line():
    """Black frames and noise have no line; a line among them is still found."""
    noise = np.random.default_rng(0).integers(0, 255, (1, 120, 90)).astype(np.uint8)
    frames = np.concatenate((line_frames([50.0]), noise, np.zeros((1, 120, 90), np.uint8)))

    assert torch.isnan(image_motion_signal(frames)).tolist() == [False, True, True]
    assert bool(torch.isnan(image_motion_signal(frames[2:])).all())


def test_the_tracker_signal_is_the_way_along_the_main_direction():
    """A probe that goes 3 mm along y and a little aside has moved 3 mm."""
    shift = torch.zeros(4, 3, dtype=torch.float64)
    shift[:, 1] = torch.tensor([0.0, 1, 2, 3])
    poses = pose_from_parts(torch.eye(3, dtype=torch.float64).expand(4, 3, 3), shift)

    assert tracker_motion_signal(poses).tolist() == pytest.approx([-1.5, -0.5, 0.5, 1.5])


@pytest.mark.parametrize("lag_s", [-0.2, 0.15])
def test_latency_of_a_simulated_water_tank(lag_s):
    """Images of a line that moves as the tracked probe did lag_s ago are lag_s late."""
    times = frame_times(torch.Generator().manual_seed(6), count=120)
    samples = samples_at(times)
    shift = torch.zeros(len(samples), 3, dtype=torch.float64)
    shift[:, 2] = movement(samples)
    poses = pose_from_parts(torch.eye(3, dtype=torch.float64).expand(len(samples), 3, 3), shift)
    poses[::17] = math.nan
    frames = line_frames(60 - 2 * movement(times - lag_s))

    found = estimate_latency(frames, times, poses, samples)

    assert found.lag_s == pytest.approx(lag_s, abs=3 * INTERPOLATION_S)
    assert found.correlation < -0.99


def test_what_cannot_be_compared():
    """Signals that are short, constant, elsewhere in time or without line are refused."""
    times = frame_times(torch.Generator().manual_seed(7))
    signal = movement(times)
    poses = pose_from_parts(
        torch.eye(3, dtype=torch.float64).expand(len(times), 3, 3), signal[:, None] * torch.ones(3)
    )

    with pytest.raises(ScanError, match="19 samples; a lag needs 20"):
        estimate_lag(signal[:19], times[:19], signal, times)
    with pytest.raises(ScanError, match="does not change"):
        estimate_lag(torch.ones_like(signal), times, signal, times)
    with pytest.raises(ScanError, match="must increase"):
        estimate_lag(signal, times.flip(0), signal, times)
    with pytest.raises(ScanError, match="not numbers"):
        estimate_lag(signal * math.nan, times, signal, times)
    with pytest.raises(ScanError, match=r"overlap too little within 2 s of lag: .* second 1100.0"):
        estimate_lag(signal, times, signal, times + 1000)
    with pytest.raises(ScanError, match="one clock"):
        estimate_latency(line_frames(signal + 60), times, poses, times + 1000)
    with pytest.raises(ScanError, match="0 of 200 frames show a bright line"):
        estimate_latency(np.zeros((200, 20, 20), np.uint8), times, poses, times)
    with pytest.raises(ScanError, match="does not move"):
        tracker_motion_signal(poses[[0, 0]])


def test_water_tank_recording(recordings):
    """The video lags the tracker by some 60 ms, and both halves of the recording agree."""
    folder = recordings / "plus_watertank_temporal"
    video = read_sequence(folder / "WaterTankBottomTranslationVideoBuffer.igs.mha")
    tracker = read_sequence(folder / "WaterTankBottomTranslationTrackerBuffer.igs.mha")
    poses = {pair: t.matrices for pair, t in tracker.transforms.items()}

    found = estimate_latency(
        video.frames,
        video.timestamps_s,
        invert_pose(poses["Reference", "Tracker"]) @ poses["Probe", "Tracker"],
        tracker.timestamps_s,
    )

    assert abs(found.correlation) > 0.97
    assert abs(found.half_lags_s[0] - found.half_lags_s[1]) < 0.01
    assert found.uncertainty_s < 0.01
    # The frames are 85 ms apart, and a scanner cannot show an echo before it came back.
    assert 0 < found.lag_s < 0.085
    # Any other lag fits clearly worse.
    assert abs(found.runner_up_correlation) < abs(found.correlation) - 0.03
