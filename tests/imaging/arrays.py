"""Arrays and their recordings, as simple as they can be, for the tests of beamforming."""

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from sonosweep.imaging import PixelGrid
from sonosweep.scan import ChannelData, Probe

GOLDEN = Path(__file__).parent / "golden"
FREQUENCY_HZ = 7.6e6
SPEED_MM_PER_S = 1540e3


def probe_at(positions_mm: NDArray, frequency_hz: float = FREQUENCY_HZ) -> Probe:
    """Return a probe of elements at ``(elements, 2 or 3)`` positions, lateral and axial first."""
    positions = np.zeros((len(positions_mm), 3))
    positions[:, : positions_mm.shape[1]] = positions_mm
    return Probe("test array", torch.from_numpy(positions), 0.27, frequency_hz)


def linear_probe(elements: int = 64, pitch_mm: float = 0.3) -> Probe:
    """Return a straight array, centered."""
    lateral = (np.arange(elements) - (elements - 1) / 2) * pitch_mm
    return probe_at(np.column_stack([lateral, np.zeros(elements)]))


def ring_probe(elements: int = 256, radius_mm: float = 20.0, span_deg: float = 360.0) -> Probe:
    """Return elements on a circle around the origin, which look inward."""
    angles = np.deg2rad(span_deg) * (np.arange(elements) / elements - 0.5)
    positions = radius_mm * np.column_stack([np.sin(angles), -np.cos(angles)])
    return probe_at(positions, 5e6)


def pulse(times_s: NDArray, frequency_hz: float, cycles: float = 2.0) -> NDArray:
    """Return a Gaussian pulse about time 0, so many periods long at half its height."""
    width = cycles / frequency_hz / 2.355
    return np.exp(-0.5 * (times_s / width) ** 2) * np.cos(2 * np.pi * frequency_hz * times_s)


def record(
    probe: Probe,
    sources_mm: NDArray,
    *,
    delays_s: NDArray | None = None,
    rate_hz: float = 4 * FREQUENCY_HZ,
    samples: int = 1500,
    start_s: float = 0.0,
    strength: NDArray | None = None,
    spreading: bool = False,
) -> ChannelData:
    """Return one frame of RF: pulses that come from points, exactly when they should.

    Plane waves and single elements only: the wave reaches a point at the earliest of all
    elements' delays and paths, found by brute force on a very fine array.
    """
    elements = probe.element_positions_mm.numpy()
    times = start_s + np.arange(samples) / rate_hz
    rows = [None] if delays_s is None else list(delays_s)
    rf = np.zeros((len(rows), len(elements), samples))
    strengths = np.ones(len(sources_mm)) if strength is None else strength
    for t, delays in enumerate(rows):
        for (x, y), height in zip(sources_mm, strengths, strict=True):
            path = np.hypot(elements[:, 0] - x, elements[:, 1] - y)
            sent = 0.0 if delays is None else brute_force_arrival(elements, delays, x, y)
            gain = height / path if spreading else height * np.ones_like(path)
            late = sent + path / SPEED_MM_PER_S
            rf[t] += gain[:, None] * pulse(times - late[:, None], probe.center_frequency_hz)
    return ChannelData(
        "points",
        rf[None].astype(np.float32),
        probe,
        rate_hz,
        start_time_s=torch.full((len(rows),), start_s, dtype=torch.float64),
        transmit_delays_s=None if delays_s is None else torch.from_numpy(delays_s),
    )


def brute_force_arrival(elements_mm: NDArray, delays_s: NDArray, x: float, y: float) -> float:
    """Return the earliest arrival at a point from an array of 20 000 elements between these."""
    fine = np.linspace(0, len(elements_mm) - 1, 20_000)
    place = np.arange(len(elements_mm))
    lateral, axial, delay = (
        np.interp(fine, place, values)
        for values in (elements_mm[:, 0], elements_mm[:, 1], delays_s)
    )
    return float((delay + np.hypot(lateral - x, axial - y) / SPEED_MM_PER_S).min())


def plane_delays(probe: Probe, angles_deg: NDArray) -> NDArray:
    """Return the delays that steer plane waves, 0 in the array's middle."""
    lateral = probe.element_positions_mm.numpy()[:, 0]
    return np.sin(np.deg2rad(angles_deg))[:, None] * lateral / SPEED_MM_PER_S


def golden(name: str) -> tuple[ChannelData, dict[str, NDArray]]:
    """Return a recording that PyMUST simulated, and what else its file holds."""
    with np.load(GOLDEN / name) as file:
        stored = dict(file)
    rf = stored["rf"]
    lateral = (np.arange(rf.shape[1]) - (rf.shape[1] - 1) / 2) * stored["pitch_mm"]
    probe = probe_at(
        np.column_stack([lateral, np.zeros_like(lateral)]), float(stored["center_frequency_hz"])
    )
    data = ChannelData(
        name,
        rf[None],
        probe,
        float(stored["sampling_frequency_hz"]),
        start_time_s=torch.full((len(rf),), float(stored["start_time_s"]), dtype=torch.float64),
        transmit_delays_s=torch.from_numpy(stored["transmit_delays_s"]),
    )
    return data, stored


def patch(x_mm: float, y_mm: float, half_mm: float = 0.8, step_mm: float = 0.02) -> PixelGrid:
    """Return a fine grid centered at a point."""
    count = 2 * round(half_mm / step_mm) + 1
    return PixelGrid(count, count, (step_mm, step_mm), (x_mm - half_mm, y_mm - half_mm))


def peak_mm(image: NDArray, grid: PixelGrid) -> tuple[float, float]:
    """Return where the envelope is highest: lateral, axial; parabola between pixels."""
    envelope = np.abs(image)
    row, column = np.unravel_index(envelope.argmax(), envelope.shape)
    along = _vertex(envelope[row, column - 1 : column + 2])
    down = _vertex(envelope[row - 1 : row + 2, column])
    lateral = grid.origin_mm[0] + grid.spacing_mm[0] * (column + along)
    return float(lateral), float(grid.origin_mm[1] + grid.spacing_mm[1] * (row + down))


def _vertex(three: NDArray) -> float:
    return float((three[0] - three[2]) / (2 * (three[0] - 2 * three[1] + three[2])))


def half_width_mm(profile: NDArray, step_mm: float) -> float:
    """Return the full width at half of the maximum of a profile, linear between pixels."""
    peak = int(profile.argmax())
    half = profile[peak] / 2
    left, right = peak, peak
    while profile[left] > half:
        left -= 1
    while profile[right] > half:
        right += 1
    low = left + (half - profile[left]) / (profile[left + 1] - profile[left])
    high = right - (half - profile[right]) / (profile[right - 1] - profile[right])
    return (high - low) * step_mm


def correlation(one: NDArray, other: NDArray) -> float:
    """Return the magnitude of the complex correlation of two images."""
    return float(abs(np.vdot(one, other)) / (np.linalg.norm(one) * np.linalg.norm(other)))
