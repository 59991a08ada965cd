"""Loops of delay-and-sum: over blocks of columns, elements, transmits, columns and rows.

What an element contributes to a pixel is ``weight * iq(transmit + receive)``. The receive
delay and the weight, with its phase, do not depend on the transmit, so they are computed once
for all transmits; the phase of the transmit does not depend on the element and is applied to
the sum. Along a column the rows in an element's aperture are one run, and consecutive rows
read consecutive samples. Samples have a rim of zeros: beyond the recording the signal is 0.
"""

import math
from typing import no_type_check

import numpy as np
from numba import njit

FRONT = 2
BACK = 3
"""Zeros before and after the samples, so that four-point interpolation stays inside."""
TUKEY_TAPER = 0.5
"""Part of the aperture over which the Tukey window falls, both sides together."""
TIE = 1e-9
"""A pixel on the very edge of an aperture belongs to it, whatever rounding says."""


@njit(cache=True, nogil=True)
@no_type_check
def aperture_rows(points, elements, normals, half_width, first, last):
    """Fill the runs of rows that each element hears, ``(elements, columns)``.

    ``half_width`` is half of an aperture per depth, ``1 / (2 * f_number)``, or negative for
    all elements; ``points`` are ``(columns, rows, 2)``.
    """
    columns, rows = points.shape[:2]
    for e in range(elements.shape[0]):
        for c in range(columns):
            if half_width < 0:
                first[e, c], last[e, c] = 0, rows
                continue
            first[e, c], last[e, c] = 0, 0
            for r in range(rows):
                dx, dy = points[c, r, 0] - elements[e, 0], points[c, r, 1] - elements[e, 1]
                depth = dx * normals[e, 0] + dy * normals[e, 1]
                aside = abs(dx * normals[e, 1] - dy * normals[e, 0])
                if depth > 0 and aside <= depth * half_width * (1 + TIE):
                    if last[e, c] == 0:
                        first[e, c] = r
                    last[e, c] = r + 1


@njit(cache=True, nogil=True)
@no_type_check
def _window(kind, offset):
    """Return a window at an offset of 0 (middle) to 1 (edge)."""
    if kind == 1:
        return 0.5 + 0.5 * math.cos(math.pi * min(offset, 1.0))
    if kind == 2 and offset > 1 - TUKEY_TAPER:
        return 0.5 + 0.5 * math.cos(math.pi * (min(offset, 1.0) - 1 + TUKEY_TAPER) / TUKEY_TAPER)
    return 1.0


@njit(cache=True, nogil=True)
@no_type_check
def _turn(cycles):
    """Return the angle of a number of cycles, between -pi and pi, in single precision."""
    return np.float32(2 * math.pi * (cycles - math.floor(cycles + 0.5)))


@njit(cache=True, nogil=True)
@no_type_check
def receive_table(
    points, elements, normals, aperture, scales, first, last, offset, delays, cosines, sines
):
    """Fill the receive delay in samples and the complex weight of all runs.

    ``aperture`` holds the half-width and the number of the window; ``scales`` samples per mm,
    carrier cycles per mm, and the element width in wavelengths (0 without directivity).
    """
    half_width, kind = aperture
    per_mm, cycles, width = scales
    for e in range(elements.shape[0]):
        for c in range(points.shape[0]):
            at = offset[e, c]
            for r in range(first[e, c], last[e, c]):
                dx, dy = points[c, r, 0] - elements[e, 0], points[c, r, 1] - elements[e, 1]
                distance = math.sqrt(dx * dx + dy * dy + elements[e, 2] * elements[e, 2])
                depth = dx * normals[e, 0] + dy * normals[e, 1]
                aside = abs(dx * normals[e, 1] - dy * normals[e, 0])
                weight = 1.0
                if half_width > 0:
                    weight = _window(kind, aside / (depth * half_width)) if depth > 0 else 0.0
                if width > 0 and distance > 0:
                    argument = math.pi * width * aside / distance
                    sinc = math.sin(argument) / argument if argument > 1e-6 else 1.0
                    weight *= max(depth, 0.0) / distance * sinc
                turn = _turn(cycles * distance)
                delays[at] = per_mm * distance
                cosines[at] = weight * math.cos(turn)
                sines[at] = weight * math.sin(turn)
                at += 1


@njit(cache=True, nogil=True)
@no_type_check
def transmit_table(times, starts, rate, carrier, delays, phases):
    """Fill transmit delays in samples of the padded recording, and the carrier at them."""
    for t in range(times.shape[0]):
        for c in range(times.shape[1]):
            for r in range(times.shape[2]):
                delays[t, c, r] = (times[t, c, r] - starts[t]) * rate + FRONT
                turn = _turn(carrier * times[t, c, r])
                phases[t, c, r] = complex(math.cos(turn), math.sin(turn))


