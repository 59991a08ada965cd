"""Frames a few at a time: what bounds memory and feeds the threads."""

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import numpy as np

from sonosweep.errors import ScanError
from sonosweep.scan import Frames

SUPPORTED = ("uint8", "uint16", "int16", "float32", "float64")
MOST_THREADS = 1024
BLOCK_BYTES = 2**21
"""Pixels of a block: few enough to stay in a cache, enough to be worth a round of threads."""
BLOCK_VOXELS = 2**21
"""Voxels that a block sweeps over: the sums of so many take 17 MB."""


def check_frames(frames: Frames) -> None:
    """Refuse frames that cannot be compounded.

    Raises:
        ScanError: If the pixel type is not supported, or there is no pixel.
    """
    check_dtype(frames.dtype)
    if len(frames.shape) not in (3, 4) or min(frames.shape[1:]) < 1:
        raise ScanError(
            "frames must have frames, rows and columns, and perhaps channels, got shape"
            f" {tuple(frames.shape)}"
        )


def check_dtype(dtype: np.dtype) -> None:
    """Refuse pixels of another type than those supported.

    Raises:
        ScanError: Which names them.
    """
    if np.dtype(dtype).name not in SUPPORTED:
        raise ScanError(
            f"frames of type {np.dtype(dtype).name} cannot be compounded: convert them to one of"
            f" {', '.join(SUPPORTED)}"
        )


def contiguous(frames: np.ndarray) -> np.ndarray:
    """Return the same pixels as the kernels were compiled for: native, in order, writable."""
    native = np.dtype(frames.dtype).newbyteorder("=")
    return np.require(frames, dtype=native, requirements=["C", "W"])


def thread_count(threads: int | None) -> int:
    """Return how many threads to use: those asked for, or as many as this process may run.

    Raises:
        ScanError: If fewer than one or absurdly many are asked for.
    """
    if threads is None:
        if hasattr(os, "sched_getaffinity"):
            return len(os.sched_getaffinity(0))
        return os.cpu_count() or 1
    if threads < 1:
        raise ScanError(f"at least one thread is needed, got {threads}")
    if threads > MOST_THREADS:
        raise ScanError(f"{MOST_THREADS} threads at most, got {threads}")
    return threads


def block_ranges(frames: Frames, voxels_per_frame: float = 1.0) -> list[slice]:
    """Return the frames of each block: about 2 MB of pixels, or fewer where voxels are fine."""
    frame_bytes = int(np.prod(frames.shape[1:])) * np.dtype(frames.dtype).itemsize
    most = min(BLOCK_BYTES // frame_bytes, BLOCK_VOXELS / voxels_per_frame)
    step = int(np.clip(most, 1, 64))
    return [slice(k, min(k + step, len(frames))) for k in range(0, len(frames), step)]


def read_blocks(
    frames: Frames, ranges: list[slice] | None = None
) -> Iterator[tuple[slice, np.ndarray]]:
    """Give (frames, pixels) block by block, reading one ahead."""
    ranges = ranges or block_ranges(frames)
    with ThreadPoolExecutor(1) as reader:
        following = reader.submit(_read, frames, ranges[0])
        for k, block in enumerate(ranges):
            pixels = following.result()
            if k + 1 < len(ranges):
                following = reader.submit(_read, frames, ranges[k + 1])
            yield block, pixels


def _read(frames: Frames, block: slice) -> np.ndarray:
    return contiguous(np.asarray(frames[block]))


Result = TypeVar("Result")


def in_turns(
    work: Callable[[int], Result], turns: int, pool: ThreadPoolExecutor | None
) -> list[Result]:
    """Call ``work(turn)`` for every turn at the same time; wait for all."""
    if turns == 1 or pool is None:
        return [work(turn) for turn in range(turns)]
    return list(pool.map(work, range(turns)))
