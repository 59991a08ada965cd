"""Voxels whose tissue and echogenicity share one byte."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, no_type_check

import numpy as np
from jaxtyping import UInt8
from numba import njit

PLAIN = np.arange(256, dtype=np.uint8)
"""What bytes stand for that are values themselves."""


@dataclass(frozen=True, eq=False)
class CodedVoxels:
    """An array that is looked up in a table where it is read, such as ``tissue[3, :, 5]``.

    Attributes:
        codes: Of each voxel, ``(z, y, x)``.
        values: What each code stands for.
    """

    codes: UInt8[np.ndarray, "z y x"]
    values: UInt8[np.ndarray, "256"]

    @property
    def shape(self) -> tuple[int, ...]:
        """Voxels along z, y and x."""
        return self.codes.shape

    @property
    def size(self) -> int:
        """How many voxels there are."""
        return self.codes.size

    def any(self) -> bool:
        """Return whether one of them is above 0."""
        return any(bool(self.values[voxels].any()) for voxels in self.codes)

    def __getitem__(self, index: Any) -> np.ndarray:
        """Return values, by any of numpy's indices."""
        return self.values[self.codes[index]]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        """Return all values, in memory of their own."""
        return self.values[self.codes].astype(dtype or np.uint8, copy=False)


Values = UInt8[np.ndarray, "z y x"] | CodedVoxels
"""A byte for each voxel, as an array or looked up."""


def codes_and_values(
    voxels: Values,
) -> tuple[UInt8[np.ndarray, "z y x"], UInt8[np.ndarray, "256"]]:
    """Return the bytes that are in memory, and what each of them stands for."""
    if isinstance(voxels, CodedVoxels):
        return voxels.codes, voxels.values
    return voxels, PLAIN


@dataclass(frozen=True, eq=False)
class Palette:
    """The pairs of tissue and echogenicity that voxels may have; the first is (0, 0).

    Attributes:
        tissue: Label of each code.
        echogenicity: Code of the scatterers' amplitude of each code.
    """

    tissue: UInt8[np.ndarray, "256"]
    echogenicity: UInt8[np.ndarray, "256"]

    @cached_property
    def nearest(self) -> UInt8[np.ndarray, "labels 256"]:
        """The code that comes nearest to a tissue and an echogenicity."""
        apart = np.abs(np.subtract.outer(np.arange(256), self.echogenicity.astype(np.int64)))
        labels = np.arange(int(self.tissue.max()) + 1)[:, None, None]
        return np.where(self.tissue == labels, apart, 256).argmin(axis=2).astype(np.uint8)

    def encode(
        self,
        tissue: UInt8[np.ndarray, "z y x"],
        echogenicity: UInt8[np.ndarray, "z y x"],
        codes: UInt8[np.ndarray, "z y x"],
    ) -> None:
        """Fill ``codes`` with the nearest ones."""
        _encode(tissue, echogenicity, self.nearest, codes)


@njit(cache=True, nogil=True)
@no_type_check
def _encode(tissue, echo, nearest, codes):
    for k in range(codes.shape[0]):
        for j in range(codes.shape[1]):
            for i in range(codes.shape[2]):
                codes[k, j, i] = nearest[tissue[k, j, i], echo[k, j, i]]
