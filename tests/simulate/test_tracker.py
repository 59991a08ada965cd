"""A tracker's reports: noisy, late, at its own times, with holes; and matched to frames."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sonosweep.errors import ScanError
from sonosweep.simulate.motion import MotionSettings, draw_motion
from sonosweep.simulate.seeds import generator
from sonosweep.simulate.tracker import (
    ELECTROMAGNETIC,
    OPTICAL,
    TrackerSettings,
    record_poses,
    track_frames,
)
from tests.simulate.motion_bodies import arm

MOTION = draw_motion(
    MotionSettings(frames=400, length_mm=90.0, excursion_mm=4.0, tremor_mm=0.0),
    arm(),
    generator(900_000, 0, "motion"),
)
TRUE = MOTION.poses_at(MOTION.frame_times_s())
PERFECT = TrackerSettings(position_noise_mm=0.0, rotation_noise_deg=0.0)
# Between samples 1/60 s apart a hand leaves a straight line by less than this; most where it
# starts and stops with the sweep.
INTERPOLATION_MM = 0.03


def track(settings: TrackerSettings) -> tuple[np.ndarray, np.ndarray]:
    """Return the tracked poses of the sweep's frames and which frames have one."""
    return track_frames(
        MOTION.poses_at, MOTION.frame_times_s(), settings, generator(900_000, 0, "tracker")
    )


def distances_mm(tracked: np.ndarray) -> np.ndarray:
    """Return how far the tracked middle of the face is from the true one."""
    return np.linalg.norm(tracked[:, :3, 3] - TRUE[:, :3, 3], axis=1)


def test_a_perfect_tracker_tells_the_truth():
    """What is left is interpolation between its samples."""
    poses, tracked = track(PERFECT)

    assert tracked.all()
    assert distances_mm(poses).max() < INTERPOLATION_MM


def test_a_known_latency_does_not_matter():
    """The tracker's clock is behind, and matching knows by how much."""
    poses, tracked = track(replace(PERFECT, latency_s=0.12))

    assert tracked.all()
    assert distances_mm(poses).max() < INTERPOLATION_MM


def test_the_stream_runs_on_its_own_clock():
    """A pose stamped t shows the probe at t + latency, 60 times per second."""
    settings = replace(PERFECT, latency_s=0.2)
    duration_s = MOTION.settings.duration_s
    stream = record_poses(MOTION.poses_at, duration_s, settings, generator(900_000, 0, "tracker"))

    assert np.allclose(np.diff(stream.times_s), 1 / 60, rtol=0, atol=1e-9)
    assert stream.times_s[0] < -0.2 < duration_s - 0.2 < stream.times_s[-1]
    assert np.abs(stream.plane_to_body - MOTION.poses_at(stream.times_s + 0.2)).max() < 1e-9


def test_noise_is_as_large_as_said():
    """Position noise of the sensor reaches the image, and so do turns by their lever."""
    stream = record_poses(
        MOTION.poses_at,
        400.0,
        TrackerSettings(position_noise_mm=0.2, rotation_noise_deg=0.1, sensor_above_face_mm=100.0),
        generator(900_000, 0, "tracker"),
    )
    true = MOTION.poses_at(stream.times_s)
    error = np.linalg.inv(true) @ stream.plane_to_body
    turns = np.rad2deg(Rotation.from_matrix(error[:, :3, :3]).as_rotvec())

    # 24,000 samples give standard deviations to 1 %.
    assert turns.std(axis=0) == pytest.approx([0.1] * 3, rel=0.03)
    lever = np.deg2rad(0.1) * 100.0
    wanted = [np.hypot(0.2, lever), 0.2, np.hypot(0.2, lever)]
    assert error[:, :3, 3].std(axis=0) == pytest.approx(wanted, rel=0.03)


def test_an_electromagnetic_tracker_jitters_by_a_tenth_to_a_quarter_of_a_millimeter():
    """As measured on such trackers, per coordinate, after matching."""
    poses, tracked = track(ELECTROMAGNETIC)

    error = poses[:, :3, 3] - TRUE[:, :3, 3]
    assert tracked.all()
    assert error.std(axis=0).min() > 0.08
    assert error.std(axis=0).max() < 0.25


def test_frames_in_a_dropout_have_no_pose():
    """They are marked and hold NaN; the others are as good as before."""
    poses, tracked = track(replace(PERFECT, dropouts_per_minute=12.0, dropout_s=0.5))

    assert 0 < (~tracked).sum() < 200
    assert np.isnan(poses[~tracked]).all()
    # Matching bridges holes of up to 0.1 s along a straight line.
    assert distances_mm(poses)[tracked].max() < 0.1


def test_the_same_seed_gives_the_same_bytes():
    """Noise and holes included."""
    first, second = track(OPTICAL)[0], track(OPTICAL)[0]

    assert first.tobytes() == second.tobytes()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"sampling_hz": 0.0}, "sampling_hz of a tracker must be above 0"),
        ({"sampling_hz": float("nan")}, "sampling_hz of a tracker must be above 0"),
        ({"latency_s": 3.0}, "latency_s of a tracker must be within 0.5 s, got 3"),
        ({"position_noise_mm": -1.0}, "position_noise_mm of a tracker must be 0 or more, got -1"),
        ({"dropouts_per_minute": 1e9}, "at most 600 drop-outs per minute, got 1e+09"),
    ],
)
def test_settings_without_meaning_are_refused(changes, words):
    """In one sentence with the value."""
    with pytest.raises(ScanError) as caught:
        TrackerSettings(**changes)

    assert words in str(caught.value)


def test_a_tracker_that_never_sees_the_sensor_is_an_error():
    """There is no recording then."""
    with pytest.raises(ScanError, match=r"no frame has a pose: the frames span"):
        track(replace(PERFECT, dropouts_per_minute=600.0, dropout_s=60.0))
