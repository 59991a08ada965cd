"""Speckle decorrelates, and is distributed, as physics says; frames depend on their pose alone."""

import pickle
import tracemalloc

import numpy as np
import pytest
from scipy import stats
from scipy.ndimage import map_coordinates

from sonosweep.errors import ScanError
from sonosweep.imaging import PAPER_GRID, PixelGrid, SectorGrid, centered_grid
from sonosweep.simulate import Beam, PulsingArtery
from sonosweep.simulate.deformation import Deformation
from sonosweep.simulate.medium import CELL_MM, SETS, Medium, hash_cell
from sonosweep.simulate.point_spread import point_spread
from sonosweep.simulate.slab import CellRoom, cell_table, seen_cells, slab_of
from sonosweep.simulate.speckle import SpeckleRenderer
from sonosweep.simulate.tissue_motion import body_to_plane
from tests.estimators.speckle import ELEVATIONAL_MM
from tests.estimators.speckle import Medium as WaveMedium
from tests.simulate.speckle_bodies import block, correlation, pose

BEAM = Beam()
AXIAL_DEVIATION_MM = BEAM.axial_fwhm_mm / 2.35482
LATERAL_DEVIATION_MM = BEAM.lateral_fwhm_mm / 2.35482
SMALL = centered_grid(60, 50, (0.1484, 0.1484), 16.0)
CURVE_TOLERANCE = 0.03
"""Of a correlation, asked of the simulator; the mean of four places is known to 0.01."""


def curve(beam: Beam, first_depth_mm: float, distances_mm: list[float]) -> np.ndarray:
    """Return the complex correlation of frames by elevational distance, mean of places."""
    grid = centered_grid(150, 40, (0.1484, 0.1484), first_depth_mm)
    body = block((26.0, first_depth_mm + 8, 22.0))
    sums = np.zeros(len(distances_mm), complex)
    for seed in range(4):
        renderer = SpeckleRenderer(body, beam, grid, seed=seed)
        frame = renderer.iq(pose(z=-0.7))
        sums += [correlation(frame, renderer.iq(pose(z=d - 0.7))) for d in distances_mm]
    return sums / 4


@pytest.mark.parametrize("first_depth_mm", [3.0, 15.0, 30.0])
@pytest.mark.parametrize("waist_mm", [0.5, 0.6, 0.75])
def test_speckle_decorrelates_alike_at_every_depth(first_depth_mm: float, waist_mm: float) -> None:
    """The wavefronts are curved where the slice is wide: exp(-d^2 / w0^2) everywhere."""
    distances = [0.05, 0.1, 0.2, 0.4, 0.6, 0.8, 1.0]
    found = curve(Beam(elevation_waist_mm=waist_mm), first_depth_mm, distances)
    expected = np.exp(-((np.array(distances) / waist_mm) ** 2))
    assert np.abs(np.abs(found) - expected).max() < CURVE_TOLERANCE


def test_both_elevational_directions_look_alike() -> None:
    """Two frames of speckle cannot tell whether the probe moved forward or backward."""
    forward = curve(BEAM, 15.0, [0.1, 0.3, 0.5])
    backward = curve(BEAM, 15.0, [-0.1, -0.3, -0.5])
    assert np.abs(np.abs(forward) - np.abs(backward)).max() < CURVE_TOLERANCE
    # No phase on average either, which would have a sign.
    assert np.abs(np.angle(forward)).max() < 0.1
    assert np.abs(np.angle(backward)).max() < 0.1


def test_frames_do_not_show_where_the_cells_of_the_medium_begin() -> None:
    """Tissue has no lattice: the echoes' power does not follow the place in a cell."""
    body = block((26.0, 14.0, 22.0))
    grid = centered_grid(150, 80, (0.1484, 0.1484), 1.0)
    renderers = [SpeckleRenderer(body, BEAM, grid, seed=seed) for seed in range(6)]
    shifts = np.arange(8) / 8 * CELL_MM
    power = [np.mean([np.abs(r.iq(pose(z=z))) ** 2 for r in renderers]) for z in shifts]
    # Each mean is of 6 frames of about 2000 independent samples: known to 0.01.
    assert np.ptp(power) < 0.06
    assert np.mean(power) == pytest.approx(1, abs=0.03)


def independent_amplitudes(seed: int) -> np.ndarray:
    """Return samples of one frame that are 2.7 axial or 2.2 lateral widths apart or more.

    Their complex correlation is below 0.002.
    """
    renderer = SpeckleRenderer(block((44.0, 44.0, 16.0), 1.0), BEAM, PAPER_GRID, seed=seed)
    return np.abs(renderer.iq(pose()))[2::3, 2::5].ravel()


