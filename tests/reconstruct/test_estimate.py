"""From motion to a trajectory, and what the direction of the sweep changes."""

import numpy as np
import pytest
import torch
from hypothesis import given
from torch.testing import assert_close

from sonosweep.errors import ScanError
from sonosweep.estimators.estimator import MotionEstimate, MotionEstimator
from sonosweep.geometry import motion_from_step, steps_from_poses
from sonosweep.reconstruct import estimate_trajectory
from sonosweep.scan import Calibration, Scan

from ..strategies import sweeps

ROUND_OFF_MM = 1e-9  # float64 on coordinates below 1 m


class Told(MotionEstimator):
    """An estimator that knows the answer."""

    def __init__(self, motion):
        self.motion = motion

    def estimate(self, scan, progress=None):
        """Return what it was told."""
        return MotionEstimate(self.motion)


def trajectory_of(motion, direction):
    """The trajectory of black frames that moved so."""
    scan = Scan("x", np.zeros((len(motion) + 1, 4, 4), np.uint8), Calibration((0.1, 0.1)))
    return estimate_trajectory(scan, Told(motion), direction)


@given(sweeps(6, 3.0, 0.3))
def test_the_other_direction_is_the_mirror_image(image_to_reference):
    """Backward, every pixel lies at its mirror image in the plane of frame 0.

    Reflection in that plane maps each image onto itself, so no image can tell the two.
    """
    motion = motion_from_step(steps_from_poses(image_to_reference))
    mirror = torch.diag(torch.tensor([1.0, 1, -1, 1], dtype=torch.float64))
    pixel = torch.tensor([7.0, 30.0, 0.0, 1.0], dtype=torch.float64)

    forward = trajectory_of(motion, 1).image_to_reference
    backward = trajectory_of(motion, -1).image_to_reference

    assert_close(backward, mirror @ forward @ mirror, atol=ROUND_OFF_MM, rtol=0)
    assert_close(backward @ pixel, forward @ pixel @ mirror, atol=ROUND_OFF_MM, rtol=0)


def test_the_direction_is_said():
    """Which way was taken stands among the assumptions; a third way there is not."""
    motion = torch.zeros(2, 6, dtype=torch.float64)

    assert "forward" in trajectory_of(motion, 1).assumptions[0]
    assert "backward" in trajectory_of(motion, -1).assumptions[0]
    with pytest.raises(ScanError, match="got 0"):
        trajectory_of(motion, 0)
