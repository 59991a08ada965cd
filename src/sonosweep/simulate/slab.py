"""Which cells of the medium a frame sees: those in the slice of tissue before the probe."""

import math
from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32, Int64
from numba import njit

from sonosweep.simulate.beam import Beam
from sonosweep.simulate.body import Body
from sonosweep.simulate.coded_voxels import codes_and_values
from sonosweep.simulate.medium import CELL_MM, SETS, hash_cell
from sonosweep.simulate.point_spread import (
    REFERENCE_CELL_MM3,
    PointSpread,
    rayleigh_range_mm,
)

HALF_MM = CELL_MM / 2
SLICE_REACH = 1.4
"""Slice widths from the plane beyond which scatterers do not count: 2 % of the amplitude."""
MORE_OUT_OF_FOCUS = 1.5
"""Scatterers per resolution cell, if there are enough, relative to the default beam's focus:
11 there leave the amplitude's statistics measurably short of Rayleigh's."""
FADE = 0.4
"""Part of the scatterers that count over which they fade. Without it scatterers would come
and go at once when a cell's depth changes, and speckle that moves along the beam by 1.5 mm
out of focus would lose 5 % of its correlation."""
EFFECTIVE = (1 - 2 * FADE / 3) ** 2 / (1 - 4 * FADE / 5)
"""As how many that do not fade those count: (sum of a^2)^2 / sum of a^4, amplitudes a."""


class Slab(NamedTuple):
    """The space before the probe that a frame sees, in plane coordinates.

    Attributes:
        first: Smallest lateral coordinate (mm, or rad of a sector) and depth (mm).
        last: Largest ones.
        radius_mm: Of the array's face; 0 if it is flat.
        focus_mm: Depth of the elevation focus.
        range_mm: Rayleigh range of the elevational beam.
        waist_mm: Its width at the focus.
        wavelength_mm: Of the sound.
        thinning: At the focus, the part of the scatterers that count; above 1, all do.
        lateral_mm: Depth below the face at which a sector's ``thinning`` holds.
    """

    first: tuple[float, float]
    last: tuple[float, float]
    radius_mm: float
    focus_mm: float
    range_mm: float
    waist_mm: float
    wavelength_mm: float
    thinning: float
    lateral_mm: float


class CellTable(NamedTuple):
    """Cells of the medium in a body.

    Attributes:
        first: Number of the first cell along x, y, z.
        audible: Whether a cell has anything in it that scatters, ``(z, y, x)``.
    """

    first: tuple[int, int, int]
    audible: Bool[np.ndarray, "z y x"]


class SeenCells(NamedTuple):
    """What a frame sees of the medium.

    Attributes:
        place: Number along x, y and z of each cell, its set of scatterers, its mirrored
            axes (bits 0, 1, 2 for x, y, z), and how many of its scatterers count.
        gain: Largest amplitude of its scatterers; and ``top`` and ``slope``, so that number n
            has the amplitude top - slope * n where that is smaller.
    """

    place: Int32[np.ndarray, "cells 6"]
    gain: Float32[np.ndarray, "cells 3"]


class CellRoom:
    """Memory for the cells that a frame sees, used from frame to frame."""

    def __init__(self) -> None:
        self.grow(4096)

    def grow(self, cells: int) -> None:
        """Make room for that many."""
        self.cells = SeenCells(np.empty((cells, 6), np.int32), np.empty((cells, 3), np.float32))


def slab_of(beam: Beam, spread: PointSpread) -> Slab:
    """Return the space that frames of a beam on a grid see."""
    last = [spread.origin[a] + spread.steps[a] * (spread.shape[1 - a] - 1) for a in (0, 1)]
    cell = beam.axial_fwhm_mm * beam.lateral_fwhm_mm * beam.elevation_waist_mm
    return Slab(
        first=(float(spread.origin[0]), max(0.0, float(spread.origin[1]))),
        last=(float(last[0]), float(last[1])),
        radius_mm=float(spread.radius_mm),
        focus_mm=float(beam.elevation_focus_mm),
        range_mm=rayleigh_range_mm(beam),
        waist_mm=float(beam.elevation_waist_mm),
        wavelength_mm=beam.wavelength_mm,
        thinning=MORE_OUT_OF_FOCUS * REFERENCE_CELL_MM3 / cell,
        lateral_mm=float(beam.sector_depth_mm),
    )


