"""Errors of trajectories."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from sonosweep.errors import ScanError
from sonosweep.geometry import pose_from_parts, rotation_from_vector
from sonosweep.metrics import (
    align_first_frame,
    drift_per_frame,
    evaluate_trajectory,
    frame_grid,
    frame_quadrature,
)

from ..strategies import poses, sweeps
from .oracles import slow_metrics

ROUND_OFF = 1e-8  # float64 on coordinates below 1 m, angles in degrees
POINTS = frame_grid(64, 48, (0.3, 0.25), count=4)


def straight_sweep(*elevational_mm, axial_mm=0.0):
    """Poses that only move, to the given distances along z."""
    shift = torch.zeros(len(elevational_mm), 3, dtype=torch.float64)
    shift[:, 2] = torch.tensor(elevational_mm)
    shift[:, 1] = axial_mm
    return pose_from_parts(torch.eye(3, dtype=torch.float64).expand(len(shift), 3, 3), shift)


@given(sweeps(), poses())
def test_truth_has_no_error(true, reference):
    """The true sweep seen from any other reference is without error and correlates fully."""
    found = evaluate_trajectory(reference @ true, true, POINTS).as_dict()

    for name, value in found.items():
        if name.startswith("correlation"):
            assert value == pytest.approx(1, abs=ROUND_OFF), name
        elif name not in (
            "frames",
            "path_length_mm",
            "chord_length_mm",
            "estimated_path_length_mm",
        ):
            assert value == pytest.approx(0, abs=1e-6), name  # angles: acos-like loss near 0
    assert found["frames"] == len(true)
    assert found["estimated_path_length_mm"] == pytest.approx(found["path_length_mm"])


@given(sweeps(), sweeps(), poses(), poses())
def test_references_do_not_matter(estimated, true, a, b):
    """Moving either reference changes no number."""
    expected = evaluate_trajectory(estimated, true, POINTS).as_dict()

    moved = evaluate_trajectory(a @ estimated, b @ true, POINTS).as_dict()

    assert moved == pytest.approx(expected, abs=1e-6)


@given(sweeps(6, 5.0, 0.6), sweeps(6, 5.0, 0.6))
def test_numbers_are_those_of_the_definition(estimated, true):
    """Loops over frames and points give the same numbers."""
    expected = slow_metrics(estimated.numpy(), true.numpy(), POINTS.numpy())

    found = evaluate_trajectory(estimated, true, POINTS).as_dict()

    assert {name: found[name] for name in expected} == pytest.approx(expected, abs=1e-6)


def test_stretched_sweep():
    """Steps of 1.5 mm instead of 1 mm: 0.5 mm per step, 50 % drift, in one of three axes."""
    found = evaluate_trajectory(
        straight_sweep(0.0, 1.5, 3.0), straight_sweep(0.0, 1.0, 2.0), POINTS
    )

    assert found.relative_error_mm == pytest.approx(0.5 / 3)
    assert found.relative_error_mixed == pytest.approx(0.5 / 6)
    assert found.relative_error_deg == 0
    assert found.accumulated_error_mm == pytest.approx((0.5 + 1.0) / 2 / 3)
    assert found.relative_frame_error_mm == pytest.approx(0.5)
    assert found.accumulated_frame_error_mm == pytest.approx(0.75)
    assert found.median_drift_mm == pytest.approx(0.75)
    assert found.final_drift_mm == found.maximum_drift_mm == pytest.approx(1)
    assert found.final_drift_rate_path_percent == pytest.approx(50)
    assert found.final_drift_rate_chord_percent == pytest.approx(50)
    assert found.estimated_path_length_mm == pytest.approx(3)
    assert found.correlation_pearson == pytest.approx(1)


def test_path_and_chord_of_a_sweep_that_turns_back():
    """3 mm forward and 2 mm back: a path of 5 mm, a chord of 1 mm."""
    true, estimated = straight_sweep(0.0, 3.0, 1.0), straight_sweep(0.0, 3.0, 1.5)

    found = evaluate_trajectory(estimated, true, POINTS)

    assert found.final_drift_rate_path_percent == pytest.approx(10)
    assert found.final_drift_rate_chord_percent == pytest.approx(50)


def test_sweep_that_ends_where_it_began():
    """A closed sweep has no chord to divide by; its path it has."""
    found = evaluate_trajectory(
        straight_sweep(0.0, 2.0, 1.0), straight_sweep(0.0, 2.0, 0.0), POINTS
    )

    assert found.final_drift_rate_chord_percent is None
    assert found.final_drift_rate_path_percent == pytest.approx(25)


def test_probe_at_rest():
    """A probe that never moved has no rates and no correlation, and still has a drift."""
    found = evaluate_trajectory(straight_sweep(0.0, 1.0), straight_sweep(0.0, 0.0), POINTS)

    assert found.final_drift_mm == pytest.approx(1)
    assert found.final_drift_rate_path_percent is None
    assert found.correlation_pearson is None


def test_an_estimate_that_never_moves_correlates_with_nothing():
    """Rounding of points that stay where they are is no movement, whatever the truth does."""
    turn = torch.linspace(0, 1, 50, dtype=torch.float64)[:, None] * torch.ones(3)
    true = pose_from_parts(rotation_from_vector(turn), 30 * turn)

    found = evaluate_trajectory(true[[0] * 50], true, POINTS)

    assert found.correlation_pearson is None
    assert found.estimated_path_length_mm == pytest.approx(0, abs=1e-12)


def test_wrong_way_correlates_negatively_but_its_cosine_is_high():
    """A sweep taken for its mirror image: Pearson -1, while the paper's Corr stays above 0."""
    found = evaluate_trajectory(
        straight_sweep(0.0, -1.0, -2.0), straight_sweep(0.0, 1.0, 2.0), POINTS
    )

    assert found.correlation_pearson == pytest.approx(-1)
    assert found.correlation_cosine > 0


