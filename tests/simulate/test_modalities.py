"""Power Doppler, photoacoustics and IQ on the poses of a B-mode sweep."""

from dataclasses import replace

import numpy as np
import pytest

from sonosweep.errors import ScanError
from sonosweep.scan import Scan
from sonosweep.simulate import (
    Beam,
    Body,
    DopplerSettings,
    PhotoacousticSettings,
    Scanner,
    SweepSettings,
    Tissue,
    Vessel,
    simulate_sweep,
)
from sonosweep.simulate.echoes import SweepEchoes
from sonosweep.simulate.photoacoustic_frames import one_way_beam, photoacoustic_iq
from sonosweep.simulate.scanner import gray_levels
from sonosweep.simulate.sweep_frames import doppler_ensemble
from sonosweep.simulate.tissue_motion import body_to_plane
from tests.simulate.sweep_bodies import SMALL_GRID, arm, block, steady

SETTINGS = SweepSettings(
    900001,
    0,
    motion=steady(hand_unsteadiness=0.5),
    scanner=Scanner(noise_db=-80.0),
    grid=SMALL_GRID,
    modalities=("amplitude", "iq", "power_doppler", "photoacoustic"),
)
ROWS = np.arange(SMALL_GRID.rows)
FRAMES = (1, 6, 10)


@pytest.fixture(scope="module")
def body() -> Body:
    """Return an arm with an artery and a vein."""
    return arm()


@pytest.fixture(scope="module")
def scan(body: Body) -> Scan:
    """Return a sweep over it."""
    return simulate_sweep(SETTINGS, body)


def distance_to_axis(echoes: SweepEchoes, vessel: Vessel, frame: int) -> np.ndarray:
    """Return how far each pixel is from where the vessel crosses the image, mm."""
    time = float(echoes.times_s[frame])
    pose = echoes.pose_at(time)
    affine = body_to_plane(pose, echoes.deformation_at(time, pose))
    line = vessel.centerline_mm @ affine[:3, :3].T + affine[:3, 3]
    x, y, _ = line[np.abs(line[:, 2]).argmin()]
    return np.hypot(SMALL_GRID.lateral_mm - x, SMALL_GRID.axial_mm[:, np.newaxis] - y)


def test_power_doppler_shows_blood_and_nothing_else(scan: Scan, body: Body) -> None:
    """Lumens stand out by 15 dB from the noise, and all the rest stays black.

    The noise is 6 dB below black (gray 0), so that gray 77 of 255 in 30 dB is 15 dB above it.
    """
    echoes = SweepEchoes(SETTINGS, body)
    for frame in FRAMES:
        image = scan.companions["power_doppler"].frames[frame]
        away = [distance_to_axis(echoes, vessel, frame) for vessel in body.vessels]
        for vessel, distance in zip(body.vessels, away, strict=True):
            lumen = image[distance < 0.5 * vessel.radius_mm[0]]
            assert lumen.mean() > 77, (vessel.name, frame)
        # The slice is thick and vessels lean: half a millimeter beyond the wall.
        outside = np.min(away, axis=0) > 2.5
        skin = SMALL_GRID.axial_mm < 2.5
        assert (image[~skin][outside[~skin]] == 0).mean() > 0.999


def test_tissue_is_stronger_than_blood_by_40_to_60_db(body: Body) -> None:
    """The clutter filter gets a real task."""
    echoes = SweepEchoes(SETTINGS, body)
    ensemble = doppler_ensemble(echoes, 5)
    bloodless = replace(SETTINGS, doppler=DopplerSettings(blood_db=-200.0))
    silent = doppler_ensemble(SweepEchoes(bloodless, body), 5)
    away = distance_to_axis(echoes, body.vessels[0], 5)
    blood = (np.abs(ensemble - silent) ** 2)[:, away < 0.8].mean()
    deep = (away > 2) & (away < 4)
    clutter = (np.abs(ensemble) ** 2)[:, deep].mean()
    assert 40 < 10 * np.log10(clutter / blood) < 60
    assert ensemble.shape == (20, 96, 96)


