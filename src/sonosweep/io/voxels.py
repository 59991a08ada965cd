"""What the volume formats share: any axes in, our grid out."""

from collections.abc import Mapping
from dataclasses import replace
from os import PathLike

import numpy as np
from jaxtyping import Float

from sonosweep.errors import FormatError
from sonosweep.io.world import World, grid_from_lps, lps_from_grid
from sonosweep.scan import Volume, VolumeGrid


def lps_matrix(grid: VolumeGrid, world: World) -> Float[np.ndarray, "4 4"]:
    """Return the matrix from voxel indices (x, y, z) to the file's LPS, mm."""
    origin, direction = lps_from_grid(grid, world)
    matrix = np.eye(4)
    matrix[:3, :3] = direction * np.asarray(grid.spacing_mm)
    matrix[:3, 3] = origin
    return matrix


def volume_from_lps(
    voxels: np.ndarray,
    voxel_to_lps: Float[np.ndarray, "4 4"],
    world: World,
    settings: Mapping[str, str] | None = None,
) -> Volume:
    """Return voxels ``(z, y, x[, channels])`` placed as a file says.

    Our grids are right-handed; the slices of a left-handed one are taken in the other
    order, which leaves every voxel where it is.

    Raises:
        ScanError: If a spacing is zero or the axes are not perpendicular.
    """
    matrix = np.array(voxel_to_lps, dtype=np.float64)
    if np.linalg.det(matrix[:3, :3]) < 0:
        voxels = voxels[::-1]
        matrix[:3, 3] += (voxels.shape[0] - 1) * matrix[:3, 2]
        matrix[:3, 2] *= -1
    spacing = np.linalg.norm(matrix[:3, :3], axis=0)
    direction = matrix[:3, :3] / np.where(spacing > 0, spacing, 1.0)
    depth, rows, columns = voxels.shape[:3]
    grid = grid_from_lps(
        size=(columns, rows, depth),
        spacing_mm=(float(spacing[0]), float(spacing[1]), float(spacing[2])),
        origin_lps_mm=matrix[:3, 3],
        direction_lps=direction,
        world=world,
    )
    return Volume(voxels=voxels, grid=grid, settings=dict(settings or {}))


def with_stored_type(volume: Volume, types: frozenset[str], path: str | PathLike) -> Volume:
    """Return the volume with voxels of a type that the format has.

    Masks become 0 and 1. Nothing else is converted: it would change the values.

    Args:
        volume: Any.
        types: NumPy names of the types that the format stores.
        path: For the message.

    Raises:
        FormatError: If the format has no such type, naming those that it has.
    """
    if volume.voxels.dtype == np.bool_:
        return replace(volume, voxels=volume.voxels.astype(np.uint8))
    if volume.voxels.dtype.name not in types:
        raise FormatError(
            f"cannot write voxels of type {volume.voxels.dtype} to '{path}'; convert them to"
            f" one of {', '.join(sorted(types))}"
        )
    return volume


def stated_world(stated: object, otherwise: World) -> World:
    """Return the world that a file states, or the other one if it states none."""
    if stated == "ras" or stated == "lps":
        return "ras" if stated == "ras" else "lps"
    return otherwise
