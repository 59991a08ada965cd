"""Where the scatterers of tissue are: everywhere, fixed in the body, from a small table.

Space is divided into cubic cells. Each takes one of a few hundred stored sets of scatterers,
and mirrors it or not along each axis, by a hash of its place and of the medium's seed. So a
medium has no end and no period, needs no memory of its own, and is the same from wherever
it is looked at.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float32, Int64
from numba import njit

from sonosweep.errors import ScanError
from sonosweep.simulate.seeds import generator

CELL_MM = 1.6
SETS = 512
SPARE = 256
"""Scatterers after the last set, so that blocks of them may be read beyond its end."""

_WORD = np.uint64(0xFFFFFFFF)
_ODD = (np.uint64(0x9E3779B1), np.uint64(0x85EBCA77), np.uint64(0xC2B2AE3D))
_MIX = (np.uint64(0x7FEB352D), np.uint64(0x846CA68B))


class ScattererSets(NamedTuple):
    """Poisson sets of scatterers in a cell.

    Attributes:
        offsets_mm: From the middle of the cell, one row per axis, set after set.
        first: Number of each set's first scatterer, and of the one after the last.
    """

    offsets_mm: Float32[np.ndarray, "xyz=3 scatterers"]
    first: Int64[np.ndarray, " sets_and_end"]


@dataclass(frozen=True)
class Medium:
    """Scatterers that fill all space.

    Attributes:
        seed: Of the hash; different seeds give unrelated media.
        density_per_mm3: Mean number of scatterers; their number is Poisson distributed.
    """

    seed: int
    density_per_mm3: float = 266.0

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ScanError: If the seed is negative or the density not within 1 to 5000 per mm3.
        """
        if self.seed < 0:
            raise ScanError(f"the seed of a medium must be 0 or more, got {self.seed}")
        if not 1 <= self.density_per_mm3 <= 5000:
            raise ScanError(
                f"a medium has 1 to 5000 scatterers per mm3, got {self.density_per_mm3:g}"
            )

    @property
    def word(self) -> np.uint64:
        """The seed folded into 32 bits, for the hash."""
        return np.uint64(np.random.SeedSequence(self.seed).generate_state(1)[0])

    @property
    def sets(self) -> ScattererSets:
        """The stored sets of scatterers, shared by all media of this density."""
        return _scatterer_sets(self.density_per_mm3)


@lru_cache(maxsize=2)
def _scatterer_sets(density_per_mm3: float) -> ScattererSets:
    rng = generator(0, 0, "scatterer sets")
    counts = rng.poisson(density_per_mm3 * CELL_MM**3, SETS)
    first = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    offsets = np.zeros((3, int(first[-1]) + SPARE), np.float32)
    offsets[:, : first[-1]] = rng.random((3, int(first[-1])), np.float32)
    offsets[:, : first[-1]] = (offsets[:, : first[-1]] - np.float32(0.5)) * np.float32(CELL_MM)
    return ScattererSets(offsets, first)


@njit(cache=True, nogil=True)
@no_type_check
def hash_cell(i, j, k, word):
    """Return 32 well-mixed bits for a cell (along x, y, z) of the medium with this word."""
    bits = word
    for axis in range(3):
        place = np.uint64(np.int64(i if axis == 0 else j if axis == 1 else k)) & _WORD
        # Products of two 32-bit words fit into 64 bits.
        bits = ((bits ^ place) * _ODD[axis]) & _WORD
        bits ^= bits >> np.uint64(15)
        bits = (bits * _MIX[0]) & _WORD
        bits ^= bits >> np.uint64(16)
    bits = (bits * _MIX[1]) & _WORD
    return bits ^ (bits >> np.uint64(15))
