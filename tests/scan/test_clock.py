"""Frames and tracker samples on one clock."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from sonosweep.errors import ScanError
from sonosweep.geometry import interpolate_poses, pose_from_parts, rotation_from_vector
from sonosweep.scan.clock import match_poses

from ..strategies import sweeps

ROUND_OFF_MM = 1e-9  # float64 on coordinates below 1 m


def steady_turn(times_s):
    """A probe that moves 10 mm/s along x and turns 0.1 rad/s about z."""
    times = torch.as_tensor(times_s, dtype=torch.float64)
    zero = torch.zeros_like(times)
    return pose_from_parts(
        rotation_from_vector(torch.stack((zero, zero, 0.1 * times), dim=-1)),
        torch.stack((10 * times, zero, zero), dim=-1),
    )


def seconds(*values):
    """Times as a tensor."""
    return torch.tensor(values, dtype=torch.float64)


@given(st.floats(-0.3, 0.3))
def test_a_steady_movement_is_matched_exactly(latency_s):
    """A frame shows the pose of its time less the latency, between 60 Hz samples, too."""
    samples = torch.arange(0, 3, 1 / 60, dtype=torch.float64)
    frames = torch.arange(0.5, 2.5, 1 / 20, dtype=torch.float64)

    poses, tracked, report = match_poses(samples, steady_turn(samples), frames, latency_s)

    assert bool(tracked.all())
    torch.testing.assert_close(poses, steady_turn(frames - latency_s), atol=ROUND_OFF_MM, rtol=0)
    assert report.without_pose == 0
    assert report.largest_gap_s == pytest.approx(1 / 60)


@given(sweeps(9))
def test_frames_at_sample_times_take_the_samples(poses):
    """On one common set of times nothing is interpolated, the ends included."""
    times = torch.arange(9, dtype=torch.float64) * 0.05

    matched, tracked, _ = match_poses(times, poses, times)

    assert bool(tracked.all())
    torch.testing.assert_close(matched, poses, atol=ROUND_OFF_MM, rtol=0)


def test_latency_by_hand():
    """A frame stamped 0.3 s, 0.1 s late, shows the pose of 0.2 s: 2 mm."""
    samples = torch.arange(11, dtype=torch.float64) / 10

    poses, _, _ = match_poses(samples, steady_turn(samples), seconds(0.3), 0.1, max_gap_s=0.2)

    assert float(poses[0, 0, 3]) == pytest.approx(2)


def test_a_dropout_is_not_interpolated():
    """The tracker was silent from 1 to 2 s; frames in between have no pose."""
    samples = torch.cat((torch.arange(0, 1.01, 0.05), torch.arange(2, 3, 0.05))).double()
    frames = torch.arange(0.025, 2.9, 0.25, dtype=torch.float64)

    poses, tracked, report = match_poses(samples, steady_turn(samples), frames)

    assert tracked.tolist() == [not 1 <= t <= 2 for t in frames.tolist()]
    assert bool(torch.isnan(poses[~tracked]).all())
    assert bool(torch.isfinite(poses[tracked]).all())
    assert (report.without_pose, report.first_without_pose, report.last_without_pose) == (4, 4, 7)
    assert report.largest_gap_s == pytest.approx(1, abs=1e-6)
    assert str(report).startswith("4 of 12 frames have no pose (between frames 4 and 7); the long")
    assert match_poses(samples, steady_turn(samples), frames, max_gap_s=1.1)[1].all()


def test_lost_samples_are_passed_over():
    """NaN, shrunken and flagged poses are no poses, and make a gap."""
    samples = torch.arange(8, dtype=torch.float64) / 10
    poses = steady_turn(samples)
    poses[2] = math.nan
    poses[4, :3, :3] *= 0.5
    valid = torch.ones(8, dtype=torch.bool)
    valid[6] = False

    _, tracked, report = match_poses(
        samples, poses, seconds(0.05, 0.15, 0.35, 0.55), max_gap_s=0.11, valid=valid
    )

    assert tracked.tolist() == [True, False, False, False]
    assert report.samples == 5
    assert report.invalid_samples == 3


def test_nothing_is_extrapolated():
    """Frames before the first and after the last sample have no pose."""
    samples = seconds(1.0, 1.05, 1.1)

    _, tracked, report = match_poses(samples, steady_turn(samples), seconds(0.75, 1.02, 1.5))

    assert tracked.tolist() == [False, True, False]
    assert report.uncovered_before_s == pytest.approx(0.25)
    assert report.uncovered_after_s == pytest.approx(0.4)


def test_a_sample_given_twice_counts_once():
    """Trackers repeat a sample; the first of one time is taken."""
    samples = seconds(0.0, 0.1, 0.1, 0.2)

    poses, _, report = match_poses(
        samples, steady_turn([0.0, 0.1, 7.0, 0.2]), seconds(0.1), max_gap_s=0.2
    )

    assert float(poses[0, 0, 3]) == pytest.approx(1)
    assert report.samples == 3


@given(sweeps(6), st.floats(0.01, 0.49))
def test_matching_is_interpolation_where_there_is_a_pose(poses, offset):
    """Between samples the pose is the interpolated one, whatever the sweep."""
    samples = torch.arange(6, dtype=torch.float64)
    frames = samples[:-1] + offset

    matched, _, _ = match_poses(samples, poses, frames, max_gap_s=1.0)

    torch.testing.assert_close(matched, interpolate_poses(samples, poses, frames))


def test_two_clocks_that_never_meet():
    """Frames and tracker an hour apart: the message gives both spans."""
    samples = seconds(0.0, 0.1)

    with pytest.raises(ScanError, match=r"frames span 3600.000 to 3600.000 s and the tracker 0.0"):
        match_poses(samples, steady_turn(samples), seconds(3600.0))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"poses": steady_turn([0.0, 0.1])}, "3 tracker times but 2 poses"),
        ({"sample_times_s": seconds(0.0, 0.2, 0.1)}, r"valid sample 2 is 0.1 s earlier"),
        ({"sample_times_s": seconds(0.0, math.nan, 0.1)}, "not numbers"),
        ({"frame_times_s": seconds(math.nan)}, "not numbers"),
        ({"frame_times_s": torch.zeros(0, dtype=torch.float64)}, "no frame to match"),
        ({"valid": torch.zeros(3, dtype=torch.bool)}, "none of the 3 tracker samples"),
        ({"valid": torch.ones(4, dtype=torch.bool)}, "3 tracker times but 4 validity flags"),
        ({"max_gap_s": 0.0}, "a gap above 0 s"),
        ({"latency_s": math.inf}, "finite latency"),
    ],
)
def test_bad_times_are_named(change, message):
    """What cannot be matched is refused with its value."""
    arguments = {
        "sample_times_s": seconds(0.0, 0.1, 0.2),
        "poses": steady_turn([0.0, 0.1, 0.2]),
        "frame_times_s": seconds(0.1),
    }

    with pytest.raises(ScanError, match=message):
        match_poses(**{**arguments, **change})
