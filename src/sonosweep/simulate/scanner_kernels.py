"""The loops of the simulated scanner: what attenuation and side lobes do to echoes."""

from typing import no_type_check

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
@no_type_check
def receive(iq, tissue, first, half, side_lobe, decay, haze, noise, blur, gain, received):
    """Fill ``received`` with what arrives, amplified: echoes, clutter, haze and noise.

    Args:
        iq: Echoes as if nothing attenuated, ``(rows, columns)``; columns are image lines.
        tissue: Label of each pixel.
        first: Per label, what is left of an amplitude between the face and the first row.
        half: Per label, what is left after half a row.
        side_lobe: Amplitude of clutter beside an echo, in units of the echo.
        decay: What is left of side lobes one column farther away.
        haze: Reverberation near the probe.
        noise: White noise, ``(rows, columns, 2)``.
        blur: What noise has in common with that of the column before.
        gain: Amplification of each row.
        received: Output.
    """
    rows, columns = iq.shape
    left = np.empty(columns, np.float32)
    for c in range(columns):
        left[c] = first[tissue[0, c]] / half[tissue[0, c]]
    echo = np.empty(columns, np.complex64)
    fresh = np.float32(np.sqrt(np.float32(1) - blur * blur))
    zero, tiny = np.complex64(0), np.float32(1e-12)
    for r in range(rows):
        for c in range(columns):
            part = half[tissue[r, c]]
            passed = left[c] * part
            echo[c] = iq[r, c] * passed
            # Behind bone nothing is left; numbers below 1e-38 would be slow.
            left[c] = max(passed * part, tiny)
        from_left, hiss = zero, zero
        for c in range(columns):
            sample = np.complex64(complex(noise[r, c, 0], noise[r, c, 1]))
            hiss = sample if c == 0 else hiss * blur + sample * fresh
            received[r, c] = (echo[c] + from_left * side_lobe + haze[r, c] + hiss) * gain[r]
            from_left = (from_left + echo[c]) * decay
        from_right, share = zero, side_lobe * gain[r]
        for c in range(columns - 1, -1, -1):
            received[r, c] += from_right * share
            from_right = (from_right + echo[c]) * decay


@njit(cache=True, nogil=True)
@no_type_check
def lose(tissue, first, half, left):
    """Fill ``left`` with the part of an amplitude that comes back from each pixel."""
    rows, columns = tissue.shape
    tiny = np.float32(1e-12)
    for c in range(columns):
        label = tissue[0, c]
        left[0, c] = first[label]
    for r in range(1, rows):
        for c in range(columns):
            passed = left[r - 1, c] * half[tissue[r - 1, c]] * half[tissue[r, c]]
            left[r, c] = max(passed, tiny)


@njit(cache=True, nogil=True)
@no_type_check
def first_rows(tissue, label, depth):
    """Fill ``depth`` with the first row of a label in each column, or the number of rows."""
    rows, columns = tissue.shape
    for c in range(columns):
        depth[c] = rows
        for r in range(rows):
            if tissue[r, c] == label:
                depth[c] = r
                break


@njit(cache=True, nogil=True)
@no_type_check
def add_bone(iq, surface, step, reach, level, slope, sigma, phase):
    """Add the mirror-like echo of a bone's surface to ``iq``.

    Args:
        iq: Echoes, ``(rows, columns)``.
        surface: First row of bone in each column, the number of rows where there is none.
        step: Columns per row, as lengths.
        reach: How many columns to either side are averaged: labels are rougher than bone.
        level: Amplitude where the surface faces the probe.
        slope: At which the amplitude has fallen to 1/e.
        sigma: Width of the pulse in rows.
        phase: Change of phase from row to row, negative.
    """
    rows, columns = iq.shape
    for c in range(columns):
        if surface[c] >= rows:
            continue
        count, total, moment, square = 0.0, 0.0, 0.0, 0.0
        for other in range(max(c - reach, 0), min(c + reach + 1, columns)):
            if abs(surface[other] - surface[c]) <= 2 * reach:
                away = other - c
                count += 1
                total += surface[other]
                moment += away * surface[other]
                square += away * away
        middle = total / count
        lean = moment / max(square, 1.0) / step if count == 2 * reach + 1 else 0.0
        peak = level * np.exp(-((lean / slope) ** 2))
        for r in range(max(int(middle - 4 * sigma), 0), min(int(middle + 4 * sigma) + 2, rows)):
            height = peak * np.exp(-0.5 * ((r - middle) / sigma) ** 2)
            angle = phase * middle
            iq[r, c] += np.complex64(complex(height * np.cos(angle), height * np.sin(angle)))
