"""The loop that fills a forearm's voxels, slice by slice.

Smooth fields come on a coarse grid and are interpolated linearly; muscles come as one row of
numbers per slice (see :mod:`sonosweep.simulate.forearm_muscles`).
"""

import math
from typing import no_type_check

import numpy as np
from numba import njit

from sonosweep.simulate.body import REFERENCE_CODE, Tissue
from sonosweep.simulate.forearm_muscles import (
    COS,
    FILL,
    GAIN_DB,
    LEVEL_DB,
    SIN,
    TENDON,
    TEXTURE_X,
    TEXTURE_Y,
    WEIGHT,
    A,
    B,
    C,
    X,
    Y,
)

# The coarse fields: distances in mm (inward from the skin, inward from the deep fascia,
# outward from bone, across the membrane), warps in mm, and brightness in dB.
SKIN, FASCIA, BONE, MEMBRANE, WARP_X, WARP_Y, BRIGHT, MIDDLE = range(8)
FIELDS = 8

# Thicknesses in mm, then levels in dB of amplitude 1.
(
    SKIN_MM,
    FASCIA_MM,
    SEPTUM_MM,
    EPIDERMIS_DB,
    DERMIS_DB,
    FAT_DB,
    FAT_SHEETS_DB,
    FASCIA_DB,
    MUSCLE_DB,
    SEPTUM_DB,
    TENDON_DB,
    BONE_DB,
    MARROW_DB,
) = range(13)

_OUTSIDE, _GEL, _SKIN, _FAT, _FASCIA, _MUSCLE, _TENDON = map(int, list(Tissue)[:7])
_BONE = int(Tissue.BONE)
_CORTEX_MM = np.float32(0.5)
_ENTRY_MM = np.float32(0.35)
_NEAR_SEPTUM = np.float32(0.8)  # of squared ellipses; farther off, there is no septum
_ONE = np.float32(1)
_SILENT = np.float32(-1e9)
_POSITIVE = np.float32(4096)  # a multiple of every table's size
_REFERENCE = np.float32(REFERENCE_CODE + 0.5)


@njit(cache=True, nogil=True)
@no_type_check
def blend_tables(table, position, blended):
    """Fill the slice of a periodic table at ``position`` (in cells)."""
    low = math.floor(position)
    share = np.float32(position - low)
    first, second = table[low % table.shape[0]], table[(low + 1) % table.shape[0]]
    for j in range(blended.shape[0]):
        for i in range(blended.shape[1]):
            blended[j, i] = first[j, i] + share * (second[j, i] - first[j, i])


@njit(cache=True, nogil=True, inline="always")
@no_type_check
def _sample(table, row, column):
    """Return the periodic table at a place between its cells."""
    row, column = row + _POSITIVE, column + _POSITIVE
    j, i = np.int32(row), np.int32(column)
    v, u = row - np.float32(j), column - np.float32(i)
    j0, i0 = j & (table.shape[0] - 1), i & (table.shape[1] - 1)
    j1, i1 = (j0 + 1) & (table.shape[0] - 1), (i0 + 1) & (table.shape[1] - 1)
    upper = table[j0, i0] + u * (table[j0, i1] - table[j0, i0])
    lower = table[j1, i0] + u * (table[j1, i1] - table[j1, i0])
    return upper + v * (lower - upper)


@njit(cache=True, nogil=True)
@no_type_check
def _line(distance, half_width):
    """Return the profile of a bright line, 1 in its middle."""
    share = distance / half_width
    share *= share
    return _ONE / (_ONE + share * share)


@njit(cache=True, nogil=True)
@no_type_check
def _interpolate_row(slab, y, cells, shares, row, values):
    """Fill the fields along x at row ``y`` (in coarse cells) of one slice's coarse fields."""
    low = min(int(y), slab.shape[1] - 2)
    share = np.float32(y - low)
    for f in range(slab.shape[0]):
        for i in range(slab.shape[2]):
            row[i] = slab[f, low, i] + share * (slab[f, low + 1, i] - slab[f, low, i])
        for k in range(cells.size):
            i = cells[k]
            values[f, k] = row[i] + shares[k] * (row[i + 1] - row[i])


@njit(cache=True, nogil=True)
@no_type_check
def _two_nearest(muscles, xs, y, warp_x, warp_y, near, far, one, two):
    """Fill the two nearest muscles of each voxel of a row, and how near they are."""
    near[:] = np.float32(1e9)
    far[:] = np.float32(1e9)
    one[:] = 0
    two[:] = 0
    for m in range(muscles.shape[0]):
        a, b, c = muscles[m, A], muscles[m, B], muscles[m, C]
        x0, y0, weight = muscles[m, X], muscles[m, Y] - y, muscles[m, WEIGHT]
        number = np.int32(m)
        for k in range(xs.size):
            u, v = xs[k] + warp_x[k] - x0, warp_y[k] - y0
            q = (a * u + b * v) * u + c * v * v - weight
            # Choices instead of branches: the compiler does eight voxels at a time.
            nearest, next_one, before, second = near[k], far[k], one[k], two[k]
            two[k] = before if q < nearest else (number if q < next_one else second)
            far[k] = nearest if q < nearest else (q if q < next_one else next_one)
            one[k] = number if q < nearest else before
            near[k] = q if q < nearest else nearest


