"""Channel data of a sweep: what stays, what flows and what sends sound when lit."""

from dataclasses import replace

import numpy as np
import pytest

from sonosweep.errors import ScanError
from sonosweep.scan import ChannelSweep, modalities
from sonosweep.simulate import Acquisition, Beam, ChannelSweepSettings, simulate_channel_sweep
from sonosweep.simulate.channel_sweep import blood_velocity
from sonosweep.simulate.probes import linear_probe_l11_5v
from tests.simulate.bodies import tube

PROBE = linear_probe_l11_5v(24)
SMALL = ChannelSweepSettings(
    angles_rad=(-0.1, 0.1),
    pulses=4,
    density_per_mm3=2.0,
    noise=0.0,
    acquisition=Acquisition(samples=600, beam=Beam()),
)


def along_arm(*places_mm: float) -> np.ndarray:
    """Return poses of planes across the arm."""
    poses = np.tile(np.eye(4), (len(places_mm), 1, 1))
    poses[:, 2, 3] = places_mm
    return poses


def sweep_of_tube(seed: int = 900_001, **changes: object) -> ChannelSweep:
    """Return a sweep to a place, away and back."""
    settings = replace(SMALL, **changes)  # type: ignore[arg-type]
    return simulate_channel_sweep(tube(), along_arm(1.0, 3.0, 1.0), PROBE, settings, seed)


def samples(sweep: ChannelSweep, modality: str, frame: int) -> np.ndarray:
    """Return one frame's samples as doubles."""
    return np.asarray(modalities(sweep)[modality].samples[frame], np.float64)


def test_modalities_are_interleaved() -> None:
    """Each frame has plane waves, an ensemble and a laser shot in the same pose."""
    sweep = sweep_of_tube()
    shapes = {name: data.samples.shape for name, data in modalities(sweep).items()}
    assert shapes == {
        "b_mode": (3, 2, 24, 600),
        "power_doppler": (3, 4, 24, 600),
        "photoacoustic": (3, 1, 24, 600),
    }
    assert sweep.photoacoustic is not None
    assert sweep.photoacoustic.transmit_delays_s is None
    assert sweep.image_to_reference is not None
    assert sweep.subject == "simulated-900001"


@pytest.mark.parametrize("modality", ["b_mode", "power_doppler", "photoacoustic"])
def test_a_seed_fixes_the_samples(modality: str) -> None:
    """The same seed gives the same bytes, read in any order; another seed gives others."""
    first, again, other = sweep_of_tube(), sweep_of_tube(), sweep_of_tube(seed=900_002)
    samples(again, modality, 2)
    np.testing.assert_array_equal(samples(first, modality, 1), samples(again, modality, 1))
    assert not np.array_equal(samples(first, modality, 1), samples(other, modality, 1))


def test_tissue_stays_and_blood_is_new() -> None:
    """Back at a place the echoes of tissue are the same; only blood, 30 dB weaker, is not."""
    sweep = sweep_of_tube()
    here, away, back = (samples(sweep, "b_mode", frame) for frame in range(3))
    assert np.corrcoef(here.ravel(), back.ravel())[0, 1] > 0.999
    assert not np.array_equal(here, back)
    assert abs(np.corrcoef(here.ravel(), away.ravel())[0, 1]) < 0.1  # two slices apart


def test_blood_moves_within_an_ensemble() -> None:
    """From pulse to pulse only echoes of the vessel's depth and time of flight change."""
    still_probe = simulate_channel_sweep(tube(), along_arm(3.0), PROBE, SMALL, 900_001)
    ensemble = samples(still_probe, "power_doppler", 0)
    change = np.abs(np.diff(ensemble, axis=0)).max(axis=(0, 1))
    depth_mm = np.arange(600) / SMALL.acquisition.sampling_frequency_hz * 1540e3 / 2
    # Within the slice the vessel lies 6.3 to 9.7 mm deep; echoes to elements aside come later.
    assert change[depth_mm < 6.0].max() == 0
    assert change[(depth_mm > 7) & (depth_mm < 9)].max() > 1e-4


