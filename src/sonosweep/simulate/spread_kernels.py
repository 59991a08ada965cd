"""Loops that put given points on a fine grid, and that spread the grid to pixels."""

import math
from typing import no_type_check

import numpy as np
from numba import njit

from sonosweep.simulate.splat_kernels import add_echo

_ZERO = np.float32(0)


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def splat_points(points, amplitudes, fine, grid):
    """Add the echoes of points in plane coordinates to the fine grid, in double precision."""
    flat = grid.reshape(grid.size)
    for p in range(points.shape[0]):
        x, y, z = points[p]
        if fine.radius_mm > 0:
            lateral = math.atan2(x, y + fine.radius_mm)
            depth = math.hypot(x, y + fine.radius_mm) - fine.radius_mm
        else:
            lateral, depth = x, y
        u = (lateral - fine.origin[0]) * fine.per_step[0]
        v = (depth - fine.origin[1]) * fine.per_step[1]
        beyond = u < 0 or u >= grid.shape[1] - 1 or v < 0 or v >= grid.shape[0] - 1
        if beyond or depth < 0:
            continue
        below = depth - fine.focus_mm
        inverse = 1 / (1 + (below * fine.per_range) ** 2)
        turns = depth * fine.turns_per_mm + z * z * below * inverse * fine.curve_turns
        weight = math.exp(-z * z * inverse * fine.slice_exponent)
        angle = 2 * math.pi * (turns - math.floor(turns))
        echo = amplitudes[p] * weight * complex(math.cos(angle), -math.sin(angle))
        at, width = 2 * (int(v) * grid.shape[1] + int(u)), 2 * grid.shape[1]
        right, down = np.float32(u - int(u)), np.float32(v - int(v))
        add_echo(flat, width, at, right, down, np.float32(echo.real), np.float32(echo.imag))


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def spread_points(grid, axial, lateral, decimation, gain, lines, frame):
    """Convolve the fine grid with the point spread function, at the pixels only.

    Args:
        grid: ``(rows, columns, 2)``.
        axial: Weights along.
        lateral: Weights across.
        decimation: Fine pixels per pixel, lateral and axial.
        gain: Of each row.
        lines: Room for one row of the fine grid, ``(columns * 2)``.
        frame: Filled; complex, ``(rows, columns)``.
    """
    flat = grid.reshape(grid.shape[0], grid.shape[1] * 2)
    step = 2 * decimation[0]
    for r in range(frame.shape[0]):
        lines[:] = _ZERO
        for tap in range(axial.size):
            weight, row = axial[tap] * gain[r], flat[r * decimation[1] + tap]
            for i in range(lines.size):
                lines[i] += weight * row[i]
        for column in range(frame.shape[1]):
            re, im = _ZERO, _ZERO
            at = column * step
            for tap in range(lateral.size):
                re += lateral[tap] * lines[at + 2 * tap]
                im += lateral[tap] * lines[at + 2 * tap + 1]
            frame[r, column] = complex(re, im)