def test_amplitudes_have_rayleigh_statistics() -> None:
    """Many scatterers per resolution cell give a Rayleigh law of known scale (mean power 1).

    Six media. Each frame has 4335 samples: a Kolmogorov-Smirnov test at 5 % that rejects one
    true law in twenty may reject one of six (more with probability 0.03).
    """
    frames = [independent_amplitudes(seed) for seed in range(900_000, 900_006)]
    law = stats.rayleigh(scale=np.sqrt(0.5)).cdf
    rejected = sum(stats.kstest(samples, law).pvalue < 0.05 for samples in frames)
    samples = np.concatenate(frames)
    assert rejected <= 1
    assert samples.mean() / samples.std() == pytest.approx(1.913, abs=0.05)
    # <I^2> / <I>^2 is 2 for infinitely many; 11 to 16 scatterers per cell add 0.05 to 0.08.
    assert np.mean(samples**4) / np.mean(samples**2) ** 2 == pytest.approx(2.06, abs=0.05)


def turned_correlation(degrees: float, seed: int) -> tuple[float, float]:
    """Return the complex and the amplitude correlation of a frame and one turned in plane."""
    grid = centered_grid(200, 200, (0.06, 0.05), 13.0)
    renderer = SpeckleRenderer(block((20.0, 28.0, 12.0)), BEAM, grid, seed=seed)
    about = pose(y=18.0)
    turn = about @ pose(degrees=(0, 0, degrees)) @ np.linalg.inv(about)
    x, y = np.meshgrid(np.arange(-3.6, 3.6, 0.06), np.arange(14.4, 21.6, 0.05))
    there = np.stack([x, y, 0 * x, 1 + 0 * x], axis=-1) @ turn.T
    one = _echo_at(renderer.iq(pose()), grid, there[..., 0], there[..., 1])
    other = _echo_at(renderer.iq(turn), grid, x, y)
    amplitude = np.corrcoef(np.abs(one).ravel(), np.abs(other).ravel())[0, 1]
    return abs(correlation(one, other)), amplitude


