"""Channel data of point scatterers against the formulas, written out."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import hilbert

from sonosweep.errors import ScanError
from sonosweep.scan import ChannelData
from sonosweep.simulate import Beam
from sonosweep.simulate.channels import (
    Acquisition,
    plane_wave_delays,
    simulate_ensemble,
    simulate_photoacoustic,
    simulate_plane_waves,
)
from sonosweep.simulate.probes import linear_probe_l11_5v

PROBE = linear_probe_l11_5v(16)
SPEED = 1540e3  # mm/s
FREQUENCY = 7.6e6
SHORT = Acquisition(samples=700, directivity=False)
SINGLE_PRECISION = 3e-6  # of the peak: samples are float32, the pulse is cut at 1e-6


def written_out(
    points: np.ndarray,
    amplitudes: np.ndarray,
    angles: np.ndarray | None,
    recording: Acquisition,
) -> np.ndarray:
    """Return what the elements receive, from the definitions alone."""
    elements = PROBE.element_positions_mm.numpy()
    times = recording.start_time_s + np.arange(recording.samples) / recording.sampling_frequency_hz
    sigma = math.sqrt(2 * math.log(2)) / (math.pi * recording.fractional_bandwidth * FREQUENCY)
    waves = [None] if angles is None else list(angles)
    received = np.zeros((len(waves), len(elements), recording.samples))
    for w, angle in enumerate(waves):
        for e, element in enumerate(elements):
            for point, amplitude in zip(points, amplitudes, strict=True):
                distance = float(np.linalg.norm(point - element))
                path, heard = distance, amplitude / distance
                if angle is not None:
                    direction = np.array([math.sin(angle), math.cos(angle), 0.0])
                    path += point @ direction - (elements @ direction).min()
                if recording.directivity:
                    sine = (point[0] - element[0]) / distance
                    width = PROBE.element_width_mm * FREQUENCY / SPEED
                    heard *= float(np.sinc(width * sine)) * (point[1] - element[1]) / distance
                late = times - path / SPEED
                envelope = np.exp(-0.5 * (late / sigma) ** 2)
                received[w, e] += heard * envelope * np.cos(2 * math.pi * FREQUENCY * late)
    return received


def scatterers(count: int = 20) -> tuple[np.ndarray, np.ndarray]:
    """Return some in front of the array, in the recorded depth and beyond."""
    random = np.random.default_rng(8)
    low, high = [-4.0, 0.5, -1.0], [4.0, 20.0, 1.0]
    return random.uniform(low, high, (count, 3)), random.normal(size=count)


@pytest.mark.parametrize("directivity", [False, True])
def test_echoes_are_delayed_pulses(directivity: bool) -> None:
    """Each echo is the pulse, late by the way there and back, weaker by 1 / r and angle."""
    points, amplitudes = scatterers()
    angles = np.deg2rad([-12.0, 0.0, 7.0])
    recording = replace(SHORT, directivity=directivity, start_time_s=1.3e-6)
    found = simulate_plane_waves(points, amplitudes, PROBE, angles, recording)
    expected = written_out(points, amplitudes, angles, recording)
    assert found.samples.shape == (1, 3, 16, 700)
    assert np.abs(found.samples[0] - expected).max() < SINGLE_PRECISION * np.abs(expected).max()


def test_light_needs_no_time_to_arrive() -> None:
    """A photoacoustic wave travels one way, from the absorber to the element."""
    points, pressures = scatterers()
    found = simulate_photoacoustic(points, pressures, PROBE, SHORT)
    expected = written_out(points, pressures, None, SHORT)
    assert found.transmit_delays_s is None
    assert np.abs(found.samples[0] - expected).max() < SINGLE_PRECISION * np.abs(expected).max()


def test_echoes_of_two_fields_add_up() -> None:
    """Scattering is single: the echoes of all scatterers are the sum of each one's."""
    points, amplitudes = scatterers()
    whole, near, far = (
        simulate_photoacoustic(points[part], amplitudes[part], PROBE, SHORT).samples[0]
        for part in (slice(None), slice(8), slice(8, None))
    )
    assert np.abs(whole - (near + far)).max() < SINGLE_PRECISION * np.abs(whole).max()


