"""Channel data of point scatterers: what each element receives, exact to single precision.

Scattering is single and linear, the sound speed constant and the transmitted plane waves as
wide as the body. A point at distance r from an element is heard with amplitude 1 mm / r,
times the directivity of a strip in a soft baffle; plane waves do not spread. The pulse is
analytic, so that its delay is exact between samples.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32

from sonosweep.errors import ScanError
from sonosweep.scan import ChannelData, Probe
from sonosweep.simulate.beam import Beam
from sonosweep.simulate.channel_kernels import add_echoes

FRACTIONS = 512  # of a sample: linear interpolation of the pulse errs by 1e-6 of its peak
PULSE_STANDARD_DEVIATIONS = 5.3  # where its envelope has fallen to 1e-6


@dataclass(frozen=True)
class Acquisition:
    """How echoes are recorded. The defaults are those of the paper's probe and machine.

    Attributes:
        samples: For each transmit and element; 1024 reach 25 mm deep.
        sampling_frequency_hz: Four samples a period of an L11-5v.
        start_time_s: Of the first sample, after the transmit's time zero.
        sound_speed_m_per_s: In the medium.
        fractional_bandwidth: Of the recorded pulse, at half its spectrum's peak (-6 dB); the
            default makes it 0.167 mm long.
        directivity: Whether elements, facing along the axial axis, hear less from the side;
            ``False`` for rings, whose elements face the middle.
        beam: Whose elevational waist and focus decide how scatterers beside the plane are
            seen; ``None``: elements have no height and there is no lens.
    """

    samples: int = 1024
    sampling_frequency_hz: float = 30.4e6
    start_time_s: float = 0.0
    sound_speed_m_per_s: float = 1540.0
    fractional_bandwidth: float = 0.54
    directivity: bool = True
    beam: Beam | None = None

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ScanError: If one is out of range.
        """
        if self.samples < 1:
            raise ScanError(f"an acquisition needs samples, got {self.samples}")
        if not math.isfinite(self.start_time_s):
            raise ScanError(f"the time of the first sample must be finite, got {self.start_time_s}")
        for what, value in (
            ("sampling frequency", self.sampling_frequency_hz),
            ("sound speed", self.sound_speed_m_per_s),
            ("fractional bandwidth", self.fractional_bandwidth),
        ):
            if not (math.isfinite(value) and value > 0):
                raise ScanError(f"the {what} of an acquisition must be above 0, got {value:g}")


def simulate_plane_waves(
    points_mm: Float[np.ndarray, "points xyz=3"],
    amplitudes: Float[np.ndarray, " amplitudes"],
    probe: Probe,
    angles_rad: Float[np.ndarray, " angles"],
    acquisition: Acquisition | None = None,
) -> ChannelData:
    """Return one frame of RF echoes, ``(1, angles, elements, samples)``.

    Args:
        points_mm: Where the scatterers are, in plane coordinates: lateral from the array's
            middle, depth below its face, elevational.
        amplitudes: Of their echoes.
        probe: What sends and receives.
        angles_rad: To which the plane waves are steered, positive to the right.
        acquisition: How it is recorded.

    Raises:
        ScanError: If there is no scatterer or angle, or a number is not finite.
    """
    recording = acquisition or Acquisition()
    delays = plane_wave_delays(probe, angles_rad, recording.sound_speed_m_per_s)
    samples = _echoes(points_mm, amplitudes, probe, angles_rad, recording)
    return _channel_data(samples[None], probe, recording, delays)


