"""When a transmitted wave reaches a point.

Elements fire at given delays. If these are linear in the position along a straight array the
wave is plane and its time is exact everywhere, also beside the array. Otherwise the wave
reaches a point from that part of the array whose path and delay together are stationary: for
a diverging wave, and before a focus, the earliest arrival; beyond a focus, the latest one.
Where no part of the array sends towards the point, its edge does: the earliest arrival.
"""

from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float
from numba import njit

from sonosweep.errors import ScanError
from sonosweep.imaging.aperture import ArrayShape

PLANE_TOLERANCE_MM = 1e-4
"""Delays, as lengths, that are so close to a plane wave's are those of one: far less than
the path difference that a phase shows, and more than float32 delays are off."""
LATEST = 4.0
"""Between two elements that fire, in times that sound takes between them. Waves need up to 1,
more if the sound speed is not the one the delays were made for."""


@dataclass(frozen=True, eq=False)
class Waves:
    """The waves of some transmits, ready to be timed anywhere.

    Attributes:
        plane: For each transmit, whether it is a plane wave.
        starts_s: Time of a plane wave at the origin.
        gradients_s_per_mm: Of a plane wave's time: lateral, axial.
        elements_mm: Centres of the elements.
        delays_s: When each element fires, 0 for those that do not.
        firing: Which elements do.
        speed_mm_per_s: In the medium.
    """

    plane: Bool[np.ndarray, " transmits"]
    starts_s: Float[np.ndarray, " transmits"]
    gradients_s_per_mm: Float[np.ndarray, "transmits xy=2"]
    elements_mm: Float[np.ndarray, "elements xyz=3"]
    delays_s: Float[np.ndarray, "transmits elements"]
    firing: Bool[np.ndarray, "transmits elements"]
    speed_mm_per_s: float


def transmitted_waves(
    elements_mm: Float[np.ndarray, "elements xyz=3"],
    delays_s: Float[np.ndarray, "transmits elements"],
    sound_speed_m_per_s: float,
    shape: ArrayShape | None,
) -> Waves:
    """Return the waves that transmit delays make.

    Args:
        elements_mm: Centres of the elements.
        delays_s: When each fires; NaN for those that do not.
        sound_speed_m_per_s: In the medium.
        shape: Of the array; a straight one can send plane waves.

    Raises:
        ScanError: If no element fires in a transmit, or the delays of one are infinite or far
            longer than sound takes across the array.
    """
    _check_delays(elements_mm, delays_s, sound_speed_m_per_s)
    delays = delays_s.astype(np.float64)
    speed = sound_speed_m_per_s * 1e3
    found = [_plane_wave(elements_mm, each, speed, shape) for each in delays]
    firing = np.isfinite(delays)
    return Waves(
        plane=np.array([wave is not None for wave in found], bool),
        starts_s=np.array([wave[0] if wave else 0.0 for wave in found]),
        gradients_s_per_mm=np.array([wave[1] if wave else (0.0, 0.0) for wave in found]),
        elements_mm=elements_mm,
        delays_s=np.where(firing, delays, 0.0),
        firing=firing,
        speed_mm_per_s=speed,
    )


def arrival_times(
    waves: Waves, points_mm: Float[np.ndarray, "columns rows xy=2"]
) -> Float[np.ndarray, "transmits columns rows"]:
    """Return when each wave reaches each point, after its time zero, in seconds.

    Args:
        waves: Of :func:`transmitted_waves`.
        points_mm: Lateral and axial, probe coordinates.
    """
    times = np.empty((len(waves.plane), *points_mm.shape[:2]))
    _plane_times(points_mm, waves.plane, waves.starts_s, waves.gradients_s_per_mm, times)
    others = ~waves.plane
    if others.any():
        arrivals = np.empty((int(others.sum()), *points_mm.shape[:2]))
        _arrivals(
            points_mm,
            waves.elements_mm,
            waves.delays_s[others],
            waves.firing[others],
            waves.speed_mm_per_s,
            arrivals,
        )
        times[others] = arrivals
    return times


