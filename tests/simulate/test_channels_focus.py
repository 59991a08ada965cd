"""Simulated channel data and the beamformer agree on where a point is."""

import math

import numpy as np
import pytest

from sonosweep.imaging.beamform import BeamformSettings, beamform
from sonosweep.simulate import (
    Acquisition,
    linear_probe_l11_5v,
    simulate_photoacoustic,
    simulate_plane_waves,
)

from ..imaging.arrays import patch, peak_mm

DEPTH_MM, LATERAL_MM = 0.005, 0.010
# Tapered: with an abrupt aperture elements enter and leave it as the pixel moves.
PROBE = linear_probe_l11_5v()
RECORDING = Acquisition(samples=1536)
POINTS = [(0.0, 20.0), (-6.0, 12.0), (7.3, 27.1)]


@pytest.mark.parametrize("point", POINTS)
def test_echoes_focus_on_the_point(point: tuple[float, float]) -> None:
    """After compounding 15 plane waves a point target lies within 5 µm in depth, 10 beside."""
    where = np.array([[*point, 0.0]])
    angles = np.deg2rad(np.linspace(-14.0, 14.0, 15))
    data = simulate_plane_waves(where, np.ones(1), PROBE, angles, RECORDING)
    grid = patch(*point)
    x, y = peak_mm(beamform(data, 0, grid, BeamformSettings(window="hann")), grid)
    assert x == pytest.approx(point[0], abs=LATERAL_MM)
    assert y == pytest.approx(point[1], abs=DEPTH_MM)


@pytest.mark.parametrize("point", POINTS)
def test_light_focuses_on_the_absorber(point: tuple[float, float]) -> None:
    """A photoacoustic point lies within 5 µm in depth and 10 beside, one way."""
    data = simulate_photoacoustic(np.array([[*point, 0.0]]), np.ones(1), PROBE, RECORDING)
    grid = patch(*point)
    x, y = peak_mm(beamform(data, 0, grid, BeamformSettings(1.0, "hann")), grid)
    assert x == pytest.approx(point[0], abs=LATERAL_MM)
    assert y == pytest.approx(point[1], abs=DEPTH_MM)


def test_the_image_has_the_phase_of_the_echo() -> None:
    """At the place of a point the compounded image is real and positive: no phase is lost."""
    point = (1.0, 16.0)
    angles = np.deg2rad([-8.0, 0.0, 8.0])
    data = simulate_plane_waves(np.array([[*point, 0.0]]), np.ones(1), PROBE, angles, RECORDING)
    image = beamform(data, 0, patch(*point, half_mm=0.0, step_mm=0.02))
    two_hundredths_of_a_turn = 2 * math.pi / 50
    assert abs(np.angle(image[0, 0])) < two_hundredths_of_a_turn
