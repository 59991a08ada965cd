"""What a slab of voxels keeps while pixels come in: one class per way of compounding.

Each has ``add(frames, transforms, first_run, runs)``, with the arguments of
:mod:`sonosweep.reconstruct.forward_kernels`, and ``finish(voxels, coverage)``, which writes
the slab's part of the volume ``(z, y, x, channels)``.
"""

from dataclasses import dataclass

import numpy as np

from sonosweep.reconstruct import forward_kernels as kernels
from sonosweep.reconstruct.slab import Slab


@dataclass(frozen=True, eq=False)
class Insertion:
    """How pixels are put into voxels.

    Attributes:
        linear: Whether a pixel is shared among eight voxels, or given to the nearest.
        dtype: Of the pixels.
        channels: Of the pixels.
        reject_below: Darkest gray level that counts.
    """

    linear: bool
    dtype: np.dtype
    channels: int
    reject_below: float

    @property
    def margin(self) -> int:
        """Voxels around a slab that its pixels also reach."""
        return int(self.linear)

    @property
    def unit(self) -> float:
        """Weight of a whole pixel."""
        return float(kernels.FULL_WEIGHT if self.linear else 1)

    @property
    def rounding(self) -> float:
        """What to add before cutting off decimals; 0 keeps them."""
        return 0.5 if np.issubdtype(self.dtype, np.integer) else 0.0


class PackedMean:
    """Mean of 8-bit pixels: count and sum of a voxel in one word."""

    def __init__(self, slab: Slab, insertion: Insertion) -> None:
        self._slab = slab
        self._insertion = insertion
        linear = insertion.linear
        word = np.uint64 if linear else np.uint32
        self._shift = 36 if linear else 20
        self._kernel = kernels.linear_mean if linear else kernels.nearest_mean
        gray = np.arange(256)
        self._increment = ((1 << self._shift) + gray).astype(word)
        self._increment[gray < insertion.reject_below] = 0
        shape = slab.shape(insertion.margin)
        self._packed = np.zeros(shape, word)
        # Zeros take no memory until they are written to, and hardly any of these ever are.
        self._spilled = np.zeros((*shape, 2), np.uint64)
        self._spills = 0

    def add(
        self, frames: np.ndarray, transforms: np.ndarray, first_run: np.ndarray, runs: np.ndarray
    ) -> None:
        """Put frames in."""
        self._spills += self._kernel(
            frames.reshape(frames.shape[:3]),
            transforms,
            first_run,
            runs,
            self._increment,
            *self._slab.edges,
            self._packed.reshape(-1),
            self._spilled.reshape(-1, 2),
        )

    def finish(self, voxels: np.ndarray, coverage: np.ndarray) -> None:
        """Write rounded means."""
        kernels.finish_packed(
            self._packed,
            self._spilled,
            self._spills > 0,
            self._packed.dtype.type(self._shift),
            self._packed.dtype.type((1 << self._shift) - 1),
            1 / self._insertion.unit,
            self._insertion.margin,
            self._slab.edges[0],
            voxels[..., 0],
            coverage,
        )


class SumMean:
    """Mean of pixels of any type, in double precision: exact for 16-bit pixels."""

    def __init__(self, slab: Slab, insertion: Insertion) -> None:
        self._slab = slab
        self._insertion = insertion
        self._kernel = kernels.linear_sum if insertion.linear else kernels.nearest_sum
        shape = slab.shape(insertion.margin)
        self._weight = np.zeros(shape, np.int64)
        self._total = np.zeros((*shape, insertion.channels))

    def add(
        self, frames: np.ndarray, transforms: np.ndarray, first_run: np.ndarray, runs: np.ndarray
    ) -> None:
        """Put frames in."""
        self._kernel(
            frames.reshape(*frames.shape[:3], -1),
            transforms,
            first_run,
            runs,
            self._insertion.reject_below,
            *self._slab.edges,
            self._weight.reshape(-1),
            self._total.reshape(-1, self._insertion.channels),
        )

    def finish(self, voxels: np.ndarray, coverage: np.ndarray) -> None:
        """Write means, rounded for integer voxels."""
        kernels.finish_sums(
            self._weight,
            self._total,
            self._insertion.rounding,
            self._insertion.unit,
            self._insertion.margin,
            self._slab.edges[0],
            voxels,
            coverage,
        )


class Replacing:
    """The largest pixel if ``maximum``, else the latest."""

    def __init__(self, slab: Slab, insertion: Insertion, maximum: bool) -> None:
        self._slab = slab
        self._insertion = insertion
        self._maximum = maximum
        self._kernel = kernels.linear_replace if insertion.linear else kernels.nearest_replace
        shape = slab.shape(insertion.margin)
        self._count = np.zeros(shape, np.uint8)
        self._value = np.zeros((*shape, insertion.channels), insertion.dtype)

    def add(
        self, frames: np.ndarray, transforms: np.ndarray, first_run: np.ndarray, runs: np.ndarray
    ) -> None:
        """Put frames in."""
        self._kernel(
            frames.reshape(*frames.shape[:3], -1),
            transforms,
            first_run,
            runs,
            self._insertion.reject_below,
            *self._slab.edges,
            self._maximum,
            self._count.reshape(-1),
            self._value.reshape(-1, self._insertion.channels),
        )

    def finish(self, voxels: np.ndarray, coverage: np.ndarray) -> None:
        """Copy what was kept."""
        margin = self._insertion.margin
        inner = tuple(slice(margin, n - margin) for n in self._count.shape)
        self._slab.part_of(voxels)[...] = self._value[inner]
        self._slab.part_of(coverage)[...] = self._count[inner]


Accumulator = PackedMean | SumMean | Replacing
