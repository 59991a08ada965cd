"""A point of the body is at the pixel, has the width and the phase, that geometry says."""

import numpy as np
import pytest
from scipy.ndimage import binary_erosion

from sonosweep.errors import ScanError
from sonosweep.imaging import PixelGrid, SectorGrid, centered_grid
from sonosweep.simulate import STILL, Beam, Body, Deformation, PulsingArtery, Tissue
from sonosweep.simulate.planes import sample_plane
from sonosweep.simulate.speckle import SpeckleRenderer, render_points
from tests.simulate.speckle_bodies import block, correlation, pose

BEAM = Beam()
CONVEX = Beam(3.5e6, 0.35, 0.9, 1.3, 30.0, 1540.0, 40.0)
GRID = centered_grid(128, 128, (0.1484, 0.1484), 8.0)
FINE = centered_grid(120, 160, (0.05, 0.025), 16.0)
SECTOR = SectorGrid(96, 200, 0.006, 0.1, 5.0, 40.0)
PLACE_PX = 0.02
"""Error of a wire's place: of sharing it between fine pixels, a quarter of a pixel wide."""


def point(x: float, y: float, z: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return one scatterer of amplitude 1."""
    return np.array([[x, y, z]]), np.ones(1)


def peak_of(frame: np.ndarray) -> tuple[float, float]:
    """Return row and column of the peak of a Gaussian echo: its logarithm is a parabola."""
    row, column = np.unravel_index(np.abs(frame).argmax(), frame.shape)
    along = np.log(np.abs(frame[row - 1 : row + 2, column]).astype(float))
    across = np.log(np.abs(frame[row, column - 1 : column + 2]).astype(float))
    shifts = [(v[0] - v[2]) / 2 / (v[0] - 2 * v[1] + v[2]) for v in (along, across)]
    return row + shifts[0], column + shifts[1]


def middle_of(power: np.ndarray) -> tuple[float, float]:
    """Return row and column of the middle of an echo's energy."""
    rows, columns = np.indices(power.shape)
    return float((power * rows).sum() / power.sum()), float((power * columns).sum() / power.sum())


def full_width(profile: np.ndarray, spacing_mm: float) -> float:
    """Return the width at half the maximum, of a Gaussian of that second moment."""
    at = np.arange(profile.size) * spacing_mm
    power = profile**2 / (profile**2).sum()
    variance = (power * at**2).sum() - (power * at).sum() ** 2
    return float(np.sqrt(8 * np.log(2) * 2 * variance))


@pytest.mark.parametrize("x", [-4.1, 0.0, 0.037, 3.33])
@pytest.mark.parametrize("y", [10.0, 13.717, 21.99])
def test_a_wire_lies_at_its_pixel(x: float, y: float) -> None:
    """The middle of a wire's echo is where the wire is, between pixels too."""
    row, column = peak_of(render_points(*point(x, y), BEAM, GRID))
    assert row == pytest.approx((y - 8.0) / 0.1484, abs=PLACE_PX)
    assert column == pytest.approx((x - GRID.origin_mm[0]) / 0.1484, abs=PLACE_PX)


@pytest.mark.parametrize("y", [17.0, 17.01, 17.777])
def test_a_wire_has_the_widths_of_the_beam_and_the_phase_of_its_depth(y: float) -> None:
    """Width along and across, peak 1, and the phase exp(-j 2 k r) of the round trip."""
    frame = render_points(*point(0.4, y), BEAM, FINE)
    row, column = np.unravel_index(np.abs(frame).argmax(), frame.shape)
    amplitude = np.abs(frame)
    assert full_width(amplitude[:, column], 0.025) == pytest.approx(BEAM.axial_fwhm_mm, rel=0.02)
    assert full_width(amplitude[row], 0.05) == pytest.approx(BEAM.lateral_fwhm_mm, rel=0.02)
    across = (FINE.lateral_mm - 0.4) / BEAM.lateral_fwhm_mm
    along = (FINE.axial_mm - y) / BEAM.axial_fwhm_mm
    expected = 0.5 ** (4 * (across**2 + along[:, None] ** 2))
    assert np.abs(amplitude - expected).max() < 0.01
    turn = np.exp(-4j * np.pi * y / BEAM.wavelength_mm)
    assert np.abs(frame / amplitude.clip(1e-9) - turn)[amplitude > 0.01].max() < 1e-3


def test_a_wire_of_a_sector_lies_on_its_line() -> None:
    """A convex probe sees a point at its angle and distance, with its width in angle."""
    angle, depth = 0.11, 14.23
    radius = SECTOR.radius_mm
    x, y = (radius + depth) * np.sin(angle), (radius + depth) * np.cos(angle) - radius
    frame = render_points(*point(x, y), CONVEX, SECTOR)
    row, column = peak_of(frame)
    assert row == pytest.approx((depth - 5.0) / 0.1, abs=PLACE_PX)
    assert column == pytest.approx((angle - SECTOR.angles_rad[0]) / 0.006, abs=PLACE_PX)
    peak = np.unravel_index(np.abs(frame).argmax(), frame.shape)
    in_angle = full_width(np.abs(frame[peak[0]]), 0.006)
    assert in_angle * (radius + CONVEX.sector_depth_mm) == pytest.approx(0.9, rel=0.02)
    turn = np.exp(-4j * np.pi * depth / CONVEX.wavelength_mm)
    assert abs(frame[peak] / abs(frame[peak]) - turn) < 1e-3


@pytest.mark.parametrize("depth", [9.0, 18.0, 26.0])
def test_a_wire_beside_the_plane_fades_as_the_slice_does(depth: float) -> None:
    """Two-way amplitude exp(-2 z^2 / w^2) and the phase of curved wavefronts."""
    here = render_points(*point(0.0, depth), BEAM, GRID)
    beside = render_points(*point(0.0, depth, 0.5), BEAM, GRID)
    rayleigh = np.pi * 0.6**2 / BEAM.wavelength_mm
    t = (depth - 18.0) / rayleigh
    ratio = np.vdot(here, beside) / np.vdot(here, here)
    assert abs(ratio) == pytest.approx(np.exp(-2 * 0.25 / (0.36 * (1 + t * t))), rel=1e-4)
    # The way to a point off the plane and back: z^2 / R longer.
    longer = 0.25 * (depth - 18.0) / ((depth - 18.0) ** 2 + rayleigh**2)
    expected = np.exp(-2j * np.pi * longer / BEAM.wavelength_mm)
    assert abs(ratio / abs(ratio) - expected) < 1e-3


def test_points_must_be_finite_numbers() -> None:
    """A point without a place is refused."""
    with pytest.raises(ScanError, match="finite"):
        render_points(*point(np.nan, 10.0), BEAM, GRID)


def wire_body(at_mm: tuple[float, float], spacing_mm: float = 0.25) -> Body:
    """Return silence with a wire along z."""
    body = block((20.0, 24.0, 12.0), spacing_mm)
    np.asarray(body.echogenicity)[:] = 0
    x = round((at_mm[0] - body.origin_mm[0]) / spacing_mm)
    y = round((at_mm[1] - body.origin_mm[1]) / spacing_mm)
    np.asarray(body.echogenicity)[:, y, x] = 240
    np.asarray(body.tissue)[:, y, x] = int(Tissue.TENDON)
    return body


ARTERIES = (PulsingArtery((0.5, 12.0), 1.5, 0.3), PulsingArtery((-2.0, 16.0), 1.0, -0.2))
WIRES_MM = [(0.125, 12.125), (1.125, 13.625), (-4.125, 18.125), (3.125, 10.625)]


def moved(x: float, y: float, deformation: Deformation) -> tuple[float, float]:
    """Return where a point of the plane comes to by the law of the deformation."""
    x, y = x + deformation.shift_mm[0], y + deformation.shift_mm[1]
    x, y = x * (1 + deformation.axial_strain / 2), y * (1 - deformation.axial_strain)
    dx = dy = 0.0
    for artery in deformation.arteries:
        u, v = x - artery.center_mm[0], y - artery.center_mm[1]
        r = np.hypot(u, v)
        inside = r <= artery.radius_mm
        push = artery.dilation_mm * (r / artery.radius_mm if inside else artery.radius_mm / r)
        dx, dy = dx + push * u / r, dy + push * v / r
    return x + dx, y + dy


@pytest.mark.parametrize(
    "deformation",
    [
        STILL,
        Deformation(axial_strain=0.1),
        Deformation(axial_strain=-0.05),
        Deformation(shift_mm=(0.7, -0.4, 0.9)),
        Deformation(arteries=ARTERIES),
        Deformation((0.3, 0.5, -0.2), 0.08, ARTERIES),
    ],
)
@pytest.mark.parametrize("at_mm", WIRES_MM)
def test_deformed_tissue_is_where_the_law_says(
    at_mm: tuple[float, float], deformation: Deformation
) -> None:
    """Shift, strain with bulging, and pulsating arteries move a wire's echo and its label."""
    body = wire_body(at_mm)
    x, y = moved(*at_mm, deformation)
    grid = PixelGrid(60, 60, (0.06, 0.06), (x - 1.77, y - 1.77))
    frames = [SpeckleRenderer(body, BEAM, grid, seed=s).iq(pose(), deformation) for s in range(12)]
    row, column = middle_of(np.mean(np.abs(frames) ** 2, axis=0))
    # Scatterers fill the voxel unevenly: a tenth of its 0.25 mm.
    assert row * 0.06 - 1.77 == pytest.approx(0, abs=0.04)
    assert column * 0.06 - 1.77 == pytest.approx(0, abs=0.04)
    fine = PixelGrid(81, 81, (0.02, 0.02), (x - 0.8, y - 0.8))
    label = sample_plane(body.tissue, body, pose(), fine, deformation) == int(Tissue.TENDON)
    rows, columns = np.nonzero(label)
    assert rows.mean() * 0.02 - 0.8 == pytest.approx(0, abs=0.03)
    assert columns.mean() * 0.02 - 0.8 == pytest.approx(0, abs=0.03)


def test_a_body_that_shifts_is_a_probe_that_moves_the_other_way() -> None:
    """Only the motion of the probe against the body can be seen."""
    renderer = SpeckleRenderer(block(), BEAM, GRID, seed=4)
    where = pose(0.2, 0.1, 0.4, (3, 5, -8))
    shifted = renderer.iq(where, Deformation(shift_mm=(0.3, -0.2, 0.5)))
    other = where.copy()
    other[:3, 3] -= (0.3, -0.2, 0.5)
    assert abs(correlation(shifted, renderer.iq(other))) > 1 - 1e-6


def test_planes_and_echoes_agree_on_where_tissue_ends() -> None:
    """Under any pose and deformation, echoes come from where the label says, in a sector too."""
    body = block((30.0, 30.0, 24.0), 0.25)
    middle = body.echogenicity.shape[2] // 2
    np.asarray(body.echogenicity)[:, :, :middle] = 0
    deformation = Deformation((0.3, 0.5, -0.2), 0.08, ARTERIES)
    where = pose(0.5, 1.0, 0.7, (6, -8, 11))
    for beam, grid in ((BEAM, GRID), (CONVEX, SECTOR)):
        echo = np.abs(SpeckleRenderer(body, beam, grid, seed=1).iq(where, deformation))
        code = sample_plane(body.echogenicity, body, where, grid, deformation)
        # Within a slice and a beam of the boundary both may be.
        margin = 6 if beam is BEAM else 10
        seen, silent = _eroded(code > 0, margin), _eroded(code == 0, margin)
        assert seen.sum() > 1500
        assert silent.sum() > 1500
        assert np.mean(echo[seen] ** 2) == pytest.approx(1, abs=0.15)
        assert np.mean(echo[silent] ** 2) < 0.02


def _eroded(mask: np.ndarray, by: int) -> np.ndarray:
    return binary_erosion(mask, iterations=by)


def test_labels_are_those_of_the_nearest_voxels() -> None:
    """Each pixel has the label of the voxel it is in; 0 outside; coarser rows on request."""
    body = block((12.0, 20.0, 8.0), 0.5)
    rng = np.random.default_rng(0)
    np.asarray(body.tissue)[:] = rng.integers(1, 12, body.tissue.shape)
    where = pose(1.0, 2.0, 0.3, (10, 20, 30))
    labels = sample_plane(body.tissue, body, where, GRID)
    x, y = np.meshgrid(GRID.lateral_mm, GRID.axial_mm)
    points = np.stack([x, y, 0 * x, 1 + 0 * x], -1) @ where.T
    voxel = np.floor((points[..., :3] - body.origin_mm) / 0.5 + 0.5).astype(int)
    size = np.array(body.tissue.shape[::-1])
    inside = ((voxel >= 0) & (voxel < size)).all(-1)
    nearest = body.tissue[tuple(np.moveaxis(np.clip(voxel, 0, size - 1), -1, 0)[::-1])]
    # Rounding decides pixels on the border of two voxels.
    assert np.mean(labels == np.where(inside, nearest, 0)) > 0.9999
    assert 0.15 < inside.mean() < 0.9
    coarse = sample_plane(body.tissue, body, where, GRID, axial_stride=4)
    assert (coarse == labels[::4]).all()


def test_a_volume_must_be_on_the_voxels_of_its_body() -> None:
    """A volume of another shape is refused."""
    body = block()
    with pytest.raises(ScanError, match="not on the voxels"):
        sample_plane(body.tissue[1:], body, pose(), GRID)