@njit(cache=True, nogil=True)
@no_type_check
def _shallow_row(tissue, levels, values, xs, sheets, per_cell, tones):
    """Fill labels and levels outside, in skin, fat, deep fascia and bone; else muscle."""
    skin, fascia, fat_db = tones[SKIN_MM], tones[FASCIA_MM], tones[FAT_DB]
    dip = np.float32(8) * max(np.float32(0), fascia - np.float32(0.5))
    for k in range(xs.size):
        depth, below, bone = values[SKIN, k], values[FASCIA, k], values[BONE, k]
        if depth < 0:
            tissue[k] = _GEL if values[MIDDLE, k] < 0 else _OUTSIDE
            levels[k] = _SILENT
        elif depth < skin:
            line = _line(min(depth, skin - depth), _ENTRY_MM)
            tissue[k] = _SKIN
            levels[k] = tones[DERMIS_DB] + line * (tones[EPIDERMIS_DB] - tones[DERMIS_DB])
        elif below < 0:
            row = (depth + np.float32(0.5) * values[WARP_Y, k]) * per_cell[1]
            column = (xs[k] + values[WARP_X, k]) * per_cell[2]
            bright = fat_db + np.float32(0.5) * values[BRIGHT, k]
            tissue[k] = _FAT
            levels[k] = bright + tones[FAT_SHEETS_DB] * _sample(sheets, row, column)
        elif below < fascia:
            share = below / fascia
            middle = share * (_ONE - share) * np.float32(4)
            tissue[k] = _FASCIA
            levels[k] = tones[FASCIA_DB] - dip * middle * middle * middle
        elif bone < 0:
            tissue[k] = _BONE
            rim = _line(bone, _CORTEX_MM)
            levels[k] = tones[MARROW_DB] + rim * (tones[BONE_DB] - tones[MARROW_DB])
        else:
            tissue[k] = _MUSCLE


@njit(cache=True, nogil=True)
@no_type_check
def _muscle_row(tissue, levels, values, xs, y, gaps, nearest, muscles, sheets, per_cell, tones):
    """Fill muscle, tendon and the loose tissue around them."""
    for k in range(xs.size):
        if tissue[k] != _MUSCLE:
            continue
        m = nearest[0, k]
        q = gaps[0, k] + muscles[m, WEIGHT]
        u, v = xs[k] + values[WARP_X, k] - muscles[m, X], y + values[WARP_Y, k] - muscles[m, Y]
        aside = muscles[m, COS] * u + muscles[m, SIN] * v + muscles[m, TEXTURE_X]
        down = muscles[m, COS] * v - muscles[m, SIN] * u + muscles[m, TEXTURE_Y]
        row, column = down * per_cell[1], aside * per_cell[2]
        if q < muscles[m, TENDON]:
            edge = q / muscles[m, TENDON]
            streaks = np.float32(7) * _sample(sheets, np.float32(2.3) * row, column)
            tissue[k] = _TENDON
            levels[k] = tones[TENDON_DB] + streaks - np.float32(5) * edge * edge
        else:
            streaks = muscles[m, GAIN_DB] * _sample(sheets, row, column)
            loose = min(max((q - muscles[m, FILL]) * np.float32(3), np.float32(0)), _ONE)
            level = tones[MUSCLE_DB] + muscles[m, LEVEL_DB] + values[BRIGHT, k]
            levels[k] = level + streaks + np.float32(5.5) * loose
            if loose > np.float32(0.5):
                tissue[k] = _FAT