def _check_delays(
    elements_mm: Float[np.ndarray, "elements xyz=3"],
    delays_s: Float[np.ndarray, "transmits elements"],
    sound_speed_m_per_s: float,
) -> None:
    if np.isinf(delays_s).any():
        raise ScanError("transmit delays must be seconds, or NaN for silent elements; got infinity")
    silent = np.isnan(delays_s).all(1)
    if silent.any():
        raise ScanError(f"no element fires in transmit {int(silent.argmax())}: all delays are NaN")
    differ_s = np.nanmax(delays_s, axis=1) - np.nanmin(delays_s, axis=1)
    across_s = float(np.linalg.norm(np.ptp(elements_mm, axis=0))) / (sound_speed_m_per_s * 1e3)
    worst = int(differ_s.argmax())
    if differ_s[worst] > LATEST * across_s:
        raise ScanError(
            f"the delays of transmit {worst} differ by {differ_s[worst] * 1e6:.4g} us, but sound"
            f" takes {across_s * 1e6:.4g} us across the array: delays must be in seconds"
        )


def _plane_wave(
    elements_mm: Float[np.ndarray, "elements 3"],
    delays_s: Float[np.ndarray, " elements"],
    speed: float,
    shape: ArrayShape | None,
) -> tuple[float, Float[np.ndarray, "2"]] | None:
    """Return a plane wave's time at the origin and its gradient, or ``None`` if not plane.

    Few elements send no plane wave: the sub-aperture must be most of the array.
    """
    firing = np.isfinite(delays_s)
    if shape is None or not shape.is_line or firing.sum() < max(3, 0.9 * len(firing)):
        return None
    normal = shape.normals[0]
    along = np.array([normal[1], -normal[0]])
    place = elements_mm[:, :2] @ along
    slope, start = np.polyfit(place[firing], delays_s[firing], 1)
    misfit = np.abs(start + slope * place - delays_s)[firing].max()
    if misfit * speed > PLANE_TOLERANCE_MM or abs(slope) * speed >= 1:
        return None
    gradient = slope * along + np.sqrt(1 / speed**2 - slope**2) * normal
    height = float((elements_mm[:, :2] @ normal).mean())
    return float(start - np.sqrt(1 / speed**2 - slope**2) * height), gradient


@njit(cache=True, nogil=True)
@no_type_check
def _plane_times(points, plane, starts, gradients, times):
    """Fill the times of the plane waves."""
    for t in range(times.shape[0]):
        if not plane[t]:
            continue
        for c in range(points.shape[0]):
            for r in range(points.shape[1]):
                across = gradients[t, 0] * points[c, r, 0]
                times[t, c, r] = starts[t] + across + gradients[t, 1] * points[c, r, 1]


@njit(cache=True, nogil=True)
@no_type_check
def _vertex(before, here, after):
    """Return the extreme of the parabola through three equidistant values."""
    bend = before - 2 * here + after
    if bend == 0:
        return here
    return here - (after - before) ** 2 / (8 * bend)


@njit(cache=True, nogil=True)
@no_type_check
def _arrival(paths, delays, firing):
    """Return when a point is reached, the path to each element being given in seconds."""
    count = paths.size
    earliest, inner_earliest, inner_latest = np.inf, np.inf, -np.inf
    for e in range(count):
        if not firing[e]:
            continue
        here = paths[e] + delays[e]
        earliest = min(earliest, here)
        if e == 0 or e == count - 1 or not (firing[e - 1] and firing[e + 1]):
            continue
        before, after = paths[e - 1] + delays[e - 1], paths[e + 1] + delays[e + 1]
        if here <= before and here < after:
            inner_earliest = min(inner_earliest, _vertex(before, here, after))
        elif here >= before and here > after:
            inner_latest = max(inner_latest, _vertex(before, here, after))
    if inner_earliest < np.inf:
        return min(inner_earliest, earliest)
    return inner_latest if inner_latest > -np.inf else earliest


@njit(cache=True, nogil=True)
@no_type_check
def _arrivals(points, elements, delays, firing, speed, times):
    """Fill the time of arrival at each point, ``(transmits, columns, rows)``.

    A stationary point between elements is found with the parabola through the three around
    it: at 1 mm depth under elements of 0.3 mm that is right within 0.1 micrometer.
    """
    count = elements.shape[0]
    paths = np.empty(count)
    for c in range(points.shape[0]):
        for r in range(points.shape[1]):
            for e in range(count):
                dx, dy = points[c, r, 0] - elements[e, 0], points[c, r, 1] - elements[e, 1]
                paths[e] = np.sqrt(dx * dx + dy * dy + elements[e, 2] ** 2) / speed
            for t in range(delays.shape[0]):
                times[t, c, r] = _arrival(paths, delays[t], firing[t])
