"""Correlation of the frames themselves, at full resolution.

Axial steps are a small part of a pixel of any feature map: measured on simulated sweeps, a
network learns them from the frames' own correlation and hardly from its features'.
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from sonosweep.errors import ScanError
from sonosweep.estimators.diagonals import box_matrix, full_precision, sum_diagonals

EPSILON = 1e-6
"""Added to the product of norms: a block without speckle correlates with nothing."""


@dataclass(frozen=True)
class ShiftRange:
    """How far blocks move, in pixels of the frame.

    Attributes:
        axial_radius: Largest shift along the axial axis.
        lateral_radius: Largest shift along the lateral axis.
    """

    axial_radius: int = 3
    lateral_radius: int = 5

    def __post_init__(self) -> None:
        """Check the sizes.

        Raises:
            ScanError: If one is negative.
        """
        if min(self.axial_radius, self.lateral_radius) < 0:
            raise ScanError(
                "the radii of a correlation are not negative, got"
                f" {self.axial_radius} and {self.lateral_radius}"
            )

    @property
    def count(self) -> tuple[int, int]:
        """Shifts along the axial and the lateral axis."""
        return 2 * self.axial_radius + 1, 2 * self.lateral_radius + 1


@torch.no_grad()
def image_correlation(
    first: Float[Tensor, "batch 1 rows columns"],
    second: Float[Tensor, "batch 1 rows columns"],
    block: int,
    shifts: ShiftRange,
) -> Float[Tensor, "batch block_rows block_columns shift_rows shift_columns"]:
    """Return the correlation coefficient of blocks of two frames for every small shift.

    Blocks lie side by side. Beyond the edge of a frame everything is black. For each axial
    shift, one matrix product per block multiplies its columns with those of its
    neighborhood; sums along the diagonals are the products of shifted blocks. No gradient:
    frames have none.

    Args:
        first: Frames, whose blocks stay; sides are multiples of a block.
        second: The next frames, which move.
        block: Side of a block in pixels.
        shifts: How far blocks move.
    """
    with full_precision(first.device):
        axial, lateral = shifts.count
        still = _blocks(first.float(), block)
        still = still - still.mean((1, 2), keepdim=True)
        windows = _windows(second.float(), block, shifts)
        spare = F.pad(still, (0, 0, 0, 1))
        dots = [
            sum_diagonals(torch.bmm(spare, windows[:, y : y + block]), 1)[:, :lateral]
            for y in range(axial)
        ]
        energy = still.square().sum((1, 2))[:, None, None] * _moving_energy(windows, block)
        volume = torch.stack(dots, 1) / (energy.sqrt() + EPSILON)
        grid = (len(first), first.shape[-2] // block, first.shape[-1] // block)
        return volume.unflatten(0, grid)


def _blocks(frames: Tensor, block: int) -> Float[Tensor, "blocks columns rows"]:
    """Return blocks side by side, transposed."""
    cut = frames[:, 0].unflatten(1, (-1, block)).unflatten(3, (-1, block))
    return cut.permute(0, 1, 3, 4, 2).reshape(-1, block, block)


def _windows(
    frames: Tensor, block: int, shifts: ShiftRange
) -> Float[Tensor, "blocks window_rows window_columns"]:
    """Return each block with the neighborhood over which it may move."""
    axial, lateral = shifts.axial_radius, shifts.lateral_radius
    padded = F.pad(frames[:, 0], (lateral, lateral, axial, axial))
    rows, columns = block + 2 * axial, block + 2 * lateral
    return padded.unfold(1, rows, block).unfold(2, columns, block).reshape(-1, rows, columns)


def _moving_energy(
    windows: Float[Tensor, "blocks rows columns"], block: int
) -> Float[Tensor, "blocks shift_rows shift_columns"]:
    """Return the sum of squares about the mean of the moving block at each shift."""
    axial = box_matrix(windows.shape[1], block, windows.device)
    lateral = box_matrix(windows.shape[2], block, windows.device).T
    total = axial @ windows @ lateral
    return (axial @ windows.square() @ lateral - total.square() / block**2).clamp_min(0)
