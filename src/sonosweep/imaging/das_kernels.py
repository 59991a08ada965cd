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
def receive_table(
    points, elements, normals, aperture, scales, first, last, offset, delays, weights
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
                turn = 2 * math.pi * (cycles * distance - math.floor(cycles * distance))
                delays[at] = per_mm * distance
                weights[at] = weight * complex(math.cos(turn), math.sin(turn))
                at += 1


@njit(cache=True, nogil=True)
@no_type_check
def transmit_table(times, starts, rate, carrier, delays, phases):
    """Fill transmit delays in samples of the padded recording, and the carrier at them."""
    for t in range(times.shape[0]):
        for c in range(times.shape[1]):
            for r in range(times.shape[2]):
                delays[t, c, r] = (times[t, c, r] - starts[t]) * rate + FRONT
                cycles = carrier * times[t, c, r]
                turn = np.float32(2 * math.pi * (cycles - math.floor(cycles)))
                phases[t, c, r] = complex(math.cos(turn), math.sin(turn))


@njit(cache=True, nogil=True)
@no_type_check
def is_covered(transmit, first, last, offset, delays, samples):
    """Return whether any element recorded the echo of any pixel of a block."""
    for e in range(first.shape[0]):
        for c in range(first.shape[1]):
            shift = offset[e, c] - first[e, c]
            for t in range(transmit.shape[0]):
                for r in range(first[e, c], last[e, c]):
                    position = transmit[t, c, r] + delays[shift + r] - FRONT
                    if 0 <= position <= samples - 1:
                        return True
    return False


@njit(cache=True, nogil=True, fastmath={"contract", "nsz", "nnan", "ninf"}, error_model="numpy")
@no_type_check
def _add_linear(samples, transmit, delays, weights, real, imag):
    """Add the samples at the delays of a run of rows, two-point interpolation."""
    top = np.float32(samples.size // 2 - 2)
    for r in range(delays.size):
        position = min(max(transmit[r] + delays[r], np.float32(0)), top)
        k = np.int32(position)
        part = position - np.float32(k)
        re = samples[2 * k] + part * (samples[2 * k + 2] - samples[2 * k])
        im = samples[2 * k + 1] + part * (samples[2 * k + 3] - samples[2 * k + 1])
        w = weights[r]
        real[r] += re * w.real - im * w.imag
        imag[r] += re * w.imag + im * w.real


@njit(cache=True, nogil=True, fastmath={"contract", "nsz", "nnan", "ninf"}, error_model="numpy")
@no_type_check
def _add_cubic(samples, transmit, delays, weights, real, imag):
    """Add the samples at the delays of a run of rows, four-point (Lagrange) interpolation."""
    one, two, third = np.float32(1), np.float32(2), np.float32(1 / 3)
    half = np.float32(0.5)
    top = np.float32(samples.size // 2 - 3)
    for r in range(delays.size):
        position = min(max(transmit[r] + delays[r], one), top)
        k = np.int32(position)
        u = position - np.float32(k)
        a = -u * (u - one) * (u - two) * half * third
        b = (u + one) * (u - one) * (u - two) * half
        c = -(u + one) * u * (u - two) * half
        d = (u + one) * u * (u - one) * half * third
        i = 2 * k
        re = a * samples[i - 2] + b * samples[i] + c * samples[i + 2] + d * samples[i + 4]
        im = a * samples[i - 1] + b * samples[i + 1] + c * samples[i + 3] + d * samples[i + 5]
        w = weights[r]
        real[r] += re * w.real - im * w.imag
        imag[r] += re * w.imag + im * w.real


@njit(cache=True, nogil=True)
@no_type_check
def sum_block(samples, transmit, phases, first, last, offset, delays, weights, is_cubic, images):
    """Fill the analytic signal of a block of columns, ``(transmits, columns, rows)``.

    ``samples`` are ``(transmits, elements, 2 * padded samples)``, real and imaginary parts
    side by side; ``transmit`` holds the transmit delays in samples with the rim added, and
    ``phases`` the carrier at the transmit delay.
    """
    transmits, columns, rows = transmit.shape
    real = np.zeros((transmits, columns, rows), np.float32)
    imag = np.zeros((transmits, columns, rows), np.float32)
    for e in range(first.shape[0]):
        for t in range(transmits):
            for c in range(columns):
                low, high, at = first[e, c], last[e, c], offset[e, c]
                if low == high:
                    continue
                stop = at + high - low
                run = transmit[t, c, low:high]
                re, im = real[t, c, low:high], imag[t, c, low:high]
                if is_cubic:
                    _add_cubic(samples[t, e], run, delays[at:stop], weights[at:stop], re, im)
                else:
                    _add_linear(samples[t, e], run, delays[at:stop], weights[at:stop], re, im)
    for t in range(transmits):
        for c in range(columns):
            for r in range(rows):
                images[t, c, r] = phases[t, c, r] * complex(real[t, c, r], imag[t, c, r])