def test_blood_passes_and_tissue_moves_slowly(body: Body) -> None:
    """From the first pulse to the last, 6.3 ms later, blood is renewed and tissue is not."""
    ensemble = doppler_ensemble(SweepEchoes(SETTINGS, body), 5)
    echoes = SweepEchoes(SETTINGS, body)
    away = distance_to_axis(echoes, body.vessels[0], 5)
    muscle = (away > 2) & (away < 4)
    quiet = replace(SETTINGS, doppler=DopplerSettings(blood_db=-200.0))
    blood = ensemble - doppler_ensemble(SweepEchoes(quiet, body), 5)
    assert coherence(ensemble[:, muscle]) > 0.9
    assert coherence(blood[:, away < 0.8]) < 0.5


def test_blood_that_has_passed_is_followed_by_other_blood(body: Body) -> None:
    """A vessel stays full though its blood passes the slice several times in an ensemble."""
    fast = [replace(vessel, mean_speed_mm_per_s=400.0) for vessel in body.vessels]
    body = replace(body, vessels=tuple(fast))
    quiet = replace(SETTINGS, doppler=DopplerSettings(blood_db=-200.0))
    full, empty = SweepEchoes(SETTINGS, body), SweepEchoes(quiet, body)
    power = np.zeros(20)
    for frame in range(2, 10):
        blood = doppler_ensemble(full, frame) - doppler_ensemble(empty, frame)
        away = distance_to_axis(full, body.vessels[0], frame)
        power += (np.abs(blood[:, away < 0.8]) ** 2).mean(axis=1)
    # Quarters of the ensemble, eight frames of some ten speckles: known to 15 %.
    quarters = power.reshape(4, 5).mean(axis=1) / power.mean()
    assert quarters == pytest.approx(np.ones(4), abs=0.4)


def test_an_ensemble_is_recorded_around_the_time_of_its_frame() -> None:
    """As many pulses before as after: power Doppler belongs to the pose, either way in time."""
    times = DopplerSettings().pulse_times_s
    assert len(times) == 20
    assert np.diff(times) == pytest.approx(np.full(19, 1 / 3000))
    assert times == pytest.approx(-times[::-1])


def coherence(pulses: np.ndarray) -> float:
    """Return the correlation of the first and the last pulse."""
    first, last = pulses[0], pulses[-1]
    power = np.linalg.norm(first) * np.linalg.norm(last)
    return float(np.abs(np.vdot(first, last)) / power)


def ladder() -> Body:
    """Return uniform vessels at many depths in a block without skin."""
    body = block()
    z = np.linspace(-12, 12, 49)
    vessels = []
    for k in range(7):
        line = np.stack([np.full(49, -9.0 + 3.0 * k), np.full(49, 3.0 + 3.0 * k), z], axis=1)
        vessels.append(Vessel(f"tube {k}", "vein", line, np.full(49, 1.2), 10.0))
    return replace(body, vessels=tuple(vessels))


def test_photoacoustic_amplitude_falls_with_the_light() -> None:
    """The same vessel d mm deeper is weaker by exp(-0.11 d)."""
    body, beam = ladder(), Beam()
    settings = PhotoacousticSettings(skin_db=-200.0, noise_db=-200.0)
    tissue = np.full((96, 96), int(Tissue.MUSCLE), np.uint8)
    power = np.zeros((96, 96))
    for seed in range(12):
        draws = np.random.default_rng(seed)
        iq = photoacoustic_iq(body, np.eye(4), tissue, SMALL_GRID, beam, settings, draws)
        power += np.abs(iq) ** 2 / 12
    depth, level = [], []
    for vessel in body.vessels:
        x, y = vessel.centerline_mm[0, :2]
        away = np.hypot(SMALL_GRID.lateral_mm - x, SMALL_GRID.axial_mm[:, np.newaxis] - y)
        depth.append(y)
        level.append(np.log(power[away < 0.8].mean()) / 2)
    slope = np.polyfit(depth, level, 1)[0]
    assert slope == pytest.approx(-0.11, abs=0.012)  # 12 frames of about 8 speckles each


