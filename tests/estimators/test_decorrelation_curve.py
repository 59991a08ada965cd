"""Decorrelation curves."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from sonosweep.errors import ScanError
from sonosweep.estimators.decorrelation_curve import (
    DecorrelationCurve,
    correlation_at,
    curve_from_probe,
    distance_at,
    slope_at,
    width_at,
)
from sonosweep.scan import Probe

ROUND_OFF_MM = 1e-9
SLOPE_PER_MM = 1e-5  # central differences over 2e-6 mm
FOCUS_SHARE = 0.05  # a beam of finite aperture is not Gaussian

LINEAR = Probe(
    "L11-5v",
    torch.zeros(1, 3),
    0.3,
    6.6e6,
    elevation_aperture_mm=5.0,
    elevation_focus_mm=18.0,
)


@given(
    share=st.floats(0.01, 1.7),
    width=st.floats(0.1, 5),
    exponent=st.floats(0.7, 1.9),
    peak=st.floats(0.5, 1),
)
def test_distance_and_correlation_undo_each_other(share, width, exponent, peak):
    """A distance gives a correlation that gives the distance, up to where speckle is gone."""
    curve = DecorrelationCurve(exponent=exponent, peak=peak)
    widths = np.array([width])
    distance = np.array([share * width])

    back = distance_at(curve, correlation_at(curve, distance, widths), widths)

    lost = share**exponent > -np.log(0.05)
    assert lost or abs(back - distance)[0] < ROUND_OFF_MM


def test_the_slope_is_the_derivative():
    """The slope that sets the weights of a fit is that of the curve itself."""
    curve = DecorrelationCurve(exponent=1.4, peak=0.9)
    width = np.full(20, 0.5)
    distance = np.linspace(0.05, 1.2, 20)

    numeric = (
        correlation_at(curve, distance - 1e-6, width)
        - correlation_at(curve, distance + 1e-6, width)
    ) / 2e-6

    assert np.abs(slope_at(curve, distance, width) - numeric).max() < SLOPE_PER_MM


def test_the_width_at_the_focus_is_that_of_the_aperture():
    """At its focus a beam's echoes correlate over 0.71 wavelengths times f-number."""
    curve = curve_from_probe(LINEAR, depth_mm=(18.0,))

    wavelength_mm = 1540e3 / 6.6e6
    # Second moment of the squared triangle, and amplitude correlation as its square. The
    # Gaussian of that curvature stands 6 % above the true width at 1/e.
    expected = 0.712 * wavelength_mm * 18 / 5 / np.sqrt(2)
    assert abs(curve.width_mm[0] / expected - 1) < FOCUS_SHARE


def test_a_higher_aperture_decorrelates_sooner():
    """The finer beam of a larger aperture leaves a scatterer sooner."""
    high = Probe(
        "high", torch.zeros(1, 3), 0.3, 6.6e6, elevation_aperture_mm=8.0, elevation_focus_mm=18.0
    )

    depth_mm = (18.0,)
    assert curve_from_probe(high, depth_mm).width_mm < curve_from_probe(LINEAR, depth_mm).width_mm


def test_a_probe_of_unknown_height_has_no_curve():
    """The elevational beam follows from the height of the elements, and from nothing else."""
    flat = Probe("X", torch.zeros(1, 3), 0.3, 6.6e6)

    with pytest.raises(ScanError, match="elevation_aperture_mm"):
        curve_from_probe(flat)


def test_width_is_linear_between_depths():
    """Halfway between two depths the width is halfway between theirs."""
    curve = DecorrelationCurve(depth_mm=(10.0, 20.0), width_mm=(0.4, 0.8))

    np.testing.assert_allclose(width_at(curve, np.array([0.0, 15.0, 99.0])), [0.4, 0.6, 0.8])


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"width_mm": (0.4, 0.5)}, "one width per depth"),
        ({"depth_mm": (2.0, 1.0), "width_mm": (0.4, 0.4)}, "must increase"),
        ({"width_mm": (0.0,)}, "smallest width"),
        ({"width_mm": (float("nan"),)}, "width"),
        ({"peak": 0.0}, "peak"),
        ({"exponent": -1.0}, "exponent"),
        ({"coherence": 2.0}, "coherence"),
        ({"fineness_per_mm2": (1.0, 2.0)}, "one fineness per depth"),
    ],
)
def test_impossible_curves_are_refused(fields, message):
    """A curve that could not have been measured is stopped where it enters."""
    with pytest.raises(ScanError, match=message):
        DecorrelationCurve(**fields)
