"""Curves measured on one sweep, used on another."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sonosweep.errors import ScanError
from sonosweep.estimators.calibrate import calibrate
from sonosweep.estimators.decorrelation import DecorrelationEstimator
from sonosweep.estimators.decorrelation_curve import DecorrelationCurve
from sonosweep.scan import Scan
from tests.estimators.speckle import AMPLITUDE_WIDTH_MM, sweep
from tests.estimators.test_decorrelation import about_the_middle, straight

SAME_SWEEP = 0.02  # what the rounds of rescaling leave
OTHER_SWEEP = 0.08  # averaging stretches slow steps more than fast ones
WIDTH = 0.05


def length(curve: DecorrelationCurve, scan: Scan) -> float:
    """Return how far the middle of the image moves out of plane."""
    motion = DecorrelationEstimator(curve).estimate(scan).motion
    return float(about_the_middle(motion)[:, 2].sum())


def test_a_tracked_sweep_of_speckle_gives_the_curve_of_theory():
    """Fully developed speckle decorrelates as a Gaussian of the beam's width."""
    curve = calibrate(sweep(straight(7, 30), 7))

    assert np.abs(np.array(curve.width_mm) / AMPLITUDE_WIDTH_MM - 1).max() < WIDTH
    assert 1.8 < curve.exponent < 2.1
    assert curve.source == "tracked"


def test_the_ruler_gives_the_length_back():
    """A curve from a sweep of known length makes that sweep this long."""
    motion = straight(7, 30)
    scan = replace(sweep(motion, 7), image_to_reference=None)

    curve = calibrate(scan, length_mm=42.0)

    assert abs(length(curve, scan) / 42 - 1) < SAME_SWEEP
    assert curve.quality["length_mm"] == 42.0


@pytest.mark.parametrize("with_ruler", [False, True])
def test_averaged_frames_are_too_near_until_calibrated(with_ruler):
    """A scanner that averages frames stretches the curve; one sweep tells by how much."""
    known, new = straight(7, 30), straight(8, 30)
    calibration = sweep(known, 7, persistence=0.6)
    scan = sweep(new, 8, persistence=0.6)
    true_mm = float(new[:, 2].sum())

    curve = calibrate(calibration, float(known[:, 2].sum()) if with_ruler else None)

    assert length(DecorrelationCurve(), scan) / true_mm < 0.85
    assert abs(length(curve, scan) / true_mm - 1) < OTHER_SWEEP


def test_a_calibration_needs_poses_or_a_length():
    """Without tracker and without ruler nothing says what a millimeter is."""
    scan = replace(sweep(straight(1, 9)), image_to_reference=None)

    with pytest.raises(ScanError, match="--length-mm"):
        calibrate(scan)


@pytest.mark.parametrize("length_mm", [0.0, -3.0, float("nan"), 1e9])
def test_impossible_lengths_are_refused(length_mm):
    """A sweep is some centimeters long."""
    with pytest.raises(ScanError, match="length of the sweep"):
        calibrate(sweep(straight(1, 9)), length_mm)


def test_a_still_probe_gives_no_curve():
    """Frames that do not change say nothing of the distance between them."""
    scan = sweep(np.zeros((9, 6)))

    with pytest.raises(ScanError, match="do not decorrelate"):
        calibrate(scan, 20.0)
    with pytest.raises(ScanError, match="did not move out of plane"):
        calibrate(scan)


@pytest.mark.parametrize("in_plane", [0, 1])
def test_a_sweep_in_the_plane_of_the_image_gives_no_curve(in_plane):
    """Its frames differ by what enters at their edge, not by the beam's width."""
    motion = straight(1, 12)
    motion[:, in_plane] = 3 * motion[:, 2]

    with pytest.raises(
        ScanError, match=r"moved in its plane in 'made of waves', 3[12]% of the way"
    ):
        calibrate(sweep(motion, 1))


def test_missed_poses_are_refused():
    """A curve fitted to distances that the tracker missed would be wrong."""
    scan = sweep(straight(1, 9))
    tracked = torch.ones(10, dtype=torch.bool)
    tracked[3] = False

    with pytest.raises(ScanError, match="missed 1 frames"):
        calibrate(replace(scan, tracked=tracked))


def test_short_scans_are_refused():
    """A handful of frames hold no curve."""
    with pytest.raises(ScanError, match="needs 8"):
        calibrate(sweep(straight(1, 3)))
