"""The loops of the simulated scanner: what attenuation and side lobes do to echoes."""

from typing import no_type_check

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
@no_type_check
def receive(
    iq, tissue, first, half, lags, delays, lobes, haze, noise, blur, gain, echoes, received
):
    """Fill ``received`` with what arrives, amplified: echoes, clutter, haze and noise.

    Args:
        iq: Echoes as if nothing attenuated, ``(rows, columns)``; columns are image lines.
        tissue: Label of each pixel.
        first: Per label, what is left of an amplitude between the face and the first row.
        half: Per label, what is left after half a row.
        lags: Columns by which each side lobe is beside its echo.
        delays: Rows by which it is below.
        lobes: Its amplitude, complex.
        haze: Reverberation near the probe.
        noise: White noise, ``(rows, columns, 2)``.
        blur: What noise has in common with that of the column before.
        gain: Amplification of each row.
        echoes: Filled with what is left of the echoes.
        received: Output.
    """
    rows, columns = iq.shape
    left = np.empty(columns, np.float32)
    for c in range(columns):
        left[c] = first[tissue[0, c]] / half[tissue[0, c]]
    fresh = np.float32(np.sqrt(np.float32(1) - blur * blur))
    tiny = np.float32(1e-12)
    for r in range(rows):
        hiss = np.complex64(complex(noise[r, 0, 0], noise[r, 0, 1]))
        for c in range(columns):
            part = half[tissue[r, c]]
            passed = left[c] * part
            echoes[r, c] = iq[r, c] * passed
            # Behind bone nothing is left; numbers below 1e-38 would be slow.
            left[c] = max(passed * part, tiny)
            sample = np.complex64(complex(noise[r, c, 0], noise[r, c, 1]))
            if c > 0:
                hiss = hiss * blur + sample * fresh
            received[r, c] = echoes[r, c] + haze[r, c] + hiss
        for lobe in range(lags.size):
            if delays[lobe] <= r:
                above, lag, share = echoes[r - delays[lobe]], lags[lobe], lobes[lobe]
                for c in range(max(lag, 0), min(columns + lag, columns)):
                    received[r, c] += share * above[c - lag]
        for c in range(columns):
            received[r, c] *= gain[r]


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
