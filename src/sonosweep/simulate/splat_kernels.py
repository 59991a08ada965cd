"""Loops that put the scatterers of a medium on a fine grid.

Scatterers are taken in blocks of one cell: a first pass places a block before the probe and
weighs it, without branches, so that the compiler works on many at once; a second one reads
the tissue's echogenicity and adds to the grid. Places within a cell are in single precision,
those of cells in double precision, so that the phase does not suffer far from the origin.
"""

import math
from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float32, UInt8
from numba import njit

from sonosweep.simulate.medium import CELL_MM
from sonosweep.simulate.slab import SLICE_REACH
from sonosweep.simulate.tissue_motion import push

BLOCK = 128
REACH_EXPONENT = 2 * SLICE_REACH**2
"""A scatterer counts if the two-way amplitude across the slice is above exp(-this)."""


class FineGrid(NamedTuple):
    """The beam on the fine grid.

    Attributes:
        origin: Lateral (mm or rad) and axial (mm) coordinate of its first pixel.
        per_step: Fine pixels per mm (or rad) and per mm.
        radius_mm: Of the array's face; 0 if it is flat.
        focus_mm: Depth of the elevation focus.
        per_range: One over the Rayleigh range.
        slice_exponent: 2 / w0^2: exponent of the two-way amplitude at the focus, per mm2.
        turns_per_mm: Of the phase, by depth.
        curve_turns: Of the phase at depth D below the focus and height z off the plane,
            per z^2 D / (1 + (D / range)^2).
    """

    origin: tuple[float, float]
    per_step: tuple[float, float]
    radius_mm: float
    focus_mm: float
    per_range: float
    slice_exponent: float
    turns_per_mm: float
    curve_turns: float


class Voxels(NamedTuple):
    """The body's echogenicity.

    Attributes:
        codes: Of every voxel, ``(z, y, x)``.
        origin_mm: Centre of the first one, as x, y, z.
        spacing_mm: Of the voxels.
        amplitude: Of a scatterer, by code.
    """

    codes: UInt8[np.ndarray, "z y x"]
    origin_mm: tuple[float, float, float]
    spacing_mm: float
    amplitude: Float32[np.ndarray, "256"]


# One array holds a block's scratch: the compiler then sees that its parts are apart.
_X, _Y, _Z, _U, _V, _RE, _IM = (BLOCK * part for part in range(7))
_F_LANES = 7 * BLOCK
_VOXEL, _PIXEL = 0, BLOCK
_I_LANES = 2 * BLOCK