def simulate_ensemble(
    points_mm: Float[np.ndarray, "points xyz=3"],
    amplitudes: Float[np.ndarray, " amplitudes"],
    velocities_mm_per_s: Float[np.ndarray, "velocities xyz=3"],
    probe: Probe,
    pulses: int = 20,
    pulse_repetition_hz: float = 3000.0,
    angle_rad: float = 0.0,
    acquisition: Acquisition | None = None,
) -> ChannelData:
    """Return a Doppler ensemble of one frame: ``(1, pulses, elements, samples)``.

    Args:
        points_mm: Where the scatterers are at the first pulse, in plane coordinates.
        amplitudes: Of their echoes.
        velocities_mm_per_s: By which they go on from pulse to pulse; they stand still while
            a pulse is under way.
        probe: What sends and receives.
        pulses: Number of plane waves.
        pulse_repetition_hz: Their rate.
        angle_rad: To which all of them are steered.
        acquisition: How it is recorded.

    Raises:
        ScanError: If there are fewer than two pulses, or as :func:`simulate_plane_waves`.
    """
    if pulses < 2:
        raise ScanError(f"power Doppler needs an ensemble of at least 2 pulses, got {pulses}")
    if not (math.isfinite(pulse_repetition_hz) and pulse_repetition_hz > 0):
        raise ScanError(f"the pulse repetition rate must be above 0, got {pulse_repetition_hz:g}")
    if velocities_mm_per_s.shape != points_mm.shape:
        raise ScanError(f"{len(velocities_mm_per_s)} velocities for {len(points_mm)} scatterers")
    recording = acquisition or Acquisition()
    angles = np.array([angle_rad], np.float64)
    delays = plane_wave_delays(probe, angles, recording.sound_speed_m_per_s)
    elements = len(probe.element_positions_mm)
    samples = np.empty((1, pulses, elements, recording.samples), np.float32)
    for pulse in range(pulses):
        moved = points_mm + velocities_mm_per_s * (pulse / pulse_repetition_hz)
        samples[0, pulse] = _echoes(moved, amplitudes, probe, angles, recording)[0]
    repeated = np.repeat(delays, pulses, axis=0)
    return _channel_data(samples, probe, recording, repeated, pulse_repetition_hz)


def simulate_photoacoustic(
    points_mm: Float[np.ndarray, "points xyz=3"],
    pressures: Float[np.ndarray, " pressures"],
    probe: Probe,
    acquisition: Acquisition | None = None,
) -> ChannelData:
    """Return what the elements hear after a laser pulse: ``(1, 1, elements, samples)``.

    Args:
        points_mm: Where light is absorbed, in plane coordinates.
        pressures: That it raises there: absorption times fluence.
        probe: What receives.
        acquisition: How it is recorded; time zero is the laser pulse.

    Raises:
        ScanError: If there is no absorber, or a number is not finite.
    """
    recording = acquisition or Acquisition()
    _check_points(points_mm, pressures)
    no_path = np.zeros((1, len(points_mm)))
    samples = _receive(points_mm, pressures, no_path, probe, recording, ways=1)
    return _channel_data(samples[None], probe, recording, None)


def plane_wave_delays(
    probe: Probe, angles_rad: Float[np.ndarray, " angles"], sound_speed_m_per_s: float = 1540.0
) -> Float[np.ndarray, "angles elements"]:
    """Return when each element fires for plane waves; the first of each wave at time zero.

    Raises:
        ScanError: If there is no angle, or one is not within 90 degrees.
    """
    if angles_rad.size == 0 or not bool((np.abs(angles_rad) < math.pi / 2).all()):
        raise ScanError(f"plane waves need angles within 90 degrees, got {angles_rad} rad")
    paths = _wave_paths(probe.element_positions_mm.numpy(), angles_rad)
    return (paths - paths.min(axis=1, keepdims=True)) / (sound_speed_m_per_s * 1e3)


def pulse_shape(
    time_s: Float[np.ndarray, "*times"], center_frequency_hz: float, fractional_bandwidth: float
) -> Float[np.ndarray, "*times"]:
    """Return the pulse at times from its middle: a cosine with a Gaussian envelope of peak 1."""
    sigma = _pulse_sigma_s(center_frequency_hz, fractional_bandwidth)
    envelope = np.exp(-0.5 * (time_s / sigma) ** 2)
    return envelope * np.cos(2 * math.pi * center_frequency_hz * time_s)


def _pulse_sigma_s(center_frequency_hz: float, fractional_bandwidth: float) -> float:
    """Return the standard deviation of the envelope in time."""
    half_width_hz = fractional_bandwidth * center_frequency_hz / 2
    return math.sqrt(2 * math.log(2)) / (2 * math.pi * half_width_hz)


def _wave_paths(
    points_mm: Float[np.ndarray, "points xyz=3"], angles_rad: Float[np.ndarray, " angles"]
) -> Float[np.ndarray, "angles points"]:
    """Return how far along each wave's direction each point lies, mm."""
    lateral = np.sin(angles_rad)[:, None] * points_mm[:, 0]
    return lateral + np.cos(angles_rad)[:, None] * points_mm[:, 1]


def _echoes(
    points_mm: np.ndarray,
    amplitudes: np.ndarray,
    probe: Probe,
    angles_rad: np.ndarray,
    recording: Acquisition,
) -> Float32[np.ndarray, "angles elements samples"]:
    """Return what comes back of plane waves whose first element fires at time zero."""
    _check_points(points_mm, amplitudes)
    to_array = _wave_paths(probe.element_positions_mm.numpy(), angles_rad)
    paths = _wave_paths(points_mm, angles_rad) - to_array.min(axis=1, keepdims=True)
    return _receive(points_mm, amplitudes, paths, probe, recording, ways=2)


