"""Which tissue lies at each pixel of a frame."""

import math
from typing import no_type_check

import numpy as np
from jaxtyping import Float, UInt8
from numba import njit

from sonosweep.errors import ScanError
from sonosweep.imaging import PixelGrid, SectorGrid
from sonosweep.simulate.body import Body
from sonosweep.simulate.coded_voxels import Values, codes_and_values
from sonosweep.simulate.deformation import STILL, Deformation
from sonosweep.simulate.tissue_motion import body_to_plane, pushes, undo_push


def sample_plane(
    volume: Values,
    body: Body,
    plane_to_body: Float[np.ndarray, "4 4"],
    grid: PixelGrid | SectorGrid,
    deformation: Deformation = STILL,
    *,
    axial_stride: int = 1,
) -> UInt8[np.ndarray, "rows columns"]:
    """Return the value of the voxel that is at each pixel of a frame.

    Args:
        volume: On the body's voxels, such as its ``tissue``.
        body: Says where the voxels are.
        plane_to_body: Pose of the imaging plane; its origin is the middle of the array's
            face.
        grid: Of the frame; of a sector, rows are samples and columns lines.
        deformation: Of the tissue in this frame. It is undone: the result is what has come
            to each pixel.
        axial_stride: Take only every so many rows.

    Returns:
        A value for each pixel; 0 outside the voxels.

    Raises:
        ScanError: If the volume is not on the body's voxels or the pose not a rigid one.
    """
    if volume.shape != body.tissue.shape:
        raise ScanError(
            f"a volume of shape {volume.shape} is not on the voxels of phantom '{body.name}',"
            f" whose shape is {body.tissue.shape}"
        )
    plane_to_voxel = _body_to_voxel(body) @ np.linalg.inv(body_to_plane(plane_to_body, deformation))
    if isinstance(grid, PixelGrid):
        lateral, depths, radius = grid.lateral_mm, grid.axial_mm, 0.0
    else:
        lateral, depths, radius = grid.angles_rad, grid.depths_mm, grid.radius_mm
    depths = depths[::axial_stride]
    labels = np.empty((depths.size, lateral.size), np.uint8)
    arteries = pushes(deformation)
    codes, values = codes_and_values(volume)
    _sample(codes, plane_to_voxel, lateral, depths, float(radius), arteries, labels)
    return values[labels]


def _body_to_voxel(body: Body) -> np.ndarray:
    matrix = np.eye(4) / body.spacing_mm
    matrix[:3, 3] = -np.asarray(body.origin_mm) / body.spacing_mm
    matrix[3, 3] = 1
    return matrix


@njit(cache=True, nogil=True)
@no_type_check
def _sample(volume, matrix, lateral, depths, radius, arteries, labels):
    size = volume.shape
    for r in range(depths.size):
        for c in range(lateral.size):
            x, y = lateral[c], depths[r]
            if radius > 0:
                y = (radius + depths[r]) * math.cos(lateral[c]) - radius
                x = (radius + depths[r]) * math.sin(lateral[c])
            x, y = undo_push(x, y, arteries)
            i = math.floor(matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 3] + 0.5)
            j = math.floor(matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 3] + 0.5)
            k = math.floor(matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 3] + 0.5)
            inside = 0 <= i < size[2] and 0 <= j < size[1] and 0 <= k < size[0]
            labels[r, c] = volume[k, j, i] if inside else 0
