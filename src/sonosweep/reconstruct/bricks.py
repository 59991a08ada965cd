"""Which bricks of a grid have been touched: a number for each, in order of first touch.

The table has two levels, so that it takes memory for the bricks that frames meet and next
to none for a huge empty box around a sweep.
"""

from typing import no_type_check

import numpy as np
from jaxtyping import Int
from numba import njit

from sonosweep.errors import ScanError
from sonosweep.scan import VolumeGrid

BRICK = 8
PAGE = 8
"""Bricks along an edge of a page of the table; a page covers 64 x 64 x 64 voxels."""
MOST_PAGES = 2**27


class BrickTable:
    """Numbers bricks from 0 as they are first asked for.

    Args:
        grid: Where the voxels are.

    Raises:
        ScanError: If even an empty table of the grid would be too large.
    """

    def __init__(self, grid: VolumeGrid) -> None:
        self._pages_along = np.array([-(-n // (BRICK * PAGE)) for n in grid.size], np.int64)
        if np.prod(self._pages_along.astype(float)) > MOST_PAGES:
            raise ScanError(
                f"a grid of {' x '.join(str(n) for n in grid.size)} voxels is too large even when"
                " empty: check the poses and their unit, or take larger voxels"
            )
        self._top = np.full(int(np.prod(self._pages_along)), -1, np.int32)
        self._pages = np.full((256, PAGE**3), -1, np.int32)
        self._used = np.zeros(2, np.int64)  # pages, bricks
        self._bricks = np.empty((2**14, 3), np.int32)

    def __len__(self) -> int:
        """Return how many bricks have a number."""
        return int(self._used[1])

    @property
    def bricks(self) -> Int[np.ndarray, "bricks xyz=3"]:
        """The bricks by number."""
        return self._bricks[: len(self)]

    def numbers(self, bricks: Int[np.ndarray, "pairs xyz=3"]) -> Int[np.ndarray, " pairs"]:
        """Return the number of each brick; new ones get the next."""
        numbers = np.empty(len(bricks), np.int32)
        done = 0
        while True:
            done = _look_up(
                bricks, done, self._pages_along, self._top, self._pages, self._bricks,
                self._used, numbers,
            )  # fmt: skip
            if done == len(bricks):
                return numbers
            if self._used[0] == len(self._pages):
                self._pages = np.concatenate((self._pages, np.full_like(self._pages, -1)))
            if self._used[1] == len(self._bricks):
                self._bricks = np.concatenate((self._bricks, np.empty_like(self._bricks)))


@njit(cache=True, nogil=True)
@no_type_check
def _look_up(bricks, done, pages_along, top, pages, known, used, numbers):
    """Number bricks from ``done`` on; returns early where the table must grow."""
    for p in range(done, bricks.shape[0]):
        x, y, z = np.int64(bricks[p, 0]), np.int64(bricks[p, 1]), np.int64(bricks[p, 2])
        at = (x >> 3) + pages_along[0] * ((y >> 3) + pages_along[1] * (z >> 3))
        page = top[at]
        if page < 0:
            if used[0] == pages.shape[0]:
                return p
            page = used[0]
            top[at] = page
            used[0] += 1
        within = (x & 7) | ((y & 7) << 3) | ((z & 7) << 6)
        number = pages[page, within]
        if number < 0:
            if used[1] == known.shape[0]:
                return p
            number = used[1]
            pages[page, within] = number
            known[number, 0], known[number, 1], known[number, 2] = x, y, z
            used[1] += 1
        numbers[p] = number
    return bricks.shape[0]
