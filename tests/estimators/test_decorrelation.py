"""The sensorless estimator on speckle whose motion is exactly known."""

import math

import numpy as np
import pytest
import torch

from sonosweep.errors import ScanError
from sonosweep.estimators.decorrelation import DecorrelationEstimator
from sonosweep.estimators.decorrelation_curve import DecorrelationCurve
from sonosweep.geometry import step_from_motion, transform_points
from sonosweep.scan import Calibration, Region, Scan
from tests.estimators.speckle import AMPLITUDE_WIDTH_MM, SPACING_MM, sweep

THEORY = DecorrelationCurve(width_mm=(AMPLITUDE_WIDTH_MM,))
PIXELS = 128
MIDDLE_MM = (PIXELS - 1) / 2 * SPACING_MM

SHIFT_MM = 0.02  # an eighth of a pixel; the axial speckle is only 1.6 pixels wide
TURN_RAD = math.radians(0.15)  # 19 mm field of view at 0.2 mm of elevational distance
SCALE = 0.07  # a curve from theory, not from a calibration: amplitude is not exactly rho^2


def about_the_middle(motion: torch.Tensor) -> np.ndarray:
    """Return motions of the middle of the image, to first order."""
    result = motion.numpy().copy()
    pitch, yaw, roll = result[:, 3:].T
    result[:, 0] -= roll * MIDDLE_MM
    result[:, 1] += roll * MIDDLE_MM
    result[:, 2] += (pitch - yaw) * MIDDLE_MM
    return result


def turning_about_the_middle(motion: np.ndarray) -> np.ndarray:
    """Return motions about the image's origin that are ``motion`` of its middle."""
    step = step_from_motion(torch.as_tensor(motion, dtype=torch.float64))
    middle = torch.tensor([[MIDDLE_MM, MIDDLE_MM, 0.0]], dtype=torch.float64)
    wanted = middle + torch.as_tensor(motion[:, None, :3])
    turned = transform_points(step, middle) - torch.as_tensor(motion[:, None, :3])
    result = motion.copy()
    result[:, :3] = (wanted - turned)[:, 0].numpy()
    return result


def test_steps_of_pure_speckle_are_recovered():
    """The distances between frames of fully developed speckle follow from theory alone."""
    rng = np.random.default_rng(5)
    motion = np.zeros((20, 6))
    motion[:, 0] = rng.normal(0, 0.1, 20)
    motion[:, 1] = rng.normal(0, 0.05, 20)
    motion[:, 2] = rng.uniform(0.1, 0.3, 20)

    estimate = DecorrelationEstimator(THEORY).estimate(sweep(motion))

    found = about_the_middle(estimate.motion)
    assert abs(found[:, 2].sum() / motion[:, 2].sum() - 1) < SCALE
    assert np.corrcoef(found[:, 2], motion[:, 2])[0, 1] > 0.9
    assert np.sqrt(((found - motion)[:, :2] ** 2).mean()) < SHIFT_MM


@pytest.mark.parametrize("axis", range(6))
@pytest.mark.parametrize("sign", [-1, 1])
def test_every_axis_has_the_sign_of_the_geometry(axis, sign):
    """A motion made by the pose conventions comes back with its own sign, on every axis."""
    if (axis, sign) == (2, -1):
        pytest.skip("backward looks like forward: the direction is the caller's to know")
    size = [0.15, 0.12, 0.25, math.radians(0.6), math.radians(0.6), math.radians(1)][axis]
    middle = np.array([0, 0, 0.2, 0, 0, 0.0])
    middle[axis] = sign * size
    motion = turning_about_the_middle(np.tile(middle, (8, 1)))

    found = about_the_middle(
        DecorrelationEstimator(THEORY, turn_std_rad=math.radians(1))
        .estimate(sweep(motion, seed=axis))
        .motion
    ).mean(axis=0)

    tolerance = [SHIFT_MM, SHIFT_MM, 0.25 * 0.2, TURN_RAD, TURN_RAD, TURN_RAD]
    assert np.all(np.abs(found - middle) < tolerance)


def test_frames_without_speckle_are_refused():
    """Black frames tell nothing, and the message names the first step they leave open."""
    scan = Scan("dark", np.zeros((4, 64, 64), np.uint8), Calibration(spacing_mm=(0.2, 0.2)))

    with pytest.raises(ScanError, match="frames 0 and 1 of 'dark' have no speckle"):
        DecorrelationEstimator().estimate(scan)


def test_one_frame_is_refused():
    """Motion needs two frames."""
    scan = Scan("one", np.ones((1, 64, 64), np.uint8), Calibration(spacing_mm=(0.2, 0.2)))

    with pytest.raises(ScanError, match="has 1 frame"):
        DecorrelationEstimator().estimate(scan)


def test_frames_without_spacing_are_refused():
    """Pixels of unknown size give no millimeters."""
    scan = Scan("bare", np.ones((3, 64, 64), np.uint8))

    with pytest.raises(ScanError, match="'bare' has no pixel spacing"):
        DecorrelationEstimator().estimate(scan)


def test_pixels_that_are_not_numbers_are_refused():
    """One NaN would spread over the whole patch."""
    frames = np.random.default_rng(0).random((3, 64, 64))
    frames[1, 5, 5] = np.nan
    scan = Scan("holes", frames, Calibration(spacing_mm=(0.2, 0.2)))

    with pytest.raises(ScanError, match="frame 1 of 'holes' holds pixels that are not numbers"):
        DecorrelationEstimator().estimate(scan)


def test_what_lies_outside_the_region_does_not_count():
    """A clock that runs in the corner of the screen moves nothing."""
    motion = np.tile([0.05, 0, 0.15, 0, 0, 0.0], (6, 1))
    scan = sweep(motion)
    wide = np.random.default_rng(1).integers(0, 256, (7, 140, 200), dtype=np.uint8)
    wide[:, 6 : 6 + PIXELS, 50 : 50 + PIXELS] = scan.frames[:]
    framed = Scan("framed", wide, scan.calibration, region=Region((50, 6, PIXELS, PIXELS)))

    plain = about_the_middle(DecorrelationEstimator(THEORY).estimate(scan).motion)
    found = DecorrelationEstimator(THEORY).estimate(framed).motion.numpy()

    # The origin of turns has moved to the corner of the larger frame: compare turns.
    np.testing.assert_allclose(found[:, 3:], plain[:, 3:], atol=1e-12)


def test_a_guessed_scale_is_called_a_guess():
    """Without a calibration nobody may take the elevational millimeters for measured."""
    scan = sweep(np.tile([0, 0, 0.2, 0, 0, 0.0], (3, 1)))

    assumptions = " ".join(DecorrelationEstimator().estimate(scan).assumptions)

    assert "scale is a guess" in assumptions
    assert "never went backward" in assumptions
