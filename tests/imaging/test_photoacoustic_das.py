"""One-way delay-and-sum: sound that starts in the tissue, on straight, curved and ring arrays."""

import dataclasses

import numpy as np
import pytest

from sonosweep.errors import ScanError
from sonosweep.imaging import BeamformSettings, PixelGrid, beamform, prepare_beamformer
from sonosweep.imaging.aperture import array_shape
from tests.imaging.arrays import (
    half_width_mm,
    linear_probe,
    patch,
    peak_mm,
    probe_at,
    record,
    ring_probe,
)

DEPTH_MM, LATERAL_MM = 5e-3, 10e-3
"""How far a source may be off (issue 3)."""
ALL_ELEMENTS = BeamformSettings(f_number=None)


@pytest.mark.parametrize("source", [(0.0, 12.0), (2.15, 15.0)])
def test_a_vessel_is_where_its_sound_came_from(source):
    """A point that absorbs the laser pulse is found with sound that went one way."""
    data = record(linear_probe(96), np.array([source]))
    grid = patch(*source, 0.5)

    lateral, axial = peak_mm(beamform(data, 0, grid, BeamformSettings(1.0)), grid)

    assert abs(axial - source[1]) < DEPTH_MM
    assert abs(lateral - source[0]) < LATERAL_MM


def test_the_pulse_sets_the_depth_resolution():
    """One way, the axial width is the pulse's length in space: twice that of an echo."""
    data = record(linear_probe(96), np.array([[0.0, 12.0]]))
    image = np.abs(beamform(data, 0, patch(0, 12, 0.5), BeamformSettings(1.0)))

    assert half_width_mm(image[:, 25], 0.02) == pytest.approx(2 / 7.6e6 * 1540e3, rel=0.1)


@pytest.mark.parametrize("source", [(0.0, 0.0), (3.0, -4.0), (-7.5, 2.0)])
def test_a_ring_focuses_everywhere(source):
    """Sound that spreads as 1/r onto 256 elements around it comes back to its source."""
    data = record(ring_probe(), np.array([source]), rate_hz=40e6, samples=1300, spreading=True)
    grid = patch(*source, 0.4)

    image = beamform(data, 0, grid, ALL_ELEMENTS)

    lateral, axial = peak_mm(image, grid)
    assert np.hypot(lateral - source[0], axial - source[1]) < DEPTH_MM
    wavelength_mm = 1540e3 / 5e6
    for profile in (np.abs(image)[20], np.abs(image)[:, 20]):
        assert half_width_mm(profile, 0.02) < 0.5 * wavelength_mm


def test_half_a_ring_still_finds_its_sources():
    """Two sources of different strength, an arc of 174 degrees: each where it is."""
    sources = np.array([[2.0, 3.0], [-3.0, -1.0]])
    probe = ring_probe(span_deg=174.0)
    data = record(probe, sources, rate_hz=40e6, samples=1600, strength=np.array([1.0, 0.6]))
    prepared = [prepare_beamformer(data, patch(*place, 0.5), ALL_ELEMENTS) for place in sources]

    images = [np.abs(each.apply(data.samples[0])) for each in prepared]

    for place, image in zip(sources, images, strict=True):
        assert np.hypot(*(np.array(peak_mm(image, patch(*place, 0.5))) - place)) < LATERAL_MM
    assert images[1].max() / images[0].max() == pytest.approx(0.6, abs=0.05)


def test_the_wrong_sound_speed_blurs_a_ring():
    """All directions agree on a source only at the true speed."""
    data = record(ring_probe(), np.array([[1.0, 2.0]]), rate_hz=40e6, samples=1300)
    grid = patch(1.0, 2.0, 0.4)
    peaks = {
        speed: np.abs(
            beamform(data, 0, grid, dataclasses.replace(ALL_ELEMENTS, sound_speed_m_per_s=speed))
        ).max()
        for speed in (1520.0, 1540.0, 1560.0)
    }

    assert peaks[1540.0] > 1.5 * max(peaks[1520.0], peaks[1560.0])


def arc(radius_mm: float, convex: bool) -> np.ndarray:
    """Return 64 elements on an arc of 60 degrees whose middle is the origin."""
    angles = np.linspace(-np.pi / 6, np.pi / 6, 64)
    bulge = radius_mm * (np.cos(angles) - 1)
    return np.column_stack([radius_mm * np.sin(angles), bulge if convex else -bulge])


@pytest.mark.parametrize("convex", [True, False])
def test_elements_of_curved_arrays_look_into_the_body(convex):
    """Across a bulging face they look apart, across a hollow one together; never backward."""
    shape = array_shape(probe_at(arc(40.0, convex)))

    assert shape is not None
    outward = 1 if convex else -1
    angles = np.linspace(-np.pi / 6, np.pi / 6, 64)
    np.testing.assert_allclose(shape.normals[:, 0], outward * np.sin(angles), atol=1e-6)
    np.testing.assert_allclose(shape.normals[:, 1], np.cos(angles), atol=1e-6)


def test_elements_of_a_ring_look_inward():
    """Those below look up, those beside look to the middle."""
    probe = ring_probe(span_deg=270.0)
    shape = array_shape(probe)

    assert shape is not None
    np.testing.assert_allclose(shape.normals, -probe.element_positions_mm[:, :2] / 20, atol=1e-6)


def test_the_aperture_of_a_curved_array_turns_with_its_elements():
    """At f-number 1 an element hears 26.6 degrees to each side of where it looks."""
    probe = probe_at(arc(40.0, True))
    data = record(probe, np.array([[0.0, 10.0]]), samples=600)
    only = np.zeros_like(data.samples[:])
    only[..., 60, :] = np.random.default_rng(0).standard_normal(600)
    alone = dataclasses.replace(data, samples=only)
    grid = PixelGrid(60, 50, (0.5, 0.2), (0.0, 1.0))

    heard = beamform(alone, 0, grid, BeamformSettings(1.0)) != 0

    x, y = np.meshgrid(grid.lateral_mm, grid.axial_mm)
    away = np.stack([x, y], -1) - arc(40.0, True)[60]
    angle = np.arctan2(away[..., 0], away[..., 1]) - np.linspace(-np.pi / 6, np.pi / 6, 64)[60]
    reach = np.hypot(*np.moveaxis(away, -1, 0)) < 599 / 4 / 7.6e6 * 1540e3 - 0.1
    inside = np.abs(np.rad2deg(angle)) < 26.565
    np.testing.assert_array_equal(heard[reach], inside[reach])


def test_scattered_elements_have_no_f_number():
    """Elements anywhere can be summed, but nobody knows where they look."""
    rng = np.random.default_rng(0)
    probe = probe_at(rng.uniform((-10, -2), (10, 0), (40, 2)))
    data = record(probe, np.array([[0.5, 8.0]]), samples=600)
    grid = patch(0.5, 8.0, 0.4)

    lateral, axial = peak_mm(beamform(data, 0, grid, ALL_ELEMENTS), grid)

    assert np.hypot(lateral - 0.5, axial - 8.0) < LATERAL_MM
    with pytest.raises(ScanError, match=r"neither on a line nor on a circle.*f-number"):
        beamform(data, 0, grid)
    with pytest.raises(ScanError, match="directivity is not known"):
        beamform(data, 0, grid, BeamformSettings(None, directivity=True))
