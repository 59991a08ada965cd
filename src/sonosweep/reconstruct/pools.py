"""Sums and weights of bricks: one class for 8-bit pixels, one for all others.

Both have the same methods. A slot is the place of a brick; ``turn`` is (this thread, number
of threads), and a thread touches only its own bricks.
"""

import numpy as np
from jaxtyping import Int, Shaped, UInt8

from sonosweep.reconstruct import gather_kernels as kernels
from sonosweep.reconstruct.sampling import Contribution, Sampling

Order = Int[np.ndarray, "axes=3"]
Slots = Int[np.ndarray, " bricks"]
Bricks = Int[np.ndarray, "bricks xyz=3"]


class BytePool:
    """Bricks of 8-bit pixels of one channel: exact integers, fast.

    Args:
        sampling: How frames are sampled.
        reject_below: Darkest gray level that counts.
        order: Axes of the volume from the slowest in a brick to the fastest.
        slots: Room to reserve. It takes no memory until a brick is written to.
    """

    def __init__(self, sampling: Sampling, reject_below: float, order: Order, slots: int) -> None:
        self._sampling = sampling
        self._reject = int(np.ceil(np.clip(reject_below, 0, 256) * 16))
        self._order = order
        self._used = np.zeros(slots, np.int32)
        self._sums = np.zeros((slots, 2, kernels.VOXELS), np.int32)

    def reserve(self, slots: int) -> None:
        """Make room for that many bricks."""
        self._used = _longer(self._used, slots)
        self._sums = _longer(self._sums, slots)

    def add(
        self,
        frames: UInt8[np.ndarray, "frames rows columns *channels"],
        part: Contribution,
        bricks: Bricks,
        slot_of: Int[np.ndarray, " numbers"],
        turn: tuple[int, int],
        sign: int,
    ) -> int:
        """Add (1) or take out (-1) frames; returns how many sums had to be halved.

        Args:
            frames: Some frames.
            part: What they contribute.
            bricks: All bricks by number.
            slot_of: The slot of each, by number.
            turn: (this thread, number of threads).
            sign: 1 or -1.
        """
        return kernels.gather_bytes(
            frames.reshape(frames.shape[:3]),
            self._sampling.box,
            self._sampling.kept_cells,
            part.fixed,
            part.peaks,
            part.first,
            part.numbers,
            bricks,
            slot_of,
            self._order,
            turn,
            sign,
            self._reject,
            self._used,
            self._sums,
        )

    def finish(
        self,
        slots: Slots,
        bricks: Bricks,
        turn: tuple[int, int],
        clear: bool,
        voxels: UInt8[np.ndarray, "depth rows columns channels=1"],
        coverage: UInt8[np.ndarray, "depth rows columns"],
    ) -> None:
        """Write bricks into a volume; ``clear`` empties their slots."""
        kernels.finish_bytes(
            self._sums,
            slots,
            bricks,
            self._order,
            coverage.shape[::-1],
            turn,
            clear,
            voxels.reshape(-1),
            coverage.reshape(-1),
        )
        if clear:
            self._used[slots[turn[0] :: turn[1]]] = 0


class GeneralPool:
    """Bricks of pixels of any type and number of channels: sums in double precision."""

    def __init__(
        self,
        sampling: Sampling,
        reject_below: float,
        order: Order,
        slots: int,
        dtype: np.dtype,
        channels: int,
    ) -> None:
        self._sampling = sampling
        self._reject = float(reject_below)
        self._order = order
        self._rounding = 0.5 if np.issubdtype(dtype, np.integer) else 0.0
        self._weight = np.zeros((slots, kernels.VOXELS), np.int64)
        self._total = np.zeros((slots, channels, kernels.VOXELS))

    def reserve(self, slots: int) -> None:
        """Make room for that many bricks."""
        self._weight = _longer(self._weight, slots)
        self._total = _longer(self._total, slots)

    def add(
        self,
        frames: Shaped[np.ndarray, "frames rows columns *channels"],
        part: Contribution,
        bricks: Bricks,
        slot_of: Int[np.ndarray, " numbers"],
        turn: tuple[int, int],
        sign: int,
    ) -> int:
        """Add (1) or take out (-1) frames; nothing is ever halved."""
        kernels.gather_general(
            frames.reshape(*frames.shape[:3], -1),
            self._sampling.box,
            self._sampling.kept_cells,
            part.fixed,
            part.peaks,
            part.first,
            part.numbers,
            bricks,
            slot_of,
            self._order,
            turn,
            sign,
            self._reject,
            self._weight,
            self._total,
        )
        return 0

    def finish(
        self,
        slots: Slots,
        bricks: Bricks,
        turn: tuple[int, int],
        clear: bool,
        voxels: Shaped[np.ndarray, "depth rows columns channels"],
        coverage: UInt8[np.ndarray, "depth rows columns"],
    ) -> None:
        """Write bricks into a volume; ``clear`` empties their slots."""
        kernels.finish_general(
            self._weight,
            self._total,
            slots,
            bricks,
            self._order,
            coverage.shape[::-1],
            turn,
            clear,
            self._rounding,
            voxels.reshape(-1, voxels.shape[3]),
            coverage.reshape(-1),
        )


Pool = BytePool | GeneralPool


def pool_for(
    dtype: np.dtype,
    channels: int,
    sampling: Sampling,
    reject_below: float | None,
    order: Order,
    slots: int,
) -> Pool:
    """Return the fastest pool for these pixels."""
    darkest = -np.inf if reject_below is None else reject_below
    if dtype == np.uint8 and channels == 1:
        return BytePool(sampling, darkest, order, slots)
    return GeneralPool(sampling, darkest, order, slots, dtype, channels)


def _longer(array: np.ndarray, length: int) -> np.ndarray:
    if length <= len(array):
        return array
    longer = np.zeros((max(length, 2 * len(array)), *array.shape[1:]), array.dtype)
    longer[: len(array)] = array
    return longer