@njit(cache=True, nogil=True)
@no_type_check
def _septa_row(tissue, levels, values, xs, y, gaps, nearest, muscles, tones):
    """Draw the borders between muscles, and the membrane between the bones."""
    width = tones[SEPTUM_MM]
    for k in range(xs.size):
        if values[FASCIA, k] < tones[FASCIA_MM] or values[BONE, k] < 0:
            continue
        if abs(values[MEMBRANE, k]) < np.float32(1.2) * width:
            tissue[k] = _FASCIA
            levels[k] = max(levels[k], tones[SEPTUM_DB])
        gap = gaps[1, k] - gaps[0, k]
        if gap > _NEAR_SEPTUM or tissue[k] == _TENDON:
            continue
        one, two = nearest[0, k], nearest[1, k]
        x, v = xs[k] + values[WARP_X, k], y + values[WARP_Y, k]
        u, s, t = x - muscles[one, X], x - muscles[two, X], v - muscles[two, Y]
        v -= muscles[one, Y]
        across = np.float32(2) * (muscles[two, A] * s - muscles[one, A] * u)
        across += muscles[two, B] * t - muscles[one, B] * v
        deep = np.float32(2) * (muscles[two, C] * t - muscles[one, C] * v)
        deep += muscles[two, B] * s - muscles[one, B] * u
        steepness = math.sqrt(across * across + deep * deep) + np.float32(1e-6)
        distance, flat = gap / steepness, abs(deep) / steepness
        # A border along the beam sends little back.
        bright = tones[SEPTUM_DB] - np.float32(10) * (_ONE - flat)
        levels[k] += _line(distance, width) * max(bright - levels[k], np.float32(0))
        if distance < width:
            tissue[k] = _FASCIA


@njit(cache=True, nogil=True)
@no_type_check
def _code_row(levels, echo):
    """Fill the codes of levels, 1 to 255, or 0 where it is silent."""
    for k in range(levels.size):
        code = min(max(_REFERENCE + np.float32(4) * levels[k], _ONE), np.float32(255))
        echo[k] = np.uint8(code) if levels[k] > _SILENT else np.uint8(0)


@njit(cache=True, nogil=True)
@no_type_check
def _coarse_cells(first, spacing, start, step, nodes, cells, shares):
    """Fill the coarse cell of each voxel along an axis, and where in it the voxel is."""
    for k in range(cells.size):
        place = (first + k * spacing - start) / step
        cells[k] = min(int(place), nodes - 2)
        shares[k] = place - cells[k]


@njit(cache=True, nogil=True)
@no_type_check
def fill_forearm(tissue, echo, start, origin, spacing, fields, step, muscles, tables, cells, tones):
    """Fill labels and echogenicity codes of some slices, ``(z, y, x)``.

    Args:
        tissue: Filled with labels.
        echo: Filled with codes.
        start: Which slice of the body is the first of them.
        origin: Body x, y, z of the body's first voxel and of the first coarse node.
        spacing: Of voxels.
        fields: Coarse fields, ``(fields, z, y, x)``.
        step: Distance of coarse nodes along x, y, z.
        muscles: Per slice of the body and muscle, the columns of ``forearm_muscles``.
        tables: Sheets in muscle and in fat, ``(2, z, y, x)``.
        cells: Size of their cells along z, y, x, ``(2, 3)``.
        tones: Thicknesses and levels.
    """
    columns = tissue.shape[2]
    xs = (origin[0] + spacing * np.arange(columns)).astype(np.float32)
    index, shares = np.empty(columns, np.int32), np.empty(columns, np.float32)
    _coarse_cells(origin[0], spacing, origin[0], step[0], fields.shape[3], index, shares)
    values = np.empty((FIELDS, columns), np.float32)
    slab = np.empty((FIELDS, fields.shape[2], fields.shape[3]), np.float32)
    row, levels = np.empty(fields.shape[3], np.float32), np.empty(columns, np.float32)
    sheets = np.empty((2, tables.shape[2], tables.shape[3]), np.float32)
    gaps, nearest = np.empty((2, columns), np.float32), np.empty((2, columns), np.int32)
    per_cell = (1 / cells).astype(np.float32)
    for n in range(tissue.shape[0]):
        along_z = (start + n) * spacing
        place = along_z / step[2]
        low = min(int(place), fields.shape[1] - 2)
        along = np.float32(place - low)
        for f in range(FIELDS):
            slab[f] = fields[f, low] + along * (fields[f, low + 1] - fields[f, low])
        for kind in range(2):
            blend_tables(tables[kind], (origin[2] + along_z) / cells[kind, 0], sheets[kind])
        for j in range(tissue.shape[1]):
            y = np.float32(origin[1] + j * spacing)
            _interpolate_row(slab, j * spacing / step[1], index, shares, row, values)
            labels = tissue[n, j]
            _shallow_row(labels, levels, values, xs, sheets[1], per_cell[1], tones)
            if values[FASCIA].max() < 0:
                _code_row(levels, echo[n, j])
                continue
            _two_nearest(
                muscles[start + n], xs, y, values[WARP_X], values[WARP_Y],
                gaps[0], gaps[1], nearest[0], nearest[1],
            )  # fmt: skip
            _muscle_row(
                labels, levels, values, xs, y, gaps, nearest,
                muscles[start + n], sheets[0], per_cell[0], tones,
            )  # fmt: skip
            _septa_row(labels, levels, values, xs, y, gaps, nearest, muscles[start + n], tones)
            _code_row(levels, echo[n, j])
