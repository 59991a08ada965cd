"""Boxes of voxels that share the work: each thread owns one and writes to no other."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int

from sonosweep.scan import VolumeGrid

LARGEST_SLAB = 2**30
"""Voxels; the kernels count them with 32 bits."""


@dataclass(frozen=True)
class Slab:
    """A box of voxels.

    Attributes:
        low: First voxel (x, y, z).
        high: One past the last.
    """

    low: tuple[int, int, int]
    high: tuple[int, int, int]

    @property
    def edges(self) -> tuple[Int[np.ndarray, "xyz=3"], Int[np.ndarray, "xyz=3"]]:
        """First and one-past-last voxel as arrays."""
        return np.array(self.low, np.int64), np.array(self.high, np.int64)

    def part_of(self, array: np.ndarray) -> np.ndarray:
        """Return the view of a ``(z, y, x, ...)`` array that this slab covers."""
        x, y, z = (slice(a, b) for a, b in zip(self.low, self.high, strict=True))
        return array[z, y, x]

    def shape(self, margin: int = 0) -> tuple[int, int, int]:
        """Voxels along z, y and x, with a margin on every side."""
        x, y, z = (b - a + 2 * margin for a, b in zip(self.low, self.high, strict=True))
        return z, y, x


def split_grid(
    grid: VolumeGrid, pixel_to_voxel: Float[np.ndarray, "frames 3 3"], parts: int
) -> list[Slab]:
    """Return at least ``parts`` slabs, cut across the axis that runs down the frames.

    Cut so, every frame gives work to every slab, and most rows of pixels to one only.
    """
    down = np.abs(pixel_to_voxel[:, :, 1]).mean(axis=0)
    # A thin axis is not worth cutting even if it runs along the frames.
    axis = int(np.argmax(down / (down.max() or 1.0) + (np.array(grid.size) >= 16 * parts)))
    length = grid.size[axis]
    voxels = int(np.prod([n + 2 for n in grid.size], dtype=object))
    count = min(max(parts, -(-voxels // LARGEST_SLAB)), length)
    cuts = [length * k // count for k in range(count + 1)]
    slabs = []
    for begin, end in pairwise(cuts):
        low, high = [0, 0, 0], list(grid.size)
        low[axis], high[axis] = begin, end
        slabs.append(_slab(low, high))
    return slabs


def halve(slab: Slab) -> tuple[Slab, Slab]:
    """Return the two halves of a slab, cut across its longest axis."""
    size = [b - a for a, b in zip(slab.low, slab.high, strict=True)]
    axis = int(np.argmax(size))
    middle = slab.low[axis] + size[axis] // 2
    first, second = list(slab.high), list(slab.low)
    first[axis] = second[axis] = middle
    return _slab(list(slab.low), first), _slab(second, list(slab.high))


def _slab(low: list[int], high: list[int]) -> Slab:
    return Slab((low[0], low[1], low[2]), (high[0], high[1], high[2]))
