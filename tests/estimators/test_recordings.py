"""The sensorless estimator on real recordings, beside their trackers."""

import numpy as np
import pytest
import torch

from sonosweep.estimators.calibrate import curve_from_length, curve_from_tracked
from sonosweep.estimators.decorrelation import DecorrelationEstimator
from sonosweep.estimators.patches import patch_grid
from sonosweep.geometry import motion_from_step, steps_from_poses
from sonosweep.io.open import open_scan
from sonosweep.scan import Scan, locate_image

FOLLOWED = 0.7  # correlation of single steps; 0.81 when written, tracker jitter 0.1-0.25 mm
OTHER_HALF = 0.25  # length of the half that was not calibrated on; 8 % when written


@pytest.fixture(scope="module")
def bone(recordings) -> Scan:
    """Return the tracked sweep over a forearm bone, 21 frames."""
    folder = recordings / "plus_bone_l14"
    scan = open_scan(
        folder / "BoneUltrasound_L14.igs.mha",
        plus_config=folder / "BoneUltrasound_L14_config.xml",
    )
    return locate_image(scan)


def elevational(scan: Scan, motion: torch.Tensor) -> np.ndarray:
    """Return how far each step moves the middle of the image out of plane."""
    x, y = patch_grid(scan).middle_mm
    return (motion[:, 2] + motion[:, 3] * y - motion[:, 4] * x).numpy()


def tracked(scan: Scan) -> np.ndarray:
    """Return the same from the tracker."""
    assert scan.image_to_reference is not None
    return elevational(scan, motion_from_step(steps_from_poses(scan.image_to_reference)))


def part(scan: Scan, chosen: slice) -> Scan:
    """Return some frames of a tracked scan."""
    assert scan.image_to_reference is not None
    return Scan(
        "part",
        scan.frames[chosen],
        scan.calibration,
        image_to_reference=scan.image_to_reference[chosen],
        region=scan.region,
    )


def test_steps_in_muscle_follow_the_tracker(bone):
    """In living muscle, decorrelation tells fast steps from slow ones."""
    true = tracked(bone)

    curve = curve_from_length(bone, float(true.sum()))
    found = elevational(bone, DecorrelationEstimator(curve).estimate(bone).motion)

    assert np.corrcoef(found, true)[0, 1] > FOLLOWED


def test_a_curve_from_one_half_of_a_sweep_holds_for_the_other(bone):
    """The length of tissue not calibrated on comes out within a quarter."""
    first, second = part(bone, slice(0, 10)), part(bone, slice(10, 21))

    curve = curve_from_tracked(first)
    found = elevational(second, DecorrelationEstimator(curve).estimate(second).motion)

    assert abs(found.sum() / tracked(second).sum() - 1) < OTHER_HALF
