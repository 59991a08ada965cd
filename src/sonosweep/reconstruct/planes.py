"""Where the planes of frames lie among the voxels.

Computed with plain arithmetic per frame, not through a matrix library, so that a frame gives
the same bits alone and among others.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from torch import Tensor

from sonosweep.scan import VolumeGrid, voxel_to_reference


@dataclass(frozen=True, eq=False)
class Planes:
    """Planes of frames in the reference, mm.

    Attributes:
        column: From one column to the next.
        row: From one row to the next.
        normal: Unit vector along image z.
        origin: Center of pixel (0, 0).
    """

    column: Float[np.ndarray, "frames xyz=3"]
    row: Float[np.ndarray, "frames xyz=3"]
    normal: Float[np.ndarray, "frames xyz=3"]
    origin: Float[np.ndarray, "frames xyz=3"]

    def part(self, frames: slice) -> "Planes":
        """Return the planes of some of the frames."""
        return Planes(
            self.column[frames], self.row[frames], self.normal[frames], self.origin[frames]
        )


def planes_of_frames(
    image_to_reference: Float[Tensor, "frames 4 4"], pixel_to_image: Float[Tensor, "4 4"]
) -> Planes:
    """Return the plane of each frame."""
    pose, pixel = image_to_reference.double().numpy(), pixel_to_image.double().numpy()

    def turned(vector: np.ndarray) -> np.ndarray:
        x, y, z = vector
        return pose[:, :3, 0] * x + pose[:, :3, 1] * y + pose[:, :3, 2] * z

    column, row = turned(pixel[:3, 0]), turned(pixel[:3, 1])
    normal = _cross(column, row)
    return Planes(
        column=column,
        row=row,
        normal=normal / np.sqrt(_dot(normal, normal))[:, None],
        origin=turned(pixel[:3, 3]) + pose[:, :3, 3],
    )


def voxel_to_plane(planes: Planes, grid: VolumeGrid) -> Float[np.ndarray, "frames 3 4"]:
    """Return per frame the matrix from voxel (x, y, z, 1) to (column, row, height mm)."""
    across_row, across_column = (
        _cross(planes.row, planes.normal),
        _cross(planes.normal, planes.column),
    )
    gradients = (
        across_row / _dot(across_row, planes.column)[:, None],
        across_column / _dot(across_column, planes.row)[:, None],
        planes.normal,
    )
    voxel = voxel_to_reference(grid).numpy()
    matrix = np.empty((len(planes.origin), 3, 4))
    for k, gradient in enumerate(gradients):
        for axis in range(3):
            matrix[:, k, axis] = _dot(gradient, np.broadcast_to(voxel[:3, axis], gradient.shape))
        matrix[:, k, 3] = _dot(gradient, voxel[:3, 3] - planes.origin)
    return matrix


def voxel_bounds(
    planes: Planes,
    grid: VolumeGrid,
    rows: int,
    columns: int,
    reach_mm: Float[np.ndarray, " frames"],
) -> tuple[Float[np.ndarray, "frames xyz=3"], Float[np.ndarray, "frames xyz=3"]]:
    """Return the smallest and largest voxel coordinates within reach of each frame."""
    corners = _corners(planes, rows, columns, rim=0.5)
    direction, spacing = np.asarray(grid.direction), np.asarray(grid.spacing_mm)
    low, high = [], []
    for axis in range(3):
        unit = np.broadcast_to(direction[:, axis], planes.normal.shape)
        along = np.stack([_dot(corner - grid.origin_mm, unit) for corner in corners])
        reach = reach_mm * np.abs(_dot(planes.normal, unit))
        low.append((along.min(axis=0) - reach) / spacing[axis])
        high.append((along.max(axis=0) + reach) / spacing[axis])
    return np.stack(low, axis=1), np.stack(high, axis=1)


def gaps_mm(planes: Planes, rows: int, columns: int) -> Float[np.ndarray, " steps"]:
    """Return the gap between each frame and the next.

    It is the largest distance of a corner of either frame to the plane of the other.
    """
    this, following = planes.part(slice(0, -1)), planes.part(slice(1, None))
    distances = []
    for plane, other in ((this, following), (following, this)):
        for corner in _corners(other, rows, columns):
            distances.append(np.abs(_dot(plane.normal, corner - plane.origin)))
    return np.stack(distances).max(axis=0)


def axes_by_normal(planes: Planes, grid: VolumeGrid) -> Int[np.ndarray, "axes=3"]:
    """Return the volume's axes: the one nearest the mean normal, then slowest in memory."""
    # A frame seen from behind has the same plane: average without the sign.
    slow = int(np.argmax(np.abs(planes.normal @ np.asarray(grid.direction)).mean(axis=0)))
    rest = [axis for axis in (2, 1, 0) if axis != slow]
    return np.array([slow, *rest], np.int64)


def _corners(planes: Planes, rows: int, columns: int, rim: float = 0.0) -> list[np.ndarray]:
    return [
        planes.origin + planes.column * u + planes.row * v
        for u in (-rim, columns - 1 + rim)
        for v in (-rim, rows - 1 + rim)
    ]


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2]


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.stack(
        (
            a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1],
            a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2],
            a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0],
        ),
        axis=1,
    )
