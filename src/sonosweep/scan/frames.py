"""Frames that need not be in memory: what every reader gives and every consumer takes."""

import operator
from abc import ABC, abstractmethod
from typing import Protocol, runtime_checkable

import numpy as np


@runtime_checkable
class Frames(Protocol):
    """A stack of frames, read when indexed. Any NumPy array is one.

    ``shape`` is ``(frames, rows, columns)``, or ``(frames, rows, columns, channels)`` for
    colour. An index gives one frame, a slice gives a stack; both are NumPy arrays that the
    caller may keep. Reading the same frame twice gives the same pixels.
    """

    @property
    def shape(self) -> tuple[int, ...]:
        """Frames, rows, columns and, for colour, channels."""
        ...

    @property
    def dtype(self) -> np.dtype:
        """Type of a pixel."""
        ...

    def __len__(self) -> int:
        """Return the number of frames."""
        ...

    def __getitem__(self, index: int | slice) -> np.ndarray:
        """Return one frame, or the frames of a slice."""
        ...


class LazyFrames(ABC):
    """Frames that are read one by one when indexed, as NumPy would index them.

    A subclass says how one frame is read.

    Args:
        shape: Frames, rows, columns and, for colour, channels.
        dtype: Type of a pixel.
    """

    def __init__(self, shape: tuple[int, ...], dtype: np.dtype) -> None:
        self._shape, self._dtype = tuple(shape), np.dtype(dtype)

    @abstractmethod
    def _read(self, frame: int) -> np.ndarray:
        """Return the frame of a number from 0, in an array that the caller may keep."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Frames, rows, columns and, for colour, channels."""
        return self._shape

    @property
    def dtype(self) -> np.dtype:
        """Type of a pixel."""
        return self._dtype

    def __len__(self) -> int:
        """Return the number of frames."""
        return self._shape[0]

    def __getitem__(self, index: int | slice) -> np.ndarray:
        """Return one frame, or the frames of a slice.

        Raises:
            IndexError: If there is no such frame; negative numbers count from the end.
        """
        if not isinstance(index, slice):
            return self._read(range(len(self))[operator.index(index)])
        chosen = range(len(self))[index]
        stack = np.empty((len(chosen), *self._shape[1:]), self._dtype)
        for k, frame in enumerate(chosen):
            stack[k] = self._read(frame)
        return stack


class FrameView(LazyFrames):
    """Frames changed on the way out: a selection of them, a crop, another pixel type.

    Nothing is read until a frame is asked for.

    Args:
        frames: Where the pixels come from.
        indices: Which frames, in which order; all when ``None``.
        rectangle_px: ``(column, row, width, height)`` to keep; everything when ``None``.
        gray: Whether to reduce colour to brightness (ITU-R BT.601), rounded to the
            pixel type.
    """

    def __init__(
        self,
        frames: Frames,
        indices: np.ndarray | None = None,
        rectangle_px: tuple[int, int, int, int] | None = None,
        gray: bool = False,
    ) -> None:
        self._frames = frames
        self._indices = np.arange(len(frames)) if indices is None else np.asarray(indices)
        self._rectangle = rectangle_px or (0, 0, frames.shape[2], frames.shape[1])
        self._gray = gray and len(frames.shape) == 4
        channels = () if self._gray else tuple(frames.shape[3:])
        _, _, width, height = self._rectangle
        super().__init__((len(self._indices), height, width, *channels), frames.dtype)

    def _read(self, frame: int) -> np.ndarray:
        column, row, width, height = self._rectangle
        source = np.asarray(self._frames[int(self._indices[frame])])
        pixels = source[row : row + height, column : column + width]
        return _brightness(pixels) if self._gray else pixels


def _brightness(colour: np.ndarray) -> np.ndarray:
    """Return the luma of RGB or RGBA pixels, or the one channel of gray ones."""
    if colour.shape[-1] < 3:
        return np.ascontiguousarray(colour[..., 0])
    luma = colour[..., :3].astype(np.float32) @ np.array([0.299, 0.587, 0.114], np.float32)
    if np.issubdtype(colour.dtype, np.integer):
        luma = np.rint(luma)
    return luma.astype(colour.dtype)
