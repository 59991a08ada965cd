"""Steps that rise and fall together."""

import pytest
import torch
from hypothesis import given

from sonosweep.errors import ScanError
from sonosweep.geometry import poses_from_steps, step_from_motion
from sonosweep.metrics import step_correlation

from ..strategies import poses, scans

CENTER_MM = torch.tensor([19.0, 19.0, 0.0], dtype=torch.float64)
EYE = torch.eye(4, dtype=torch.float64)


def path(motion):
    """Poses with these motions from one to the next."""
    return poses_from_steps(step_from_motion(torch.as_tensor(motion, dtype=torch.float64)), EYE)


def test_twice_as_fast_is_a_perfect_correlation():
    """And a movement that slows where the true one quickens is the worst; 0 moves nowhere."""
    speeds = (0.1, 0.3, 0.2, 0.5)
    true = path([(s, s, s, 0, 0, 0) for s in speeds])
    estimated = path([(2 * s, -s, 0.3, 0, 0, 0) for s in speeds])

    found = step_correlation(estimated, true, CENTER_MM)

    assert found["lateral"] == pytest.approx(1)
    assert found["axial"] == pytest.approx(-1)
    assert [found[name] for name in ("elevational", "pitch", "yaw", "roll")] == [None] * 4


def test_four_steps_by_hand():
    """Steps 1 2 3 4 and 2 1 4 3: sums of deviations 3 and 5 and 5, so 3 / 5."""
    true, estimated = (
        path([(0, 0, s, 0, 0, 0) for s in steps]) for steps in ((1, 2, 3, 4), (2, 1, 4, 3))
    )

    assert step_correlation(estimated, true, CENTER_MM)["elevational"] == pytest.approx(0.6)


def test_a_turn_about_the_centre_is_no_translation():
    """About the first pixel it would be one."""
    about_center = EYE.clone()
    about_center[:3, 3] = CENTER_MM
    turns = path([(0, 0, 0.2, angle, 0, 0) for angle in (0.01, -0.02, 0.03, 0.01)])
    image = about_center @ turns @ torch.linalg.inv(about_center)
    moved = path([(0, 0, s, 0, 0, 0) for s in (0.1, 0.3, 0.2, 0.4)])

    assert step_correlation(image, moved, CENTER_MM)["elevational"] is None
    assert step_correlation(image, moved, 0 * CENTER_MM)["elevational"] is not None


@given(scans(frames=8), poses())
def test_the_truth_correlates_with_itself_in_any_reference(scan, reference):
    """Where a number varies at all."""
    true = scan.image_to_reference

    found = step_correlation(reference @ true, true, CENTER_MM)

    assert all(value is None or value == pytest.approx(1, abs=1e-6) for value in found.values())


def test_steps_without_a_pose_do_not_count():
    """The middle frame was lost, and with it two steps."""
    steps = (1.0, 9.0, 9.0, 2.0, 3.0)
    true = path([(0, 0, s, 0, 0, 0) for s in (1.0, 2.0, 2.0, 2.0, 3.0)])
    estimated = path([(0, 0, s, 0, 0, 0) for s in steps])
    tracked = torch.tensor([True, True, False, True, True, True])

    found = step_correlation(estimated, true, CENTER_MM, tracked)

    assert found["elevational"] == pytest.approx(1)
    with pytest.raises(ScanError, match="needs 2 of them, got 0"):
        step_correlation(estimated, true, CENTER_MM, tracked & False)
    with pytest.raises(ScanError, match="6 estimated poses but 5 true ones"):
        step_correlation(estimated, true[:-1], CENTER_MM)