def test_light_counts_from_the_skin() -> None:
    """Under a layer of gel the light is the same as without it."""
    body, beam = ladder(), Beam()
    settings = PhotoacousticSettings(skin_db=-200.0, noise_db=-200.0)
    bare = np.full((96, 96), int(Tissue.MUSCLE), np.uint8)
    under = bare.copy()
    under[:20] = int(Tissue.GEL)
    first, second = (
        photoacoustic_iq(
            body, np.eye(4), labels, SMALL_GRID, beam, settings, np.random.default_rng(1)
        )
        for labels in (bare, under)
    )
    ratio = np.abs(second[30:80, 20:80]).sum() / np.abs(first[30:80, 20:80]).sum()
    assert ratio == pytest.approx(np.exp(0.11 * 20 * 0.25), rel=1e-3)


def test_photoacoustic_vessels_lie_where_the_anatomy_has_them(scan: Scan, body: Body) -> None:
    """The brightness around a vessel is centered on its axis, which the pose predicts."""
    echoes = SweepEchoes(SETTINGS, body)
    images = scan.companions["photoacoustic"].frames
    errors = []
    for frame in range(len(images)):
        power = images[frame].astype(float) ** 2
        for vessel in body.vessels:
            away = distance_to_axis(echoes, vessel, frame)
            column, row = (index[0] for index in np.where(away.min() == away.T))
            part = np.where(away < 2.2, power, 0)
            x = (part * SMALL_GRID.lateral_mm).sum() / part.sum()
            errors.append(x - SMALL_GRID.lateral_mm[column])
            assert abs((part * ROWS[:, np.newaxis]).sum() / part.sum() - row) * 0.25 < 1.0
    # Each is the mean of about ten speckles 0.5 mm wide in a lumen 2.4 mm wide.
    assert abs(np.mean(errors)) < 0.15


def test_skin_draws_a_weaker_line_than_blood_in_the_same_light(scan: Scan) -> None:
    """Melanin shows as a line on the skin; blood, in its light, would outshine it."""
    image = np.mean([scan.companions["photoacoustic"].frames[k] for k in FRAMES], axis=0)
    assert image.dtype == np.float32
    light = np.exp(-0.11 * SMALL_GRID.axial_mm)[:, np.newaxis]
    skin, between, blood = image[:6].max(axis=0).mean(), image[12:20].mean(), (image / light)[20:]
    assert skin > 5 * between
    assert blood.max() > skin


def test_listening_only_makes_the_beam_wider_and_its_phase_slower() -> None:
    """One way instead of two."""
    two, one = Beam(), one_way_beam(Beam())
    assert one.wavelength_mm == pytest.approx(2 * two.wavelength_mm)
    for name in ("lateral_fwhm_mm", "elevation_waist_mm"):
        assert getattr(one, name) == pytest.approx(np.sqrt(2) * getattr(two, name))


def test_amplitude_is_the_magnitude_of_iq_and_gives_the_image(scan: Scan) -> None:
    """Without persistence and speckle reduction all three are the same frame."""
    for frame in FRAMES:
        iq = scan.companions["iq"].frames[frame]
        amplitude = scan.companions["amplitude"].frames[frame]
        assert iq.shape == (96, 96, 2)
        assert iq.dtype == amplitude.dtype == np.float32
        assert np.allclose(np.hypot(iq[..., 0], iq[..., 1]), amplitude, rtol=1e-5)
        assert np.array_equal(gray_levels(amplitude, SETTINGS.scanner), scan.frames[frame])


def test_companions_lie_on_the_grid_of_the_image(scan: Scan) -> None:
    """Each has as many frames and pixels, of the same size and in the same place."""
    assert scan.calibration is not None
    assert set(scan.companions) == {"amplitude", "iq", "power_doppler", "photoacoustic"}
    for companion in scan.companions.values():
        assert companion.frames.shape[:3] == scan.frames.shape
        assert companion.spacing_mm == scan.calibration.spacing_mm
        assert companion.origin_mm == (0.0, 0.0)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: DopplerSettings(pulses=1), "at least 2 pulses, got 1"),
        (lambda: DopplerSettings(dynamic_range_db=0.0), "dynamic_range_db of power Doppler"),
        (lambda: DopplerSettings(blood_db=float("nan")), "blood_db of power Doppler"),
        (lambda: PhotoacousticSettings(fluence_per_mm=-0.1), "fading light"),
    ],
)
def test_impossible_settings_are_refused(make, message: str) -> None:
    """One sentence says what is wrong."""
    with pytest.raises(ScanError, match=message):
        make()
