"""Our reference coordinates in files, which all claim patient axes.

The reference is right-handed mm and claims no anatomy. ITK's formats (MetaImage, NRRD,
NIfTI once converted, DICOM) count in LPS and 3D Slicer turns them into RAS on loading, but
takes the per-frame matrices of tracked sequences as RAS unturned. Under ``"ras"`` (the
default) we write the half turn about z that cancels this, so that volume, sequence and live
stream coincide in Slicer; under ``"lps"`` numbers are written as they are, as PLUS does.
"""

from typing import Literal

import numpy as np
from jaxtyping import Float

from sonosweep.scan import VolumeGrid

World = Literal["ras", "lps"]
HALF_TURN = np.diag([-1.0, -1.0, 1.0])


def reference_to_lps(world: World) -> Float[np.ndarray, "3 3"]:
    """Return the turn from the reference to the file's LPS; it is its own inverse."""
    return HALF_TURN if world == "ras" else np.eye(3)


def lps_from_grid(
    grid: VolumeGrid, world: World
) -> tuple[Float[np.ndarray, "xyz=3"], Float[np.ndarray, "3 3"]]:
    """Return origin (mm) and direction (axes in columns) of a grid as files state them."""
    turn = reference_to_lps(world)
    return turn @ np.asarray(grid.origin_mm), turn @ np.asarray(grid.direction)


def grid_from_lps(
    size: tuple[int, int, int],
    spacing_mm: tuple[float, float, float],
    origin_lps_mm: Float[np.ndarray, "xyz=3"],
    direction_lps: Float[np.ndarray, "3 3"],
    world: World,
) -> VolumeGrid:
    """Return the grid that a file states; undoes :func:`lps_from_grid`."""
    turn = reference_to_lps(world)
    origin, direction = turn @ origin_lps_mm, turn @ direction_lps
    return VolumeGrid(
        size=size,
        spacing_mm=spacing_mm,
        origin_mm=(float(origin[0]), float(origin[1]), float(origin[2])),
        direction=tuple((float(a), float(b), float(c)) for a, b, c in direction),
    )