_1, _2, _3 = np.uint64(1), np.uint64(2), np.uint64(3)
_ZERO, _ONE, _TWO = np.float32(0), np.float32(1), np.float32(2)
# Polynomials through Chebyshev nodes; their errors are below single precision.
_SIN_PI = tuple(
    np.float32(c) for c in (3.14159264, -5.16771008, 2.55007739, -0.598290411, 0.0776559122)
)
"""sin(pi t) / t in powers of t^2, |t| <= 1/2."""
_COS_PI = tuple(
    np.float32(c) for c in (1, -4.93480214, 4.05870915, -1.33521195, 0.234937068, -0.024395932)
)
"""cos(pi t) in powers of t^2, |t| <= 1/2."""
_EXP = tuple(
    np.float32(c)
    for c in (0.999999991, -0.999998765, 0.499971021, -0.166416674, 0.0406822005, -0.0065045073)
)
"""exp(-t), 0 <= t <= 1/2."""
_TWICE_ATAN = tuple(
    np.float32(c)
    for c in (
        2,
        -0.66666589,
        0.399966792,
        -0.285164683,
        0.217649776,
        -0.160345723,
        0.0936751312,
        -0.0293945943,
    )
)
"""2 atan(t) / t in powers of t^2, |t| <= 0.7 (a sector of 140 degrees)."""


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def splat_cells(place, gain, offsets, first, affine, arteries, fine, voxels, grid):
    """Add the echoes of the scatterers of cells to the fine grid.

    Args:
        place: See :class:`~sonosweep.simulate.slab.SeenCells`.
        gain: As well.
        offsets: See :class:`~sonosweep.simulate.medium.ScattererSets`.
        first: As well.
        affine: Body to plane coordinates.
        arteries: That pulsate; see :func:`~sonosweep.simulate.tissue_motion.pushes`.
        fine: The beam.
        voxels: The body.
        grid: Fine grid, ``(rows, columns, 2)``, real and imaginary part; added to.
    """
    lanes, places = np.empty(_F_LANES, np.float32), np.empty(_I_LANES, np.int32)
    picked = np.empty(BLOCK, np.int32)
    flat = grid.reshape(grid.size)
    center, corner = np.empty(3), np.empty(3, np.int64)
    turn, voxel = np.empty((3, 3), np.float32), np.empty((3, 2), np.float32)
    shape = voxels.codes.shape
    strides = np.array([1, shape[2], shape[2] * shape[1]])
    for c in range(gain.shape[0]):
        at_edge = _cell_frame(place[c], affine, voxels, center, turn, voxel, corner)
        first_voxel = (corner * strides).sum()
        begin, end = first[place[c, 3]], first[place[c, 3]] + place[c, 5]
        for start in range(begin, end, BLOCK):
            _place(offsets, start, turn, voxel, strides, lanes, places)
            if at_edge:
                _mark_outside(offsets, start, voxel, corner, shape, places)
            if arteries.shape[0] > 0:
                _push_block(lanes, center, arteries)
            if fine.radius_mm > 0:
                depth = _across_sector(lanes, center, fine)
            else:
                depth = _across_array(lanes, center, fine)
            _weigh(lanes, places, depth, center[2], gain[c], start - begin, fine, grid.shape)
            kept = _pick(lanes, places, min(end - start, BLOCK), picked)
            _deposit(lanes, places, picked, kept, first_voxel, voxels, flat, 2 * grid.shape[1])


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _cell_frame(place, affine, voxels, center, turn, voxel, corner):
    """Fill in where a cell is in the plane and in the voxels; says if it may reach outside.

    Args:
        place: Of the cell; see :class:`~sonosweep.simulate.slab.SeenCells`.
        affine: Body to plane coordinates.
        voxels: The body.
        center: Filled with its middle in plane coordinates.
        turn: Filled with the matrix of offsets from there.
        voxel: Filled with the middle in voxels from the corner, plus 1/2, and the scale.
        corner: Filled with a voxel below all that its scatterers are in.
    """
    center[:] = affine[:3, 3]
    at_edge = False
    half = 0.5 * CELL_MM / voxels.spacing_mm
    for axis in range(3):
        middle = (place[axis] + 0.5) * CELL_MM
        sign = -1.0 if (place[4] >> axis) & 1 else 1.0
        for row in range(3):
            center[row] += affine[row, axis] * middle
            turn[row, axis] = affine[row, axis] * sign
        at = (middle - voxels.origin_mm[axis]) / voxels.spacing_mm + 0.5
        corner[axis] = np.int64(math.floor(at - half)) - 1
        voxel[axis, 0], voxel[axis, 1] = at - corner[axis], sign / voxels.spacing_mm
        last = np.int64(math.ceil(at + half)) + 1
        at_edge |= corner[axis] < 0 or last >= voxels.codes.shape[2 - axis]
    return at_edge


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _pick(lanes, places, count, picked):
    """List the scatterers of a block that count."""
    kept = 0
    for m in range(count):
        picked[kept] = m
        kept += (lanes[_U + m] >= _ZERO) & (places[_VOXEL + m] >= 0)
    return kept


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _place(offsets, start, turn, voxel, strides, lanes, places):
    """Offsets from the cell's middle in plane coordinates, and voxels from its corner."""
    along_y, along_z = np.int32(strides[1]), np.int32(strides[2])
    x, y, z = offsets[0], offsets[1], offsets[2]
    t00, t01, t02 = turn[0, 0], turn[0, 1], turn[0, 2]
    t10, t11, t12 = turn[1, 0], turn[1, 1], turn[1, 2]
    t20, t21, t22 = turn[2, 0], turn[2, 1], turn[2, 2]
    bx, by, bz = voxel[0, 0], voxel[1, 0], voxel[2, 0]
    sx, sy, sz = voxel[0, 1], voxel[1, 1], voxel[2, 1]
    for m in range(BLOCK):
        a, b, c = x[start + m], y[start + m], z[start + m]
        lanes[_X + m] = t00 * a + t01 * b + t02 * c
        lanes[_Y + m] = t10 * a + t11 * b + t12 * c
        lanes[_Z + m] = t20 * a + t21 * b + t22 * c
        i, j, k = np.int32(bx + sx * a), np.int32(by + sy * b), np.int32(bz + sz * c)
        places[_VOXEL + m] = i + j * along_y + k * along_z


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _mark_outside(offsets, start, voxel, corner, shape, places):
    """Mark scatterers outside the voxels by a voxel of -1, as :func:`_place` rounds."""
    for m in range(BLOCK):
        for axis in range(3):
            here = np.int32(voxel[axis, 0] + voxel[axis, 1] * offsets[axis, start + m])
            if not 0 <= corner[axis] + here < shape[2 - axis]:
                places[_VOXEL + m] = -1


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _push_block(lanes, center, arteries):
    for m in range(BLOCK):
        dx, dy = push(center[0] + lanes[_X + m], center[1] + lanes[_Y + m], arteries)
        lanes[_X + m] += np.float32(dx)
        lanes[_Y + m] += np.float32(dy)


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _across_array(lanes, center, fine):
    """Fill in the lateral fine pixel; lateral offsets are used up, axial ones stay."""
    per_mm = np.float32(fine.per_step[0])
    first = np.float32((center[0] - fine.origin[0]) * fine.per_step[0])
    for m in range(BLOCK):
        lanes[_U + m] = first + lanes[_X + m] * per_mm
    return center[1]


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _across_sector(lanes, center, fine):
    """Fill in the lateral fine pixel; axial offsets become those along the line."""
    cx, cy = np.float32(center[0]), np.float32(center[1] + fine.radius_mm)
    distance = math.hypot(center[0], center[1] + fine.radius_mm)
    middle = np.float32(distance)
    per_rad, first = np.float32(fine.per_step[0]), np.float32(-fine.origin[0] * fine.per_step[0])
    c0, c1, c2, c3, c4, c5, c6, c7 = _TWICE_ATAN
    for m in range(BLOCK):
        x, y = lanes[_X + m], lanes[_Y + m]
        # The difference of the distances, without taking one from the other.
        more = _TWO * (cx * x + cy * y) + x * x + y * y
        far = np.float32(math.sqrt(max(middle * middle + more, _ZERO)))
        along = more / (far + middle)
        t = (cx + x) / (far + max(cy + y, _ZERO))
        q = t * t
        high = ((c7 * q + c6) * q + c5) * q + c4
        angle = t * ((((high * q + c3) * q + c2) * q + c1) * q + c0)
        lanes[_U + m] = first + angle * per_rad
        lanes[_Y + m] = along
    return distance - fine.radius_mm


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _weigh(lanes, places, depth, height, gain, rank, fine, shape):
    """Fill in the fine pixel, the fractions beside and below it, and the echo.

    A fraction of -1 beside it marks a scatterer that does not count.
    """
    first = np.float32((depth - fine.origin[1]) * fine.per_step[1])
    per_mm = np.float32(fine.per_step[1])
    # Beyond the face nothing is heard.
    face = np.float32(max(0.0, -fine.origin[1] * fine.per_step[1]))
    below, z0 = np.float32(depth - fine.focus_mm), np.float32(height)
    per_range, exponent = np.float32(fine.per_range), np.float32(fine.slice_exponent)
    turns = depth * fine.turns_per_mm
    first_turn = np.float32(turns - math.floor(turns))
    per_turn, curve = np.float32(fine.turns_per_mm), np.float32(fine.curve_turns)
    columns, rows, width = np.float32(shape[1] - 1), np.float32(shape[0] - 1), np.int32(shape[1])
    limit, eighth = np.float32(REACH_EXPONENT), np.float32(0.125)
    most, slope = gain[0], gain[2]
    top = gain[1] - slope * np.float32(rank)
    s0, s1, s2, s3, s4 = _SIN_PI
    c0, c1, c2, c3, c4, c5 = _COS_PI
    e0, e1, e2, e3, e4, e5 = _EXP
    shift, whole = np.float32(4096.5), np.float32(4096)
    for m in range(BLOCK):
        y, z = lanes[_Y + m], z0 + lanes[_Z + m]
        u, v = lanes[_U + m], first + y * per_mm
        deep = below + y
        t = deep * per_range
        inverse = _ONE / (_ONE + t * t)
        zz = z * z
        e = zz * inverse * exponent
        # One comparison, not five: the compiler then works on many scatterers at once.
        beside = max(_ZERO - u, u - columns)
        beyond = max(face - v, v - rows)
        out = max(max(beside, beyond), e - limit)
        x = min(e, limit) * eighth
        w = ((((e5 * x + e4) * x + e3) * x + e2) * x + e1) * x + e0
        w *= w
        w *= w
        w *= w * min(most, top - slope * np.float32(np.int32(m)))
        h = first_turn + y * per_turn + min(zz, np.float32(400)) * deep * inverse * curve
        h -= np.float32(np.int32(h + shift)) - whole
        q = h * h
        sine = h * ((((s4 * q + s3) * q + s2) * q + s1) * q + s0)
        cosine = ((((c5 * q + c4) * q + c3) * q + c2) * q + c1) * q + c0
        column, row = np.int32(min(max(u, _ZERO), columns)), np.int32(min(max(v, _ZERO), rows))
        places[_PIXEL + m] = np.int32(2) * (row * width + column)
        lanes[_U + m] = u - np.float32(column) if out < _ZERO else -_ONE
        lanes[_V + m] = v - np.float32(row)
        lanes[_RE + m] = w * (_ONE - _TWO * sine * sine)
        lanes[_IM + m] = -_TWO * w * sine * cosine


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _deposit(lanes, places, picked, kept, first_voxel, voxels, flat, width):
    """Read the tissue of the scatterers that count and add their echoes to the grid."""
    codes = voxels.codes.reshape(voxels.codes.size)
    for n in range(kept):
        m = np.uint64(picked[n])
        code = codes[np.uint64(first_voxel + places[_VOXEL + m])]
        amplitude = voxels.amplitude[code]
        if amplitude == 0:
            continue
        real, imaginary = lanes[_RE + m] * amplitude, lanes[_IM + m] * amplitude
        add_echo(flat, width, places[_PIXEL + m], lanes[_U + m], lanes[_V + m], real, imaginary)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
@no_type_check
def add_echo(flat, width, at, right, down, real, imaginary):
    """Share an echo between four fine pixels.

    Args:
        flat: The fine grid, ``(rows * columns * 2)``.
        width: Numbers per row of it.
        at: Of the pixel above and left of the echo.
        right: How far the echo is from there, in columns.
        down: As well, in rows.
        real: The echo.
        imaginary: As well.
    """
    a, b = np.uint64(at), np.uint64(at + width)
    re, im = real * right, imaginary * right
    real, imaginary = real - re, imaginary - im
    up = _ONE - down
    left_re, left_im = flat[a] + real * up, flat[a + _1] + imaginary * up
    right_re, right_im = flat[a + _2] + re * up, flat[a + _3] + im * up
    flat[a], flat[a + _1], flat[a + _2], flat[a + _3] = left_re, left_im, right_re, right_im
    left_re, left_im = flat[b] + real * down, flat[b + _1] + imaginary * down
    right_re, right_im = flat[b + _2] + re * down, flat[b + _3] + im * down
    flat[b], flat[b + _1], flat[b + _2], flat[b + _3] = left_re, left_im, right_re, right_im