def cell_table(body: Body) -> CellTable:
    """Return which cells of the medium can be heard in a body."""
    size = np.array(body.echogenicity.shape[::-1])
    low = np.asarray(body.origin_mm) - body.spacing_mm / 2
    first = np.floor(low / CELL_MM).astype(np.int64)
    end = np.floor((low + size * body.spacing_mm) / CELL_MM).astype(np.int64) + 1
    audible = np.zeros(tuple((end - first)[::-1]), np.bool_)
    # Voxels that each cell touches, and one more against rounding.
    spans = []
    for axis in range(3):
        edges = np.arange(first[axis], end[axis] + 1) * CELL_MM - low[axis]
        voxels = np.floor(edges / body.spacing_mm).astype(np.int64)
        span = np.stack([voxels[:-1] - 1, voxels[1:] + 2], axis=1)
        spans.append(np.clip(span, 0, size[axis]))
    codes, values = codes_and_values(body.echogenicity)
    _mark_audible(codes, values > 0, *spans, audible)
    return CellTable((int(first[0]), int(first[1]), int(first[2])), audible)


@njit(cache=True, nogil=True)
@no_type_check
def _mark_audible(voxels, heard, span_x, span_y, span_z, audible):
    for k in range(audible.shape[0]):
        for j in range(audible.shape[1]):
            for i in range(audible.shape[2]):
                audible[k, j, i] = _any_echo(voxels, heard, span_x[i], span_y[j], span_z[k])


@njit(cache=True, nogil=True)
@no_type_check
def _any_echo(voxels, heard, span_x, span_y, span_z):
    for z in range(span_z[0], span_z[1]):
        for y in range(span_y[0], span_y[1]):
            for x in range(span_x[0], span_x[1]):
                if heard[voxels[z, y, x]]:
                    return True
    return False


