"""Frames a few at a time: what bounds memory and feeds the threads."""

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from sonosweep.errors import ScanError
from sonosweep.estimators.estimator import Progress
from sonosweep.scan import Frames

SUPPORTED = ("uint8", "uint16", "int16", "float32", "float64")
BLOCK_BYTES = 2**22
"""A block of frames stays in the cache that the cores share."""


def check_frames(frames: Frames) -> None:
    """Refuse frames that cannot be compounded.

    Raises:
        ScanError: If the pixel type is not supported, or there is no pixel.
    """
    if np.dtype(frames.dtype).name not in SUPPORTED:
        raise ScanError(
            f"frames of type {np.dtype(frames.dtype).name} cannot be compounded: convert them to"
            f" one of {', '.join(SUPPORTED)}"
        )
    if len(frames.shape) not in (3, 4) or min(frames.shape[1:]) < 1:
        raise ScanError(
            "frames must have frames, rows and columns, and perhaps channels, got shape"
            f" {tuple(frames.shape)}"
        )


def contiguous(frames: np.ndarray) -> np.ndarray:
    """Return the same pixels as the kernels were compiled for: native, in order, writable."""
    native = np.dtype(frames.dtype).newbyteorder("=")
    return np.require(frames, dtype=native, requirements=["C", "W"])


def thread_count(threads: int | None) -> int:
    """Return how many threads to use: those asked for, or as many as this process may run.

    Raises:
        ScanError: If fewer than one is asked for.
    """
    if threads is None:
        if hasattr(os, "sched_getaffinity"):
            return len(os.sched_getaffinity(0))
        return os.cpu_count() or 1
    if threads < 1:
        raise ScanError(f"at least one thread is needed, got {threads}")
    return threads


def read_blocks(frames: Frames) -> Iterator[tuple[int, np.ndarray]]:
    """Give (first frame, pixels) for consecutive frames, about 4 MB at a time."""
    frame_bytes = int(np.prod(frames.shape[1:])) * np.dtype(frames.dtype).itemsize
    step = int(np.clip(BLOCK_BYTES // frame_bytes, 1, 64))
    for first in range(0, len(frames), step):
        yield first, contiguous(np.asarray(frames[first : first + step]))


def work_through(
    frames: Frames,
    work: Callable[[int, np.ndarray, int], None],
    parts: int,
    threads: int,
    progress: Progress | None = None,
) -> None:
    """Call ``work(first_frame, pixels, part)`` for every block of frames and every part.

    Parts of one block run at the same time; the next block is read meanwhile and waits
    until all are done, so each part sees the frames in order.
    """
    total = len(frames)
    with ThreadPoolExecutor(threads) as pool:
        running: list = []
        done = 0
        for first, pixels in read_blocks(frames):
            for task in running:
                task.result()
            if progress is not None and done:
                progress(done, total)
            running = [pool.submit(work, first, pixels, part) for part in range(parts)]
            done = first + len(pixels)
        for task in running:
            task.result()
    if progress is not None:
        progress(total, total)