def test_blood_that_has_passed_is_followed_by_other_blood() -> None:
    """A vessel stays full though its blood flows through the slice within an ensemble."""
    body = tube()
    fast = replace(body.vessels[0], mean_speed_mm_per_s=600.0)
    pulses = replace(SMALL, pulses=16)
    sweep = simulate_channel_sweep(
        replace(body, vessels=(fast,)), along_arm(*[3.0] * 8), PROBE, pulses, 900_001
    )
    ensembles = np.stack([samples(sweep, "power_doppler", frame) for frame in range(8)])
    blood = ensembles - ensembles.mean(axis=(0, 1))  # tissue stays
    power = (blood**2).sum(axis=(0, 2, 3))
    # Without blood that comes in 0.63 of it would be left.
    assert power[-4:].sum() > 0.8 * power[:4].sum()


def test_light_fades_with_depth() -> None:
    """Without fading of the light the vessel sounds louder by exp(0.11 / mm * depth)."""
    faded, even = sweep_of_tube(), sweep_of_tube(fluence_per_mm=0.0)
    ratio = np.linalg.norm(samples(even, "photoacoustic", 1)) / np.linalg.norm(
        samples(faded, "photoacoustic", 1)
    )
    shallow, deep = np.exp(0.11 * 6.5), np.exp(0.11 * 9.5)
    assert shallow < ratio < deep


def test_skin_sounds_first() -> None:
    """Skin at the face is heard at once, blood after the one-way time to its depth."""
    sweep = simulate_channel_sweep(tube(skin_mm=1.0), along_arm(3.0), PROBE, SMALL, 900_001)
    heard = np.abs(samples(sweep, "photoacoustic", 0)[0, 12])
    depth_mm = np.arange(600) / SMALL.acquisition.sampling_frequency_hz * 1540e3
    assert heard[depth_mm < 1].max() > 10 * heard[(depth_mm > 4) & (depth_mm < 6)].max()
    assert heard[(depth_mm > 6.5) & (depth_mm < 9)].max() > 0


def test_flow_has_its_mean_speed() -> None:
    """Over the cross-section Poiseuille flow has the mean speed and goes along the vessel."""
    body = tube()
    vessel = body.vessels[0]
    along = np.diff(vessel.centerline_mm[[0, -1]], axis=0)[0]
    along /= np.linalg.norm(along)
    aside = np.cross(along, [1.0, 0.0, 0.0])
    aside /= np.linalg.norm(aside)
    radius = vessel.radius_mm[0] * np.sqrt((np.arange(200) + 0.5) / 200)  # equal areas
    points = vessel.centerline_mm[20] + radius[:, None] * aside
    velocities = blood_velocity(body.vessels, points)
    np.testing.assert_allclose(velocities.mean(0), vessel.mean_speed_mm_per_s * along, rtol=1e-9)
    assert blood_velocity((), points).any() == np.False_


@pytest.mark.parametrize("modality", ["b_mode", "power_doppler", "photoacoustic"])
def test_every_sample_has_its_noise(modality: str) -> None:
    """Electronic noise has the standard deviation asked for and is new in each frame."""
    quiet, noisy = sweep_of_tube(), sweep_of_tube(noise=1e-3)
    first, last = (
        samples(noisy, modality, k) - samples(quiet, modality, k) for k in range(0, 3, 2)
    )
    assert first.std() == pytest.approx(1e-3, rel=0.05)  # 14 400 samples or more
    assert abs(np.corrcoef(first.ravel(), last.ravel())[0, 1]) < 0.05


def test_sweeps_that_cannot_be() -> None:
    """A sweep beside the body, one without a beam, and one too large are refused."""
    flat, dense = replace(SMALL, acquisition=Acquisition()), replace(SMALL, density_per_mm3=1e5)
    with pytest.raises(ScanError, match="outside of phantom 'tube'"):
        simulate_channel_sweep(tube(), along_arm(50.0), PROBE, SMALL)
    with pytest.raises(ScanError, match="beam"):
        simulate_channel_sweep(tube(), along_arm(1.0), PROBE, flat)
    with pytest.raises(ScanError, match="density_per_mm3 smaller"):
        simulate_channel_sweep(tube(), along_arm(1.0), PROBE, dense)
    with pytest.raises(ScanError, match="frame rate must be above 0"):
        replace(SMALL, frame_rate_hz=0.0)
    with pytest.raises(ScanError, match="noise of a sample must be 0 or more"):
        replace(SMALL, noise=-1.0)
    apart = simulate_channel_sweep(tube(), along_arm(1.0, 50.0), PROBE, SMALL)
    with pytest.raises(ScanError, match="frame 1 of the sweep lies outside"):
        samples(apart, "b_mode", 1)