@njit(cache=True, nogil=True)
@no_type_check
def is_covered(transmit, first, last, offset, delays, samples):
    """Return whether any element recorded the echo of any pixel of a block."""
    for e in range(first.shape[0]):
        for c in range(first.shape[1]):
            shift = offset[e, c] - first[e, c]
            for r in range(first[e, c], last[e, c]):
                position = transmit[c, r] + delays[shift + r] - FRONT
                if 0 <= position <= samples - 1:
                    return True
    return False


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _locate(transmit, delays, lowest, highest, index, part):
    """Fill the sample before each position and the part of a sample that is left."""
    for r in range(delays.size):
        position = min(max(transmit[r] + delays[r], lowest), highest)
        k = np.int32(position)
        part[r] = position - np.float32(k)
        index[r] = k


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _fetch(samples, shift, index, count, fetched):
    """Copy the samples at ``index + shift``; a complex one moves as one 64-bit number."""
    for r in range(count):
        fetched[r] = samples[np.uint64(index[r] + shift)]


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _fetch_two(samples, index, count, before, after):
    """Copy the samples at ``index`` and those after them."""
    for r in range(count):
        k = np.uint64(index[r])
        before[r] = samples[k]
        after[r] = samples[k + np.uint64(1)]


@njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
@no_type_check
def _add_two(before, after, part, cosines, sines, real, imag):
    """Add samples interpolated between two neighbors, times a weight."""
    for r in range(cosines.size):
        re = before[2 * r] + part[r] * (after[2 * r] - before[2 * r])
        im = before[2 * r + 1] + part[r] * (after[2 * r + 1] - before[2 * r + 1])
        real[r] += re * cosines[r] - im * sines[r]
        imag[r] += re * sines[r] + im * cosines[r]


@njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
@no_type_check
def _add_four(values, part, cosines, sines, real, imag):
    """Add samples interpolated between four neighbors (Lagrange), times a weight."""
    one, two, half = np.float32(1), np.float32(2), np.float32(0.5)
    sixth = np.float32(1 / 6)
    for r in range(cosines.size):
        u = part[r]
        a = -u * (u - one) * (u - two) * sixth
        b = (u + one) * (u - one) * (u - two) * half
        c = -(u + one) * u * (u - two) * half
        d = (u + one) * u * (u - one) * sixth
        i = 2 * r
        re = a * values[0, i] + b * values[1, i] + c * values[2, i] + d * values[3, i]
        i = 2 * r + 1
        im = a * values[0, i] + b * values[1, i] + c * values[2, i] + d * values[3, i]
        real[r] += re * cosines[r] - im * sines[r]
        imag[r] += re * sines[r] + im * cosines[r]


@njit(cache=True, nogil=True)
@no_type_check
def sum_block(
    samples, transmit, phases, first, last, offset, delays, cosines, sines, is_cubic, images
):
    """Fill the analytic signal of a block of columns, ``(transmits, columns, rows)``.

    ``samples`` are ``(transmits, elements, padded samples)``, each complex sample seen as one
    64-bit number; ``transmit`` holds the transmit delays in samples with the rim added, and
    ``phases`` the carrier at the transmit delay. Positions, fetching and adding are loops of
    their own: only the fetching cannot use the processor's vector instructions.
    """
    transmits, columns, rows = transmit.shape
    real = np.zeros(transmits * columns * rows, np.float32)
    imag = np.zeros(transmits * columns * rows, np.float32)
    outward = transmit.reshape(-1)
    index, part = np.empty(rows, np.int32), np.empty(rows, np.float32)
    fetched = np.empty((4, rows), np.float64)
    values = fetched.view(np.float32)
    here, following = fetched[0], fetched[1]
    here_parts, following_parts = values[0], values[1]
    lowest = np.float32(1 if is_cubic else 0)
    highest = np.float32(samples.shape[2] - (3 if is_cubic else 2))
    for e in range(first.shape[0]):
        for t in range(transmits):
            signal = samples[t, e]
            for c in range(columns):
                low, at, count = first[e, c], offset[e, c], last[e, c] - first[e, c]
                if count == 0:
                    continue
                inward = delays[at : at + count]
                cosine, sine = cosines[at : at + count], sines[at : at + count]
                begin = (t * columns + c) * rows + low
                end = begin + count
                re, im = real[begin:end], imag[begin:end]
                _locate(outward[begin:end], inward, lowest, highest, index, part)
                if is_cubic:
                    for k in range(4):
                        _fetch(signal, k - 1, index, count, fetched[k])
                    _add_four(values, part, cosine, sine, re, im)
                else:
                    _fetch_two(signal, index, count, here, following)
                    _add_two(here_parts, following_parts, part, cosine, sine, re, im)
    n = 0
    for t in range(transmits):
        for c in range(columns):
            for r in range(rows):
                images[t, c, r] = phases[t, c, r] * complex(real[n], imag[n])
                n += 1