def seen_cells(
    slab: Slab,
    table: CellTable,
    sets_first: np.ndarray,
    word: np.uint64,
    affine: Float[np.ndarray, "4 4"],
    push_mm: float,
    room: CellRoom,
) -> SeenCells:
    """Return the cells that a frame sees.

    Args:
        slab: What frames see.
        table: The cells of the body.
        sets_first: Of :class:`~sonosweep.simulate.medium.ScattererSets`.
        word: Of the medium.
        affine: Body to plane coordinates.
        push_mm: Largest movement that pulsating arteries add.
        room: For the result, which is valid until the room is used again.
    """
    box = _cell_box(slab, table, affine, push_mm)
    while True:
        count = _list_cells(slab, table, box, sets_first, word, affine, push_mm, *room.cells)
        if count <= len(room.cells.gain):
            return SeenCells(room.cells.place[:count], room.cells.gain[:count])
        room.grow(count + count // 4)


def _cell_box(
    slab: Slab, table: CellTable, affine: np.ndarray, push_mm: float
) -> Int64[np.ndarray, "2 3"]:
    """First and one-past-last cell along x, y, z of the body that may meet the slab."""
    lateral, axial, height = _slab_box(slab)
    corners = np.array([(x, y, z) for x in lateral for y in axial for z in (-height, height)])
    grown = corners + np.sign(corners - corners.mean(0)) * push_mm
    inside = (grown - affine[:3, 3]) @ np.linalg.inv(affine[:3, :3]).T / CELL_MM
    low, size = np.array(table.first), np.array(table.audible.shape[::-1])
    first = np.clip(np.floor(inside.min(0)) - low, 0, size)
    end = np.clip(np.floor(inside.max(0)) + 1 - low, 0, size)
    return np.stack([first, end]).astype(np.int64)


def _slab_box(slab: Slab) -> tuple[tuple[float, float], tuple[float, float], float]:
    """Lateral, axial and elevational extent of a slab."""
    widest = max(abs(slab.first[1] - slab.focus_mm), abs(slab.last[1] - slab.focus_mm))
    height = SLICE_REACH * slab.waist_mm * math.hypot(1, widest / slab.range_mm)
    if slab.radius_mm == 0:
        return (slab.first[0], slab.last[0]), (slab.first[1], slab.last[1]), height
    far, near = slab.radius_mm + slab.last[1], slab.radius_mm + slab.first[1]
    angle = min(max(abs(slab.first[0]), abs(slab.last[0])), math.pi)
    side = far * math.sin(min(angle, math.pi / 2))
    top = min(near * math.cos(angle), far * math.cos(angle))
    return (-side, side), (top - slab.radius_mm, slab.last[1]), height


@njit(cache=True, nogil=True)
@no_type_check
def _list_cells(slab, table, box, sets_first, word, affine, push_mm, place, gain):
    """Fill in the cells that meet the slab; returns how many there are."""
    count = 0
    half = np.empty(3)
    for axis in range(3):
        half[axis] = push_mm
        for b in range(3):
            half[axis] += abs(affine[axis, b]) * HALF_MM
    # Cells one behind the other across the slice share pixels: those follow each other.
    slow, mid, fast = np.argsort(np.abs(affine[2, :3]))
    cell = np.empty(3, np.int64)
    for a in range(box[0, slow], box[1, slow]):
        for b in range(box[0, mid], box[1, mid]):
            for c in range(box[0, fast], box[1, fast]):
                cell[slow], cell[mid], cell[fast] = a, b, c
                if not table.audible[cell[2], cell[1], cell[0]]:
                    continue
                number = (
                    table.first[0] + cell[0],
                    table.first[1] + cell[1],
                    table.first[2] + cell[2],
                )
                depth = _depth_if_seen(slab, affine, number, half)
                if depth < 0:
                    continue
                if count < gain.shape[0]:
                    part = _part_that_counts(slab, depth)
                    _fill_cell(number, word, sets_first, part, place[count], gain[count])
                count += 1
    return count


@njit(cache=True, nogil=True)
@no_type_check
def _fill_cell(number, word, sets_first, part, row, gain):
    bits = np.int64(hash_cell(number[0], number[1], number[2], word))
    row[0], row[1], row[2] = number
    row[3] = bits % SETS
    row[4] = (bits // SETS) & 7
    stored = sets_first[row[3] + 1] - sets_first[row[3]]
    # Ranks are (n + chance) / stored: unbiased even where less than one counts.
    chance = (bits >> 12) / (1 << 20)
    counts = max(part * stored, 1e-9)
    row[5] = min(stored, max(0, np.int64(math.ceil(counts - chance))))
    gain[0] = 1 / math.sqrt(part * _mean_power(1 / part))
    gain[1] = gain[0] * (1 - chance / counts) / FADE
    gain[2] = gain[0] / (FADE * counts)


@njit(cache=True, nogil=True)
@no_type_check
def _mean_power(last):
    """Integral of the squared fading amplitude over rank / part from 0 to ``last``."""
    if last <= 1 - FADE:
        return last
    rest = max(1 - last, 0.0)
    return 1 - FADE + (FADE**3 - rest**3) / (3 * FADE**2)


@njit(cache=True, nogil=True)
@no_type_check
def _depth_if_seen(slab, affine, number, half):
    """Depth of a cell's middle, 0 or more, or -1 if no part of it is in the slab."""
    lateral, axial, height = affine[0, 3], affine[1, 3], affine[2, 3]
    for axis in range(3):
        middle = (number[axis] + 0.5) * CELL_MM
        lateral += affine[0, axis] * middle
        axial += affine[1, axis] * middle
        height += affine[2, axis] * middle
    if slab.radius_mm == 0:
        depth, thick = axial, half[1]
        beside = lateral + half[0] < slab.first[0] or lateral - half[0] > slab.last[0]
    else:
        distance = math.hypot(lateral, axial + slab.radius_mm)
        depth, thick = distance - slab.radius_mm, math.hypot(half[0], half[1])
        angle = math.atan2(lateral, axial + slab.radius_mm)
        wide = math.pi if thick >= distance else math.asin(thick / distance)
        beside = angle + wide < slab.first[0] or angle - wide > slab.last[0]
    if beside or depth + thick < slab.first[1] or depth - thick > slab.last[1]:
        return -1.0
    t = (abs(depth - slab.focus_mm) + thick) / slab.range_mm
    if abs(height) - half[2] > SLICE_REACH * slab.waist_mm * math.sqrt(1 + t * t):
        return -1.0
    return max(depth, 0.0)


@njit(cache=True, nogil=True)
@no_type_check
def _part_that_counts(slab, depth):
    """Part of a cell's scatterers that count, so that a resolution cell has as many at all depths.

    Above 1, all count, and those of high rank fade less.
    """
    t = (depth - slab.focus_mm) / slab.range_mm
    part = slab.thinning / EFFECTIVE / math.sqrt(1 + t * t)
    if slab.radius_mm > 0:
        part *= (slab.radius_mm + slab.lateral_mm) / (slab.radius_mm + depth)
    return part
