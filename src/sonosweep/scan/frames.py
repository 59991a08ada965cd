"""Frames that need not be in memory: what every reader gives and every consumer takes."""

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


class FrameView:
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
        columns, rows = frames.shape[2], frames.shape[1]
        self._rectangle = rectangle_px or (0, 0, columns, rows)
        self._gray = gray and len(frames.shape) == 4

    @property
    def shape(self) -> tuple[int, ...]:
        """Frames, rows, columns and, for colour, channels."""
        channels = () if self._gray else tuple(self._frames.shape[3:])
        return (len(self._indices), self._rectangle[3], self._rectangle[2], *channels)

    @property
    def dtype(self) -> np.dtype:
        """Type of a pixel."""
        return np.dtype(self._frames.dtype)

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self._indices)

    def __getitem__(self, index: int | slice) -> np.ndarray:
        """Return one frame, or the frames of a slice."""
        if isinstance(index, slice):
            chosen = self._indices[index]
            stack = np.empty((len(chosen), *self.shape[1:]), self.dtype)
            for k, source in enumerate(chosen):
                stack[k] = self._read(int(source))
            return stack
        return self._read(int(self._indices[index]))

    def _read(self, source: int) -> np.ndarray:
        column, row, width, height = self._rectangle
        frame = np.asarray(self._frames[source])[row : row + height, column : column + width]
        return _brightness(frame) if self._gray else frame


def _brightness(colour: np.ndarray) -> np.ndarray:
    """Return the luma of RGB or RGBA pixels, or the one channel of gray ones."""
    if colour.shape[-1] < 3:
        return np.ascontiguousarray(colour[..., 0])
    luma = colour[..., :3].astype(np.float32) @ np.array([0.299, 0.587, 0.114], np.float32)
    if np.issubdtype(colour.dtype, np.integer):
        luma = np.rint(luma)
    return luma.astype(colour.dtype)
