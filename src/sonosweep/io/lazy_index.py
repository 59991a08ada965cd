"""Indexing of frames that are read one by one, as NumPy would index them."""

import operator
from collections.abc import Callable

import numpy as np


def read_indexed(
    index: int | slice,
    shape: tuple[int, ...],
    dtype: np.dtype,
    read_frame: Callable[[int], np.ndarray],
) -> np.ndarray:
    """Return one frame, or the stack of frames of a slice.

    Args:
        index: What was asked for; negative numbers count from the end.
        shape: Frames, rows, columns and, for colour, channels.
        dtype: Type of a pixel.
        read_frame: Returns the frame of a number from 0.

    Raises:
        IndexError: If there is no such frame.
    """
    if not isinstance(index, slice):
        return read_frame(range(shape[0])[operator.index(index)])
    chosen = range(shape[0])[index]
    stack = np.empty((len(chosen), *shape[1:]), dtype)
    for k, frame in enumerate(chosen):
        stack[k] = read_frame(frame)
    return stack
