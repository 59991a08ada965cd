"""When the frames of a DICOM recording were taken, in s from the first.

References:
    DICOM PS3.3 C.7.6.5 (cine module): Frame Increment Pointer says whether Frame Time or
    Frame Time Vector counts, both in ms.
"""

from collections.abc import Sequence
from os import PathLike

import numpy as np
import torch
from jaxtyping import Float
from pydicom import Dataset
from torch import Tensor

from sonosweep.errors import FormatError

FRAME_TIME, FRAME_TIME_VECTOR = 0x00181063, 0x00181065
MS_PER_S = 1000.0
SAME_INTERVAL_S = 1e-6
LONGEST_LIST = 65534  # a list of decimals states its length in 16 bits

FrameTimes = tuple[Float[Tensor, " frames"] | None, str]
"""Times of the frames, and what to know about them."""


def read_frame_times(header: Dataset, frames: int, path: str | PathLike) -> FrameTimes:
    """Return the times that a multi-frame header states.

    Rates of display stand in where there are no times, with a note that says so.

    Raises:
        FormatError: If there is a list of times for another number of frames.
    """
    pointer = header.get("FrameIncrementPointer")
    vector = header.get("FrameTimeVector")
    if vector is not None and pointer != FRAME_TIME:
        return _from_vector(_decimals(vector), frames, path)
    interval_ms = _positive(header.get("FrameTime"))
    if interval_ms:
        return _evenly(frames, interval_ms / MS_PER_S), ""
    for name, keyword in (
        ("cine rate", "CineRate"),
        ("recommended display frame rate", "RecommendedDisplayFrameRate"),
    ):
        rate_hz = _positive(header.get(keyword))
        if rate_hz:
            note = f"no frame times in the file: taken from its {name} of {rate_hz:g} Hz"
            return _evenly(frames, 1 / rate_hz), note
    return None, "the file has no frame times"


def _positive(value: object) -> float | None:
    number = float(str(value)) if value not in (None, "") else 0.0
    return number if np.isfinite(number) and number > 0 else None


def _decimals(value: object) -> np.ndarray:
    """Return the numbers of a list; past 64 kB pydicom leaves it as the bytes of its text."""
    if isinstance(value, bytes):
        value = value.decode("ascii").rstrip("\0 ").split("\\")
    return np.atleast_1d(np.asarray(value, dtype=np.float64))


def _evenly(frames: int, interval_s: float) -> Float[Tensor, " frames"]:
    return torch.arange(frames, dtype=torch.float64) * interval_s


def _from_vector(intervals_ms: np.ndarray, frames: int, path: str | PathLike) -> FrameTimes:
    note = ""
    if len(intervals_ms) == frames - 1:
        note = "the file's list of frame times lacks the first frame's 0"
        intervals_ms = np.concatenate(([0.0], intervals_ms))
    if len(intervals_ms) != frames:
        raise FormatError(
            f"{frames} frames but {len(intervals_ms)} frame times in '{path}'; the file is damaged"
        )
    if not (np.isfinite(intervals_ms).all() and (intervals_ms[1:] > 0).all()):
        return None, "the file's frame times do not increase, so they are not used"
    intervals_ms = np.concatenate(([0.0], intervals_ms[1:]))
    return torch.from_numpy(np.cumsum(intervals_ms) / MS_PER_S), note


def read_clock_times(headers: Sequence[Dataset]) -> FrameTimes:
    """Return the times of single-frame files, from the time of day that each states."""
    for keyword in ("AcquisitionTime", "ContentTime"):
        stated = [_seconds_of_day(header.get(keyword)) for header in headers]
        times = torch.tensor([np.nan if t is None else t for t in stated], dtype=torch.float64)
        if len(times) > 1 and bool((times.diff() > 0).all()):
            return times - times[0], ""
    interval_ms = _positive(headers[0].get("FrameTime"))
    if interval_ms:
        return _evenly(len(headers), interval_ms / MS_PER_S), ""
    return None, "the files have no times that tell frames apart"


def _seconds_of_day(value: object) -> float | None:
    """Return the seconds of a DICOM time, ``HHMMSS.ffffff``; ``None`` if it is not whole."""
    text = str(value or "").strip()
    if len(text.split(".")[0]) != 6 or not text.replace(".", "", 1).isdecimal():
        return None
    return int(text[:2]) * 3600 + int(text[2:4]) * 60 + float(text[4:])


def state_frame_times(header: Dataset, timestamps_s: Float[Tensor, " frames"] | None) -> None:
    """Write times into a multi-frame header; nothing if they are not known.

    Even times become one Frame Time, others a Frame Time Vector. The first becomes 0.
    """
    if timestamps_s is None or len(timestamps_s) < 2:
        return
    times_s = (timestamps_s - timestamps_s[0]).numpy()
    intervals_s = np.diff(times_s)
    mean_s = times_s[-1] / len(intervals_s)
    if np.abs(times_s - mean_s * np.arange(len(times_s))).max() < SAME_INTERVAL_S:
        header.FrameIncrementPointer = FRAME_TIME
        header.FrameTime = f"{mean_s * MS_PER_S:.12g}"
        return
    header.FrameIncrementPointer = FRAME_TIME_VECTOR
    # Rounding the times and not their differences keeps errors from adding up.
    rounded = np.round(times_s * MS_PER_S, 4)
    intervals = [f"{t:.4f}" for t in np.diff(rounded, prepend=0.0)]
    text = "\\".join(intervals)
    if len(text) <= LONGEST_LIST:
        header.FrameTimeVector = intervals
    else:
        # The standard's way out (PS3.5, 6.2.2): type unknown, which has a long length.
        header.add_new(FRAME_TIME_VECTOR, "UN", (text + " " * (len(text) % 2)).encode("ascii"))