def _echo_at(iq: np.ndarray, grid: PixelGrid, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    at = [
        (y - grid.origin_mm[1]) / grid.spacing_mm[1],
        (x - grid.origin_mm[0]) / grid.spacing_mm[0],
    ]
    here = map_coordinates(iq.real, at) + 1j * map_coordinates(iq.imag, at)
    return here * np.exp(4j * np.pi * y / BEAM.wavelength_mm)


@pytest.mark.parametrize(("degrees", "expected"), [(2, 0.97), (5, 0.87), (10, 0.65)])
def test_speckle_decorrelates_when_the_probe_turns_in_its_plane(
    degrees: float, expected: float
) -> None:
    """Turning moves the spectrum: echoes of one place differ though it is re-registered."""
    found = np.mean([turned_correlation(degrees, seed)[0] for seed in range(4)])
    assert found == pytest.approx(expected, abs=0.03)
    # Overlap of the spectra, Gaussian across the beam, after a turn.
    moved = 4 * np.pi / BEAM.wavelength_mm * np.deg2rad(degrees)
    assert found == pytest.approx(np.exp(-((moved * LATERAL_DEVIATION_MM / 2) ** 2)), abs=0.02)


def test_amplitudes_decorrelate_as_those_of_a_field_of_plane_waves() -> None:
    """An exact Gaussian field of the same elevational width decorrelates alike."""
    distances = [0.1, 0.2, 0.3, 0.45]
    grid = centered_grid(100, 100, (0.15, 0.15), 10.0)
    ours, exact = [], []
    for seed in range(3):
        renderer = SpeckleRenderer(
            block((20.0, 28.0, 8.0)), Beam(elevation_waist_mm=ELEVATIONAL_MM), grid, seed=seed
        )
        waves = WaveMedium(seed)
        ours.append(_amplitude_curve(lambda z, r=renderer: np.abs(r.iq(pose(z=z))), distances))
        exact.append(
            _amplitude_curve(lambda z, w=waves: w.amplitude(pose(z=z), 100, 100), distances)
        )
    assert np.abs(np.mean(ours, 0) - np.mean(exact, 0)).max() < CURVE_TOLERANCE


def _amplitude_curve(frame, distances: list[float]) -> list[float]:
    first = frame(0.0).ravel()
    return [np.corrcoef(first, frame(d).ravel())[0, 1] for d in distances]


def test_a_place_looks_the_same_however_it_is_reached() -> None:
    """The medium is fixed in the body: a frame depends on its pose, not on what came before."""
    body = block()
    place = pose(0.3, 0.4, 1.2, (3, -4, 5))
    forth = SpeckleRenderer(body, BEAM, SMALL, seed=1)
    back = SpeckleRenderer(body, BEAM, SMALL, seed=1)
    for step in range(4):
        forth.iq(pose(z=step * 0.3, degrees=(step, 0, 0)))
        back.iq(pose(x=-step, z=4 - step * 0.7, degrees=(0, 20 * step, 90 - 20 * step)))
    assert forth.iq(place).tobytes() == back.iq(place).tobytes()
    assert pickle.loads(pickle.dumps(back)).iq(place).tobytes() == forth.iq(place).tobytes()


def test_a_probe_turned_round_sees_the_mirrored_frame() -> None:
    """From behind, the same plane is the same speckle, left and right exchanged."""
    renderer = SpeckleRenderer(block(), BEAM, SMALL, seed=1)
    place = pose(0.3, 0.4, 1.2, (3, -4, 5))
    before, behind = renderer.iq(place), renderer.iq(place @ pose(degrees=(0, 180, 0)))
    assert abs(correlation(before, behind[:, ::-1])) > 1 - 1e-5
    assert abs(correlation(before, behind)) < 0.1


def test_frames_that_cross_agree_where_they_meet() -> None:
    """Echoes of one line, seen across and along the arm, share the scatterers of both slices.

    At the focus both point spread functions are Gaussian, lateral and elevational deviations
    exchanged, so that their overlap is 2 s t / (s^2 + t^2). The mean of 170 lines of 11 widths
    of the pulse is known to 0.01.
    """
    across, along = [], []
    column = PixelGrid(1, 14, (0.15, 0.15), (0.0, 17.0))
    for seed in (3, 4):
        renderer = SpeckleRenderer(block((26.0, 26.0, 26.0)), BEAM, column, seed=seed)
        for x in range(-8, 9):
            for z in range(-6, 7, 3):
                across.append(renderer.iq(pose(x=x, z=z)))
                along.append(renderer.iq(pose(x=x, z=z, degrees=(0, 90, 0))))
    lateral, elevational = LATERAL_DEVIATION_MM, BEAM.elevation_waist_mm / 2
    overlap = 2 * lateral * elevational / (lateral**2 + elevational**2)
    found = correlation(np.array(across), np.array(along))
    assert abs(found) == pytest.approx(overlap, abs=0.04)
    assert abs(np.angle(found)) < 0.05


def test_seeds_give_unrelated_media() -> None:
    """Two seeds share no speckle; the correlation of n independent samples is 1 / sqrt(n)."""
    frames = [SpeckleRenderer(block(), BEAM, SMALL, seed=seed).iq(pose()) for seed in (1, 2)]
    assert abs(correlation(*frames)) < 0.1


@pytest.mark.slow
def test_speckle_never_repeats() -> None:
    """Far planes are unrelated: no distance correlates beyond what chance does.

    Frames of 120 x 100 pixels have about 4300 independent samples, so that |correlation| has
    the mean 0.0135 and exceeds 0.05 once in 50,000 times.
    """
    grid = centered_grid(120, 100, (0.1484, 0.1484), 12.0)
    body = block((20.0, 30.0, 220.0), 1.0)
    renderer = SpeckleRenderer(body, BEAM, grid, seed=3)
    first = renderer.iq(pose(z=-100.0))
    far = [abs(correlation(first, renderer.iq(pose(z=-100 + CELL_MM * k)))) for k in range(2, 122)]
    assert max(far) < 0.06
    assert np.mean(far) == pytest.approx(0.0135, abs=0.004)


def test_cells_differ_in_what_they_hold() -> None:
    """Neighbouring cells, and the same cell of another seed, are chosen independently."""
    places = np.stack(np.meshgrid(*[np.arange(-8, 8)] * 3), -1).reshape(-1, 3)
    words = [Medium(seed).word for seed in (0, 1)]
    chosen = np.array([[hash_cell(*place, word) for place in places] for word in words])
    for bits in (chosen % SETS, chosen // SETS % 8, chosen >> 12 & 255):
        counts = [np.bincount(row) for row in bits]
        assert min(stats.chisquare(count).pvalue for count in counts) > 1e-3
        assert np.mean(bits[0] == bits[1]) == pytest.approx(1 / len(counts[0]), abs=0.02)


def test_power_is_one_for_every_beam() -> None:
    """Focus, frequency and width are no gain: code 200 has mean power 1 for any of them."""
    body = block((40.0, 40.0, 24.0), 1.0)
    sector = SectorGrid(80, 300, 0.008, 0.1, 1.0, 40.0)
    narrow = centered_grid(200, 220, (0.1484, 0.1484), 1.0)
    convex = Beam(3.5e6, 0.35, 0.9, 1.3, 30.0, 1540.0, 40.0)
    pairs: list[tuple[Beam, PixelGrid | SectorGrid]] = [
        (Beam(8e6, 0.14, 0.25, 0.5, 25.0), narrow),
        (Beam(5e6, 0.3, 0.5, 0.75, 10.0), narrow),
        (convex, sector),
    ]
    for beam, grid in pairs:
        frames = [SpeckleRenderer(body, beam, grid, seed=s).iq(pose()) for s in (1, 2, 3, 4)]
        power = np.mean(np.abs(frames) ** 2, axis=(0, 2))
        thirds = [part.mean() for part in np.array_split(power, 3)]
        # Each is of some 1500 independent samples or more.
        assert thirds == pytest.approx([1, 1, 1], abs=0.1)


def test_echoes_are_the_sum_over_all_scatterers() -> None:
    """Every frame equals the sum of the scatterers' point spread functions, done directly."""
    body = block((12.0, 26.0, 12.0), 0.5)
    np.asarray(body.echogenicity)[:] = np.random.default_rng(3).integers(
        120, 220, body.echogenicity.shape
    )
    grid = centered_grid(20, 24, (0.1484, 0.1484), 11.0)
    where = pose(0.2, 0.3, 0.4, (5, -6, 7))
    rendered = SpeckleRenderer(body, BEAM, grid, seed=5).iq(where)
    expected = direct_sum(body, grid, where, seed=5)
    # Splatting to fine pixels leaves 2e-4 of the power.
    assert abs(correlation(rendered, expected)) > 0.9997
    assert np.linalg.norm(rendered) == pytest.approx(np.linalg.norm(expected), rel=0.01)


def direct_sum(body, grid: PixelGrid, where: np.ndarray, seed: int) -> np.ndarray:
    """Return a frame by the formula, in double precision, of the scatterers that count."""
    spread, medium = point_spread(grid, BEAM), Medium(seed)
    affine = body_to_plane(where, Deformation())
    slab, table = slab_of(BEAM, spread), cell_table(body)
    cells = seen_cells(slab, table, medium.sets.first, medium.word, affine, 0.0, CellRoom())
    frame = np.zeros((grid.rows, grid.columns), complex)
    wavenumber, waist = 2 * np.pi / BEAM.wavelength_mm, BEAM.elevation_waist_mm
    rayleigh = wavenumber * waist**2 / 2
    for place, (most, top, slope) in zip(cells.place, cells.gain, strict=True):
        first = medium.sets.first[place[3]]
        offsets = medium.sets.offsets_mm[:, first : first + place[5]].T.astype(float)
        points = (place[:3] + 0.5) * CELL_MM + offsets * (1 - 2 * (place[4] >> np.arange(3) & 1))
        voxel = np.rint((points - body.origin_mm) / body.spacing_mm).astype(int)
        size = np.array(body.echogenicity.shape[::-1])
        inside = ((voxel >= 0) & (voxel < size)).all(1)
        codes = body.echogenicity[tuple(np.clip(voxel, 0, size - 1).T[::-1])]
        amplitude = 10 ** ((codes - 200.0) / 80) * inside / np.sqrt(266)
        amplitude *= np.minimum(most, top - slope * np.arange(len(points)))
        x, y, z = ((points - where[:3, 3]) @ where[:3, :3]).T
        below = y - BEAM.elevation_focus_mm
        width = waist * np.hypot(1, below / rayleigh)
        path = 2 * y + z**2 * below / (below**2 + rayleigh**2)
        echo = amplitude * np.exp(-2 * (z / width) ** 2 - 1j * wavenumber * path)
        axial = np.exp(-0.5 * ((grid.axial_mm[:, None] - y) / AXIAL_DEVIATION_MM) ** 2)
        lateral = np.exp(-0.5 * ((grid.lateral_mm[:, None] - x) / LATERAL_DEVIATION_MM) ** 2)
        frame += (axial * echo) @ lateral.T
    widths = waist * np.hypot(1, (grid.axial_mm - BEAM.elevation_focus_mm) / rayleigh)
    cell = AXIAL_DEVIATION_MM * LATERAL_DEVIATION_MM * widths / 2 * np.pi**1.5
    return frame / np.sqrt(cell)[:, None]


def test_what_no_pixel_can_hear_is_silent() -> None:
    """Outside the voxels, in code 0 and above the array's face there is no echo."""
    body = block((12.0, 10.0, 8.0))
    np.asarray(body.echogenicity)[:, :, 12:] = 0
    grid = centered_grid(120, 90, (0.1484, 0.1484), -2.0)
    frame = np.abs(SpeckleRenderer(body, BEAM, grid, seed=2).iq(pose(y=-1.0)))
    x, depth = grid.lateral_mm, grid.axial_mm
    margin = 0.8
    heard = np.ix_((depth > 1 + margin) & (depth < 11 - margin), (x > -6 + margin) & (x < -margin))
    assert (frame[heard] > 0).all()
    assert frame[:, x > margin].max() == 0
    assert frame[:, x < -6 - margin].max() == 0
    assert frame[depth < 1 - margin].max() == 0
    beside = SpeckleRenderer(body, BEAM, grid, seed=2).iq(pose(z=300.0))
    assert np.abs(beside).max() == 0
    # With the face inside the body, nothing behind it is heard.
    inside = np.abs(SpeckleRenderer(body, BEAM, grid, seed=2).iq(pose(y=5.0)))
    assert inside[depth < -margin].max() == 0
    assert inside[depth > margin].max() > 0


def test_a_renderer_needs_little_memory() -> None:
    """Beside the body's arrays a renderer of full frames holds less than 20 MB."""
    body = block((40.0, 40.0, 20.0), 0.5)
    SpeckleRenderer(body, BEAM, SMALL, seed=0).iq(pose())
    tracemalloc.start()
    try:
        renderer = SpeckleRenderer(body, BEAM, PAPER_GRID, seed=0)
        for step in range(3):
            renderer.iq(pose(z=step, degrees=(10 * step, 0, 0)))
        assert tracemalloc.get_traced_memory()[1] < 20e6
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    ("beam", "seed", "density", "said"),
    [
        (BEAM, -1, 266.0, "seed"),
        (BEAM, 1, 0.1, "scatterers per mm3"),
        (BEAM, 1, float("nan"), "scatterers per mm3"),
        (Beam(curvature_radius_mm=40.0), 1, 266.0, "flat face"),
    ],
)
def test_a_renderer_says_what_does_not_fit(
    beam: Beam, seed: int, density: float, said: str
) -> None:
    """A wrong medium or probe is named in one sentence."""
    with pytest.raises(ScanError, match=said):
        SpeckleRenderer(block(), beam, SMALL, seed=seed, density_per_mm3=density)


@pytest.mark.parametrize("wrong", [np.zeros((4, 4)), np.diag([1.0, 1, -1, 1]), np.eye(4) * np.nan])
def test_a_pose_must_be_a_rotation_and_a_shift(wrong: np.ndarray) -> None:
    """A mirrored, empty or unknown pose is refused."""
    with pytest.raises(ScanError, match="rotation and a shift"):
        SpeckleRenderer(block(), BEAM, SMALL, seed=0).iq(wrong)


def test_a_frame_that_needs_too_much_memory_is_refused() -> None:
    """A sampling far finer than the frame can hold is named before memory is used."""
    with pytest.raises(ScanError, match="fine pixels"):
        SpeckleRenderer(block(), BEAM, centered_grid(9000, 9000, (0.1, 0.1)), seed=0)


def test_a_sector_has_a_front() -> None:
    """Lines that point sideways or back are no image of a convex probe."""
    with pytest.raises(ScanError, match="sector of 190 degrees"):
        SpeckleRenderer(block(), BEAM, SectorGrid(20, 30, np.pi / 18, 0.2, 0.0, 40.0), seed=0)


def test_pulsating_arteries_at_rest_change_nothing() -> None:
    """A dilation of 0 is no deformation, to the bit."""
    renderer = SpeckleRenderer(block(), BEAM, SMALL, seed=0)
    rest = Deformation(arteries=(PulsingArtery((0.0, 18.0), 1.0, 0.0),))
    assert renderer.iq(pose(), rest).tobytes() == renderer.iq(pose()).tobytes()
