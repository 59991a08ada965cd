"""The loop over elements, scatterers and transmits that adds echoes to channel data."""

import math
from typing import no_type_check

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
@no_type_check
def add_echoes(
    points, strengths, transmit_mm, late_mm, elements, facing, wavelength_mm, clock, table, samples
):
    """Add the pulse of every scatterer to every element's samples.

    Args:
        points: ``(points, 3)``: lateral, axial and elevational place, mm.
        strengths: Of each point.
        transmit_mm: ``(transmits, points)``: path of the wave before it reaches a point.
        late_mm: Per point, what the lens adds to the path back.
        elements: ``(elements, 3)``, mm.
        facing: Width of the elements, which face along the axial axis; 0: they hear equally
            from everywhere.
        wavelength_mm: At the center frequency.
        clock: (samples per mm of path, path in samples at the first sample).
        table: The pulse at its samples, one row for each fraction of a sample by which it is
            late, from 0 to 1.
        samples: ``(transmits, elements, samples)``.
    """
    fractions, taps = table.shape[0] - 1, table.shape[1]
    half, count = taps // 2, points.shape[0]
    back, heard = np.empty(count), np.empty(count, np.float32)
    for e in range(elements.shape[0]):
        for p in range(count):
            back[p], heard[p] = _hear(points[p], elements[e], facing, wavelength_mm)
            back[p] += late_mm[p]
            heard[p] *= strengths[p]
        for t in range(transmit_mm.shape[0]):
            row = samples[t, e]
            for p in range(count):
                if heard[p] == 0.0:
                    continue
                late = (transmit_mm[t, p] + back[p]) * clock[0] - clock[1]
                whole = math.floor(late)
                if whole + half < 0 or whole - half > row.size:
                    continue
                place = (late - whole) * fractions
                j = int(place)
                share = np.float32(place - j) * heard[p]
                rest = heard[p] - share
                upper, lower = table[j], table[min(j + 1, fractions)]
                first = int(whole) - half
                if first >= 0 and first + taps <= row.size:
                    part = row[first : first + taps]
                    for k in range(taps):
                        part[k] += rest * upper[k] + share * lower[k]
                else:
                    for k in range(max(0, -first), min(taps, row.size - first)):
                        row[first + k] += rest * upper[k] + share * lower[k]


@njit(cache=True, nogil=True, inline="always")
@no_type_check
def _hear(point, element, facing, wavelength_mm):
    """Distance of a point from an element, and how much of it the element hears."""
    across, ahead = point[0] - element[0], point[1] - element[1]
    beside = point[2] - element[2]
    distance = math.sqrt(across * across + ahead * ahead + beside * beside)
    if facing == 0.0:
        return distance, 1.0 / max(distance, wavelength_mm)
    if ahead <= 0.0:
        return distance, 0.0
    # A strip in a soft baffle: sinc over its width, and the cosine of the angle.
    phase = math.pi * facing * across / (distance * wavelength_mm)
    strip = math.sin(phase) / phase if abs(phase) > 1e-6 else 1.0
    return distance, strip * ahead / (distance * max(distance, facing))