def test_angles_are_wrapped():
    """179 and -179 degrees of roll differ by 2 degrees: two thirds of one in the mean."""
    half_turn = torch.tensor([[0.0, 0, 0], [0, 0, math.radians(179)]], dtype=torch.float64)
    shift = torch.zeros(2, 3, dtype=torch.float64)
    a = pose_from_parts(rotation_from_vector(half_turn), shift)
    b = pose_from_parts(rotation_from_vector(-half_turn), shift)

    found = evaluate_trajectory(a, b, POINTS)

    assert found.accumulated_error_deg == pytest.approx(2 / 3)
    assert found.accumulated_angle_deg == pytest.approx(2)


@given(sweeps(12), sweeps(12), st.integers(2, 10))
def test_frames_without_pose_do_not_count(estimated, true, lost):
    """Losing the first frames is like starting later; NaN there changes nothing."""
    tracked = torch.arange(12) >= lost
    holes = true.clone()
    holes[:lost] = math.nan

    found = evaluate_trajectory(estimated, holes, POINTS, tracked=tracked)

    expected = evaluate_trajectory(estimated[lost:], true[lost:], POINTS)
    assert found.as_dict() == pytest.approx(expected.as_dict(), abs=1e-6)


def test_steps_across_a_gap_do_not_count():
    """Of frames 0, 1, 3 only 0 and 1 are neighbours: one step, with its error of 0.5 mm."""
    estimated, true = straight_sweep(0.0, 1.5, 9.0, 9.0), straight_sweep(0.0, 1.0, 2.0, 3.0)
    tracked = torch.tensor([True, True, False, True])

    found = evaluate_trajectory(estimated, true, POINTS, tracked=tracked)

    assert found.relative_frame_error_mm == pytest.approx(0.5)
    assert found.path_length_mm == pytest.approx(3)
    assert found.frames == 3


def test_no_neighbours_no_relative_error():
    """With every second frame lost there are poses to compare and no steps."""
    tracked = torch.tensor([True, False, True])

    found = evaluate_trajectory(
        straight_sweep(0.0, 1.0, 2.0), straight_sweep(0.0, 1.0, 2.5), POINTS, tracked=tracked
    )

    assert found.relative_error_mm is None
    assert found.relative_frame_error_mm is None
    assert found.accumulated_frame_error_mm == pytest.approx(0.5)


@given(sweeps(5), sweeps(5))
def test_weights_are_repeated_points(estimated, true):
    """A point with twice the weight is a point given twice."""
    points = POINTS[:3]
    twice = torch.cat((points, points[:1]))

    weighted = evaluate_trajectory(
        estimated, true, points, torch.tensor([0.5, 0.25, 0.25], dtype=torch.float64)
    )

    expected = evaluate_trajectory(estimated, true, twice)
    assert weighted.as_dict() == pytest.approx(expected.as_dict(), abs=1e-9)


