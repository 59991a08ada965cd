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
from sonosweep.scan import Frames, LazyFrames

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


class TurnedFrames(LazyFrames):
    """Frames turned on the way out. Nothing is read until a frame is asked for."""

    def __init__(self, frames: Frames, turn: Turn) -> None:
        count, rows, columns, *channels = frames.shape
        if turn.transpose:
            rows, columns = columns, rows
        super().__init__((count, rows, columns, *channels), frames.dtype)
        self._frames, self._turn = frames, turn

    def _read(self, frame: int) -> np.ndarray:
        pixels = self._frames[frame]
        if self._turn.transpose:
            pixels = np.swapaxes(pixels, 0, 1)
        if self._turn.flip_rows:
            pixels = np.flip(pixels, 0)
        if self._turn.flip_columns:
            pixels = np.flip(pixels, 1)
        return np.ascontiguousarray(pixels)


def turn_frames(frames: Frames, turn: Turn | None) -> Frames:
    """Return frames turned, or the frames themselves where there is nothing to turn."""
    return frames if turn is None or turn == Turn() else TurnedFrames(frames, turn)