@pytest.mark.parametrize("angle_deg", [-20.0, 0.0, 15.0])
def test_plane_waves_are_steered(angle_deg: float) -> None:
    """No element fires before time zero, and the front leaves at the angle asked for."""
    delays = plane_wave_delays(PROBE, np.deg2rad([angle_deg]))[0]
    assert delays.min() == 0
    across = np.diff(delays) * SPEED / np.diff(PROBE.element_positions_mm[:, 0].numpy())
    np.testing.assert_allclose(across, math.sin(math.radians(angle_deg)), atol=1e-12)


def test_moving_blood_turns_the_phase() -> None:
    """From pulse to pulse the phase turns by 4 pi v T f / c, back for motion away."""
    speed, rate = 25.0, 3000.0
    found = simulate_ensemble(
        np.array([[0.0, 12.0, 0.0]]),
        np.ones(1),
        np.array([[0.0, speed, 0.0]]),
        PROBE,
        pulses=6,
        pulse_repetition_hz=rate,
        acquisition=replace(SHORT, samples=1024),
    )
    analytic = hilbert(found.samples[0][:, 8].astype(np.float64), axis=-1)
    lag_one = np.vdot(analytic[:-1], analytic[1:])
    turned = -4 * math.pi * speed / rate * FREQUENCY / SPEED
    # The front element hears along the flow within 0.02 %; the pulse shifts by 0.1 sigma.
    assert np.angle(lag_one) == pytest.approx(turned, rel=2e-3)
    assert found.pulse_repetition_hz == rate
    assert found.transmit_delays_s is not None
    assert len(found.transmit_delays_s) == 6


def test_still_tissue_does_not_change() -> None:
    """An ensemble of tissue that stands still repeats the first pulse exactly."""
    points, amplitudes = scatterers()
    still = np.zeros_like(points)
    found = simulate_ensemble(points, amplitudes, still, PROBE, pulses=3, acquisition=SHORT)
    np.testing.assert_array_equal(found.samples[0][1:], found.samples[0][:1].repeat(2, 0))


def _peak(data: ChannelData) -> float:
    """Return the energy's root: the amplitude of one echo, whatever its phase."""
    return float(np.linalg.norm(data.samples[0]))


@pytest.mark.parametrize(("depth_mm", "ways"), [(18.0, 1), (18.0, 2), (10.0, 2)])
def test_lens_sees_a_slice(depth_mm: float, ways: int) -> None:
    """Beside the plane an echo is weaker by the Gaussian beam's profile, for each way."""
    beam = Beam(elevation_waist_mm=0.6, elevation_focus_mm=18.0)
    recording = replace(SHORT, samples=1024, beam=beam)
    beside = 0.4
    energies = []
    for elevation in (0.0, beside):
        point = np.array([[0.0, depth_mm, elevation]])
        if ways == 1:
            data = simulate_photoacoustic(point, np.ones(1), PROBE, recording)
        else:
            data = simulate_plane_waves(point, np.ones(1), PROBE, np.zeros(1), recording)
        energies.append(_peak(data))
    rayleigh = math.pi * 0.36 * FREQUENCY / SPEED
    waist = 0.6 * math.sqrt(1 + ((depth_mm - 18) / rayleigh) ** 2)
    profile = math.exp(-ways * (beside / waist) ** 2)
    assert energies[1] / energies[0] == pytest.approx(profile, rel=1e-3)


@pytest.mark.parametrize(
    ("points", "amplitudes", "words"),
    [
        (np.zeros((0, 3)), np.zeros(0), "no scatterers"),
        (np.zeros((2, 3)), np.zeros(3), "3 amplitudes for 2 scatterers"),
        (np.array([[0.0, np.nan, 0.0]]), np.ones(1), "scatterer 0"),
    ],
)
def test_fields_that_cannot_be(points: np.ndarray, amplitudes: np.ndarray, words: str) -> None:
    """A field without scatterers, or with one nowhere, is refused in one sentence."""
    with pytest.raises(ScanError, match=words):
        simulate_plane_waves(points, amplitudes, PROBE, np.zeros(1), SHORT)


def test_settings_that_cannot_be() -> None:
    """One pulse is no ensemble, and a plane wave does not leave along the array."""
    point = np.array([[0.0, 5.0, 0.0]])
    with pytest.raises(ScanError, match="at least 2 pulses, got 1"):
        simulate_ensemble(point, np.ones(1), np.zeros((1, 3)), PROBE, pulses=1)
    with pytest.raises(ScanError, match="within 90 degrees"):
        simulate_plane_waves(point, np.ones(1), PROBE, np.array([1.6]))
    with pytest.raises(ScanError, match="sampling frequency"):
        Acquisition(sampling_frequency_hz=0.0)
