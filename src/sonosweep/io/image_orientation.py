"""Which way round a stored image is, in the letters that PLUS uses.

The first letter says where the image's x axis (along a row) points on the transducer, the
second its y axis: M to the marked side, U to the unmarked, F far from the transducer, N
near. A third letter, A or D, tells how slices of a 3D image follow each other and says
nothing about one frame. Our frames are MF: marked side to the right, depth downwards. A UF
file is a mirror image, and its calibration is only right after mirroring it back.
"""

from dataclasses import dataclass

import numpy as np

from sonosweep.errors import ScanError
from sonosweep.scan import Frames

KNOWN_ORIENTATIONS = ("MF", "MN", "UF", "UN", "FM", "FU", "NM", "NU")


@dataclass(frozen=True)
class Turn:
    """How to bring stored frames into another orientation: transpose first, then flip."""

    transpose: bool = False
    flip_rows: bool = False
    flip_columns: bool = False


def turn_to(wanted: str, stored: str) -> Turn | None:
    """Return how to turn a stored image into a wanted orientation.

    Args:
        wanted: Two letters, ``"MF"`` for B-mode or ``"FM"`` for RF lines.
        stored: The letters of the file, two or three, in either case.

    Returns:
        ``None`` if the stored letters are not known, as ``"??"`` is not.
    """
    letters = stored.strip().upper()
    if letters[:2] not in KNOWN_ORIENTATIONS or letters[2:] not in ("", "A", "D"):
        return None
    transpose = (letters[0] in "MU") != (wanted[0] in "MU")
    x, y = (letters[1], letters[0]) if transpose else (letters[0], letters[1])
    return Turn(transpose, flip_rows=y != wanted[1], flip_columns=x != wanted[0])


def check_orientation(letters: str) -> str:
    """Return an orientation that somebody asked for.

    Raises:
        ScanError: If it is none.
    """
    if turn_to("MF", letters) is None:
        raise ScanError(
            f"unknown image orientation '{letters}': use one of {', '.join(KNOWN_ORIENTATIONS)}"
        )
    return letters.strip().upper()


class TurnedFrames:
    """Frames turned on the way out. Nothing is read until a frame is asked for."""

    def __init__(self, frames: Frames, turn: Turn) -> None:
        self._frames = frames
        self._turn = turn

    @property
    def shape(self) -> tuple[int, ...]:
        """Frames, rows, columns and, for colour, channels."""
        count, rows, columns, *channels = self._frames.shape
        if self._turn.transpose:
            rows, columns = columns, rows
        return (count, rows, columns, *channels)

    @property
    def dtype(self) -> np.dtype:
        """Type of a pixel."""
        return self._frames.dtype

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self._frames)

    def __getitem__(self, index: int | slice) -> np.ndarray:
        """Return one frame, or the frames of a slice."""
        frames = self._frames[index]
        first = 1 if isinstance(index, slice) else 0
        rows, columns = first, first + 1
        if self._turn.transpose:
            frames = np.swapaxes(frames, rows, columns)
        if self._turn.flip_rows:
            frames = np.flip(frames, rows)
        if self._turn.flip_columns:
            frames = np.flip(frames, columns)
        return np.ascontiguousarray(frames)


def turn_frames(frames: Frames, turn: Turn | None) -> Frames:
    """Return frames turned, or the frames themselves where there is nothing to turn."""
    return frames if turn is None or turn == Turn() else TurnedFrames(frames, turn)