def _receive(
    points_mm: np.ndarray,
    strengths: np.ndarray,
    transmit_mm: np.ndarray,
    probe: Probe,
    recording: Acquisition,
    ways: int,
) -> Float32[np.ndarray, "transmits elements samples"]:
    """Return the sum of all pulses; through the lens once or both ways."""
    frequency, elements = probe.center_frequency_hz, probe.element_positions_mm.double().numpy()
    per_mm = recording.sampling_frequency_hz / (recording.sound_speed_m_per_s * 1e3)
    wavelength = recording.sound_speed_m_per_s * 1e3 / frequency
    places, late = np.ascontiguousarray(points_mm, np.float64), np.zeros(len(points_mm))
    if recording.beam is not None:
        if bool((probe.element_positions_mm[:, 2] != 0).any()):
            raise ScanError(f"a lens needs elements in one row, '{probe.name}' has more")
        seen, late = _through_lens(places, recording.beam, wavelength)
        strengths, places = strengths * seen**ways, places * [1.0, 1.0, 0.0]
        transmit_mm = transmit_mm + (ways - 1) * late
    samples = np.zeros((len(transmit_mm), len(elements), recording.samples), np.float32)
    add_echoes(
        places,
        np.ascontiguousarray(strengths, np.float32),
        np.ascontiguousarray(transmit_mm, np.float64),
        late,
        np.ascontiguousarray(elements),
        probe.element_width_mm if recording.directivity else 0.0,
        wavelength,
        (per_mm, recording.start_time_s * recording.sampling_frequency_hz),
        _pulse_table(frequency, recording),
        samples,
    )
    return samples


def _through_lens(
    points_mm: Float[np.ndarray, "points xyz=3"], beam: Beam, wavelength_mm: float
) -> tuple[Float[np.ndarray, " points"], Float[np.ndarray, " points"]]:
    """Return one-way amplitude and added path (mm) beside the plane: a Gaussian beam."""
    rayleigh = math.pi * beam.elevation_waist_mm**2 / wavelength_mm
    beyond = points_mm[:, 1] - beam.elevation_focus_mm
    widening = 1 + (beyond / rayleigh) ** 2
    squared = points_mm[:, 2] ** 2
    # Spread over the height only: the amplitude falls with the root of the width.
    seen = widening**-0.25 * np.exp(-squared / (beam.elevation_waist_mm**2 * widening))
    return seen, squared * beyond / (2 * (beyond**2 + rayleigh**2))


def _pulse_table(
    center_frequency_hz: float, recording: Acquisition
) -> Float32[np.ndarray, "fractions taps"]:
    """Return the pulse's samples for each fraction of a sample by which it is late."""
    sigma = _pulse_sigma_s(center_frequency_hz, recording.fractional_bandwidth)
    reach = PULSE_STANDARD_DEVIATIONS * sigma * recording.sampling_frequency_hz
    half = 4 * math.ceil((reach + 1) / 4)  # taps in whole vectors of eight
    late = np.arange(FRACTIONS + 1)[:, None] / FRACTIONS
    times = (np.arange(-half, half) - late) / recording.sampling_frequency_hz
    shape = pulse_shape(times, center_frequency_hz, recording.fractional_bandwidth)
    return shape.astype(np.float32)


def _check_points(points_mm: np.ndarray, strengths: np.ndarray) -> None:
    if len(points_mm) == 0:
        raise ScanError("there is nothing to simulate: the phantom holds no scatterers")
    if len(points_mm) != len(strengths):
        raise ScanError(f"{len(strengths)} amplitudes for {len(points_mm)} scatterers")
    finite = np.isfinite(points_mm).all(axis=1) & np.isfinite(strengths)
    if not finite.all():
        first = int((~finite).argmax())
        raise ScanError(f"place or amplitude of scatterer {first} is not a finite number")


def _channel_data(
    samples: np.ndarray,
    probe: Probe,
    recording: Acquisition,
    delays_s: np.ndarray | None,
    pulse_repetition_hz: float | None = None,
) -> ChannelData:
    transmits = samples.shape[1]
    return ChannelData(
        "simulated",
        samples,
        probe,
        recording.sampling_frequency_hz,
        start_time_s=torch.full((transmits,), recording.start_time_s, dtype=torch.float64),
        transmit_delays_s=None if delays_s is None else torch.from_numpy(delays_s),
        sound_speed_m_per_s=recording.sound_speed_m_per_s,
        pulse_repetition_hz=pulse_repetition_hz,
    )
