"""Voxels with a place in the reference."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sonosweep.errors import ScanError


@dataclass(frozen=True)
class VolumeGrid:
    """A box of voxels in the reference, before anything is in it.

    Attributes:
        size: Voxels along its x, y and z axes.
        spacing_mm: Distance between voxel centres along them.
        origin_mm: Reference coordinates of the centre of voxel (0, 0, 0).
        direction: Rows of a 3 x 3 rotation whose *columns* are the axes in the reference.
    """

    size: tuple[int, int, int]
    spacing_mm: tuple[float, float, float]
    origin_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    direction: tuple[tuple[float, float, float], ...] = (
        (1.0, 0.0, 0.0),
        (0.0, 1.0, 0.0),
        (0.0, 0.0, 1.0),
    )

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ScanError: If a size or spacing is not positive, or the axes are not a rotation.
        """
        if min(self.size) < 1:
            raise ScanError(f"a volume needs at least one voxel along each axis, got {self.size}")
        if not all(np.isfinite(value) and value > 0 for value in self.spacing_mm):
            raise ScanError(f"voxel spacing must be above 0 mm, got {self.spacing_mm}")
        axes = np.asarray(self.direction, dtype=np.float64)
        if (
            axes.shape != (3, 3)
            or not np.allclose(axes.T @ axes, np.eye(3), atol=1e-5)
            or np.linalg.det(axes) < 0
        ):
            raise ScanError("the axes of a volume must be perpendicular and right-handed")
        if not np.isfinite(self.origin_mm).all():
            raise ScanError(f"the origin of a volume must be finite, got {self.origin_mm}")


def voxel_to_reference(grid: VolumeGrid) -> Float[Tensor, "4 4"]:
    """Return the matrix from voxel indices (x, y, z), centres at integers, to mm."""
    matrix = torch.eye(4, dtype=torch.float64)
    direction = torch.tensor(grid.direction, dtype=torch.float64)
    matrix[:3, :3] = direction * torch.tensor(grid.spacing_mm, dtype=torch.float64)
    matrix[:3, 3] = torch.tensor(grid.origin_mm, dtype=torch.float64)
    return matrix


@dataclass(frozen=True, eq=False)
class Volume:
    """Voxels, where they are, and how well each is covered.

    Attributes:
        voxels: Array ``(z, y, x)``, or ``(z, y, x, channels)``; x varies fastest in memory.
        grid: Where the voxels are.
        coverage: Array ``(z, y, x)`` of how many frames or pixels made each voxel: 0 where
            nothing was seen, 255 for that many or more; ``None`` if not kept.
        settings: How it was made, by name.
    """

    voxels: np.ndarray
    grid: VolumeGrid
    coverage: np.ndarray | None = None
    settings: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check that the arrays have the grid's size.

        Raises:
            ScanError: If not.
        """
        expected = self.grid.size[::-1]
        if self.voxels.shape[:3] != expected:
            raise ScanError(f"voxels of shape {self.voxels.shape} on a grid of {expected}")
        if self.coverage is not None and self.coverage.shape != expected:
            raise ScanError(f"coverage of shape {self.coverage.shape} on a grid of {expected}")
