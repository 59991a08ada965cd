"""Where the planes of frames lie among the voxels.

Computed frame by frame in plain loops, not by a matrix library, so that a frame gives the
same bits alone and among others, and quickly when it is alone.
"""

import math
from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Float, Int
from numba import njit
from torch import Tensor

from sonosweep.scan import VolumeGrid, voxel_to_reference

_COLUMN, _ROW, _NORMAL, _ORIGIN = 0, 1, 2, 3
BRICK = 8

Planes = Float[np.ndarray, "frames parts=4 xyz=3"]
"""Per frame in the reference, mm: from one column to the next, from one row to the next,
the unit normal along image z, and the center of pixel (0, 0)."""


@dataclass(frozen=True, eq=False)
class Lattice:
    """A grid as the loops below need it.

    Attributes:
        size: Voxels along x, y and z.
        voxel_to_reference: Matrix from voxel (x, y, z, 1) to mm.
        reference_to_voxel: Its inverse.
    """

    size: Int[np.ndarray, "xyz=3"]
    voxel_to_reference: Float[np.ndarray, "3 4"]
    reference_to_voxel: Float[np.ndarray, "3 4"]


def lattice_of_grid(grid: VolumeGrid) -> Lattice:
    """Return the matrices of a grid."""
    voxel = voxel_to_reference(grid).numpy()
    return Lattice(
        np.array(grid.size, np.int64),
        np.ascontiguousarray(voxel[:3]),
        np.ascontiguousarray(np.linalg.inv(voxel)[:3]),
    )


def planes_of_frames(
    image_to_reference: Float[Tensor, "frames 4 4"], pixel_to_image: Float[Tensor, "4 4"]
) -> Planes:
    """Return the plane of each frame."""
    planes = np.empty((len(image_to_reference), 4, 3))
    _planes(
        np.require(image_to_reference.double().numpy(), requirements=["C", "W"]),
        np.require(pixel_to_image.double().numpy(), requirements=["C", "W"]),
        planes,
    )
    return planes


def gaps_mm(planes: Planes, rows: int, columns: int) -> Float[np.ndarray, " steps"]:
    """Return the gap between each frame and the next.

    It is the largest distance of a corner of either frame to the plane of the other.
    """
    gaps = np.empty(max(len(planes) - 1, 0))
    _gaps(planes, float(rows), float(columns), gaps)
    return gaps


def voxel_to_plane(
    planes: Planes,
    lattice: Lattice,
    rows: int,
    columns: int,
    reach_mm: Float[np.ndarray, " frames"],
) -> tuple[Float[np.ndarray, "frames 3 4"], Int[np.ndarray, "frames xyz=3 2"]]:
    """Return how voxels see each frame, and the bricks around it.

    Returns:
        Matrix from voxel (x, y, z, 1) to (column, row, height mm); first and one-past-last
        brick along x, y and z of the box that holds everything within reach.
    """
    matrix = np.empty((len(planes), 3, 4))
    boxes = np.empty((len(planes), 3, 2), np.int64)
    _matrices(planes, lattice.voxel_to_reference, matrix)
    _boxes(
        planes,
        lattice.reference_to_voxel,
        lattice.size,
        float(rows),
        float(columns),
        reach_mm,
        boxes,
    )
    return matrix, boxes


def axes_by_normal(planes: Planes, grid: VolumeGrid) -> Int[np.ndarray, "axes=3"]:
    """Return the volume's axes: the one nearest the mean normal, then slowest in memory."""
    # A frame seen from behind has the same plane: average without the sign.
    along = np.abs(planes[:, _NORMAL] @ np.asarray(grid.direction)).mean(axis=0)
    slow = int(np.argmax(along))
    rest = [axis for axis in (2, 1, 0) if axis != slow]
    return np.array([slow, *rest], np.int64)


@njit(cache=True, nogil=True)
@no_type_check
def _planes(poses, pixel, planes):
    for f in range(poses.shape[0]):
        plane = planes[f]
        for axis in range(3):
            turn = poses[f, axis]
            for part, source in ((_COLUMN, 0), (_ROW, 1), (_ORIGIN, 3)):
                plane[part, axis] = (
                    turn[0] * pixel[0, source] + turn[1] * pixel[1, source]
                ) + turn[2] * pixel[2, source]
            plane[_ORIGIN, axis] += turn[3]
        _cross(plane[_COLUMN], plane[_ROW], plane[_NORMAL])
        length = math.sqrt(_dot(plane[_NORMAL], plane[_NORMAL]))
        for axis in range(3):
            plane[_NORMAL, axis] /= length


@njit(cache=True, nogil=True)
@no_type_check
def _gaps(planes, rows, columns, gaps):
    for f in range(gaps.size):
        gap = _farthest_corner(planes[f], planes[f + 1], rows, columns)
        gaps[f] = max(gap, _farthest_corner(planes[f + 1], planes[f], rows, columns))


@njit(cache=True, nogil=True)
@no_type_check
def _farthest_corner(plane, other, rows, columns):
    """Largest distance of a corner of the other frame to this plane."""
    farthest = 0.0
    for u in (0.0, columns - 1.0):
        for v in (0.0, rows - 1.0):
            height = 0.0
            for axis in range(3):
                corner = other[_ORIGIN, axis] + u * other[_COLUMN, axis] + v * other[_ROW, axis]
                height += plane[_NORMAL, axis] * (corner - plane[_ORIGIN, axis])
            farthest = max(farthest, abs(height))
    return farthest


@njit(cache=True, nogil=True)
@no_type_check
def _matrices(planes, voxel_to_reference, matrix):
    gradient = np.empty((3, 3))
    for f in range(planes.shape[0]):
        plane = planes[f]
        _cross(plane[_ROW], plane[_NORMAL], gradient[0])
        _cross(plane[_NORMAL], plane[_COLUMN], gradient[1])
        across, down = _dot(gradient[0], plane[_COLUMN]), _dot(gradient[1], plane[_ROW])
        for axis in range(3):
            gradient[0, axis] /= across
            gradient[1, axis] /= down
            gradient[2, axis] = plane[_NORMAL, axis]
        for row in range(3):
            for k in range(4):
                total = 0.0
                for axis in range(3):
                    value = voxel_to_reference[axis, k]
                    if k == 3:
                        value -= plane[_ORIGIN, axis]
                    total += gradient[row, axis] * value
                matrix[f, row, k] = total


@njit(cache=True, nogil=True)
@no_type_check
def _boxes(planes, reference_to_voxel, size, rows, columns, reach, boxes):
    for f in range(planes.shape[0]):
        plane = planes[f]
        for axis in range(3):
            low, high = np.inf, -np.inf
            for u in (-0.5, columns - 0.5):
                for v in (-0.5, rows - 0.5):
                    place = reference_to_voxel[axis, 3]
                    for k in range(3):
                        point = plane[_ORIGIN, k] + u * plane[_COLUMN, k] + v * plane[_ROW, k]
                        place += reference_to_voxel[axis, k] * point
                    low, high = min(low, place), max(high, place)
            rise = abs(_dot(reference_to_voxel[axis, :3], plane[_NORMAL])) * reach[f]
            bricks = float(-(-size[axis] // BRICK))
            first = math.floor((low - rise) / BRICK)
            last = math.floor((high + rise) / BRICK) + 1.0
            boxes[f, axis, 0] = np.int64(min(max(first, 0.0), bricks))
            boxes[f, axis, 1] = np.int64(min(max(last, 0.0), bricks))


@njit(cache=True, nogil=True)
@no_type_check
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True, nogil=True)
@no_type_check
def _cross(a, b, out):
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]
