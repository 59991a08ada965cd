"""Frames as a video file, with the time of every frame."""

import os
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.codec.context import Flags
from av.video.frame import VideoFrame
from jaxtyping import Float
from torch import Tensor

from sonosweep.errors import FormatError
from sonosweep.io.atomic import write_beside
from sonosweep.io.video import explaining
from sonosweep.scan import Frames

TICKS_PER_S = {".mkv": 1_000, ".mp4": 90_000}  # Matroska counts milliseconds and nothing finer
FULL_RANGE = 2  # FFmpeg's AVCOL_RANGE_JPEG: black is 0 and white is 255


def write_video(
    frames: Frames,
    timestamps_s: Float[Tensor, " frames"] | None,
    path: str | os.PathLike,
    crf: int | None = None,
    frame_rate_hz: float = 20.0,
) -> None:
    """Write frames as H.264 or lossless video; the same input gives the same bytes.

    Times are stored relative to the first frame, rounded to 1 ms in ``.mkv`` and 11 us in
    ``.mp4``.

    Args:
        frames: 8-bit gray or RGB.
        timestamps_s: Time of each frame; ``None`` takes a steady rate.
        path: ``.mkv`` or ``.mp4``.
        crf: Quality of H.264, 0 (no loss) to 51; 18 is hard to tell from the original.
            ``None`` loses nothing of gray frames: FFV1 in ``.mkv``, H.264 in ``.mp4``
            (which rounds colours).
        frame_rate_hz: The steady rate, where there are no times.

    Raises:
        FormatError: If frames, times or path cannot become a video, or the disk is full.
    """
    target = Path(path)
    ticks = _ticks(frames, timestamps_s, frame_rate_hz, target)
    colour = len(frames.shape) == 4
    if frames.dtype != np.uint8 or (colour and frames.shape[3] != 3):
        raise FormatError(
            f"a video holds 8-bit gray or RGB frames, not {frames.dtype} of shape {frames.shape}:"
            " write .h5 instead"
        )
    if crf is not None and not 0 <= crf <= 51:
        raise FormatError(f"crf must be 0 (no loss) to 51, got {crf}")
    with (
        write_beside(target) as temporary,
        explaining(target, "cannot be written as a video"),
        av.open(str(temporary), "w", options={"fflags": "+bitexact"}) as container,
    ):
        stream = _add_stream(container, frames, crf, target)
        stream.time_base = stream.codec_context.time_base = Fraction(
            1, TICKS_PER_S[target.suffix.lower()]
        )
        layout = "rgb24" if colour else "gray"
        for i, tick in enumerate(ticks):
            picture = VideoFrame.from_ndarray(np.ascontiguousarray(frames[i]), format=layout)
            picture.color_range = FULL_RANGE
            if stream.pix_fmt != layout:
                picture = picture.reformat(format=stream.pix_fmt, dst_color_range=FULL_RANGE)
            picture.pts, picture.time_base = tick, stream.time_base
            container.mux(stream.encode(picture))
        container.mux(stream.encode(None))


def _ticks(
    frames: Frames,
    timestamps_s: Float[Tensor, " frames"] | None,
    frame_rate_hz: float,
    target: Path,
) -> list[int]:
    """Return the time of each frame in the file's unit."""
    if target.suffix.lower() not in TICKS_PER_S:
        raise FormatError(f"cannot write video as '{target.name}'; known are .mkv and .mp4")
    if len(frames) == 0:
        raise FormatError(f"no frames to write to '{target.name}'")
    if not 0 < frame_rate_hz < 1e6:
        raise FormatError(f"the frame rate must be above 0 Hz, got {frame_rate_hz:g}")
    per_s = TICKS_PER_S[target.suffix.lower()]
    if timestamps_s is None:
        seconds = np.arange(len(frames)) / frame_rate_hz
    else:
        seconds = (timestamps_s - timestamps_s[0]).numpy()
    if len(seconds) != len(frames) or not (np.abs(seconds) < 1e9).all():
        raise FormatError(f"{len(frames)} frames need as many times, in seconds")
    ticks = np.rint(seconds * per_s).astype(np.int64)
    if len(ticks) > 1 and np.diff(ticks).min() < 1:
        raise FormatError(f"two frames fall into the same {1000 / per_s:g} ms of '{target.name}'")
    return ticks.tolist()


def _add_stream(
    container: av.container.OutputContainer, frames: Frames, crf: int | None, target: Path
) -> av.VideoStream:
    colour = len(frames.shape) == 4
    if crf is None and target.suffix.lower() == ".mkv":
        stream = container.add_stream("ffv1", rate=25)
        stream.pix_fmt = "bgr0" if colour else "gray"
        # Every frame for itself, so that any can be read at once and damage stays where it is.
        stream.options = {"level": "3", "g": "1"}
    else:
        stream = container.add_stream("libx264", rate=25)
        stream.pix_fmt = "yuv444p" if colour else "gray"
        stream.options = {"qp": "0"} if crf is None else {"crf": str(crf)}
    stream.height, stream.width = frames.shape[1:3]
    stream.codec_context.color_range = FULL_RANGE
    stream.codec_context.flags |= Flags.bitexact
    return stream