@given(sweeps(5), sweeps(5))
def test_drift_per_frame_is_what_the_summary_is_made_of(estimated, true):
    """The last drift is the final drift, and the first frame has none."""
    drift = drift_per_frame(estimated, true, POINTS)

    found = evaluate_trajectory(estimated, true, POINTS)
    assert float(drift[0]) == pytest.approx(0, abs=1e-12)
    assert float(drift[-1]) == found.final_drift_mm
    assert float(drift[1:].mean()) == pytest.approx(found.accumulated_frame_error_mm)


def test_drift_of_lost_frames_is_not_a_number():
    """A frame without true pose has no drift."""
    tracked = torch.tensor([True, False, True])

    drift = drift_per_frame(
        straight_sweep(0.0, 1, 2), straight_sweep(0.0, 1, 3), POINTS, tracked=tracked
    )

    assert torch.isnan(drift).tolist() == [False, True, False]
    assert float(drift[2]) == pytest.approx(1)


@given(sweeps(5), sweeps(5))
def test_aligned_trajectories_start_together(estimated, true):
    """Alignment lays the first frame on the true one and keeps every step."""
    aligned = align_first_frame(estimated, true)

    torch.testing.assert_close(aligned[0], true[0], atol=1e-9, rtol=0)
    torch.testing.assert_close(
        torch.linalg.solve(aligned[0], aligned[4]),
        torch.linalg.solve(estimated[0], estimated[4]),
        atol=1e-9,
        rtol=0,
    )


@given(sweeps(4), sweeps(4))
def test_float32_poses_are_compared_in_float64(estimated, true):
    """Single precision poses are widened, not computed with."""
    a, b = estimated.float(), true.float()

    assert evaluate_trajectory(a, b, POINTS) == evaluate_trajectory(a.double(), b.double(), POINTS)


def test_counts_that_differ():
    """Three estimated poses cannot be compared with two true ones."""
    with pytest.raises(ScanError, match="3 estimated poses but 2 true"):
        evaluate_trajectory(straight_sweep(0.0, 1, 2), straight_sweep(0.0, 1), POINTS)
    with pytest.raises(ScanError, match="3 true poses but 2 tracking flags"):
        evaluate_trajectory(
            straight_sweep(0.0, 1, 2),
            straight_sweep(0.0, 1, 2),
            POINTS,
            tracked=torch.ones(2, dtype=torch.bool),
        )


def test_one_frame_is_no_trajectory():
    """Two tracked frames are the least there is to compare."""
    with pytest.raises(ScanError, match="two tracked frames or more, got 1"):
        evaluate_trajectory(straight_sweep(0.0), straight_sweep(0.0), POINTS)


def test_poses_that_are_not_numbers():
    """NaN in a frame that counts is named, not averaged."""
    true = straight_sweep(0.0, 1, 2)
    true[1, 0, 3] = math.nan

    with pytest.raises(ScanError, match="true pose of frame 1"):
        evaluate_trajectory(straight_sweep(0.0, 1, 2), true, POINTS)


def test_grid_of_the_released_code():
    """256 x 256 pixels give pixels 0, 16, ..., 240; point 128 is row 128, column 0."""
    points = frame_grid(256, 256, (0.1, 0.2))

    assert points.shape == (256, 3)
    assert points[1].tolist() == pytest.approx([1.6, 0, 0])
    assert points[128].tolist() == pytest.approx([0, 25.6, 0])
    assert frame_grid(3, 1, (1.0, 1.0)).tolist() == [[0, 0, 0], [0, 1, 0], [0, 2, 0]]


@given(sweeps(4, 3.0), sweeps(4, 3.0))
def test_gauss_points_give_the_mean_over_all_pixels(estimated, true):
    """64 weighted points give the frame errors of every pixel of the frame."""
    rows, columns, spacing = 40, 60, (0.3, 0.25)
    every = frame_grid(rows, columns, spacing, count=60)

    points, weights = frame_quadrature(rows, columns, spacing)
    found = evaluate_trajectory(estimated, true, points, weights)

    expected = evaluate_trajectory(estimated, true, every)
    assert found.accumulated_frame_error_mm == pytest.approx(
        expected.accumulated_frame_error_mm, rel=2e-6
    )
    assert found.path_length_mm == pytest.approx(expected.path_length_mm, rel=1e-9)
