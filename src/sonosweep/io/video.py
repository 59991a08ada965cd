"""Video files, read frame by frame with the times that the file really states.

MP4, MOV, MKV, WebM, AVI, MPEG, WMV, GIF: whatever the FFmpeg inside PyAV decodes, except
streams without times. The number of frames is that of the packets, not of the header,
which often lies. A video without colour comes out as gray.
"""

import os
from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import torch
from av.video.frame import VideoFrame

from sonosweep.errors import FormatError, SonosweepError
from sonosweep.io.hdf5_access import first_line
from sonosweep.scan import LazyFrames, Scan

# Playlists and scripts are left out: they make FFmpeg open other files and addresses.
CONTAINERS = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpegts,mpeg,asf,gif,ogg,flv,nut"
LARGEST_FRAME_PX = 2**26
LARGEST_FRAME_COUNT = 10_000_000
CACHE_BYTES = 2**26
COLOUR_LEVELS = 24  # compression leaves chroma of a few grey levels in a gray video
MISSING_S = 1.0  # a header that promises this much more than there is tells of a cut file


@dataclass(frozen=True)
class VideoIndex:
    """Where the frames of a video are.

    Attributes:
        size: Columns and rows.
        pixel_format: What FFmpeg calls the kind of pixel.
        time_base_s: The unit of all ticks, as a fraction of a second.
        ticks: Time of each frame, increasing.
        key_ticks: Times of the frames that can be decoded without others, increasing.
        promised_s: How long the header says the video is; ``None`` if it does not.
        doubled: How many frames are left out because they have the time of another.
    """

    size: tuple[int, int]
    pixel_format: str
    time_base_s: Fraction
    ticks: tuple[int, ...]
    key_ticks: tuple[int, ...]
    promised_s: float | None
    doubled: int


def read_video(path: str | os.PathLike, gray: bool | None = None) -> Scan:
    """Return a video as a scan; frames are decoded when indexed.

    Going through the frames in order decodes each of them once.

    Args:
        path: The file.
        gray: Whether frames are brightness only; ``None`` looks at the first, the middle
            and the last frame for colour.

    Raises:
        FormatError: If it is no video, holds no frames or no times, or is damaged.
        ScanError: If its times do not increase.
    """
    file = Path(path)
    index = index_video(file)
    frames = VideoFrames(file, index, gray=False)
    if gray is None:
        gray = not _has_colour(frames)
    if gray:
        frames = VideoFrames(file, index, gray=True)
    unit = index.time_base_s
    times = [float(tick * unit) for tick in index.ticks]
    notes = {}
    if index.doubled:
        notes["times"] = f"{index.doubled} frames are left out: they have the time of another"
    if index.promised_s is not None and index.promised_s > times[-1] - times[0] + MISSING_S:
        notes["frames"] = (
            f"the header promises {index.promised_s:.1f} s but the frames end after"
            f" {times[-1] - times[0]:.1f} s: the file may have been cut off"
        )
    return Scan(
        name=file.stem,
        frames=frames,
        timestamps_s=torch.tensor(times, dtype=torch.float64),
        notes=notes,
    )


def index_video(path: Path) -> VideoIndex:
    """Return where the frames are, by reading every packet and decoding none.

    Raises:
        FormatError: If it is no video, holds no frames or no times, or is damaged.
    """
    if not path.is_file():
        raise FormatError(f"there is no file '{path}'")
    ticks: list[int] = []
    keys: list[int] = []
    with explaining(path), _open(path) as container:
        stream = _video_stream(container, path)
        for packet in container.demux(stream):
            if not packet.size or packet.is_discard:
                continue
            if packet.pts is None:
                raise FormatError(
                    f"'{path.name}' has frames without time: put the stream into a container such"
                    " as .mkv"
                )
            ticks.append(packet.pts)
            if packet.is_keyframe:
                keys.append(packet.pts)
            if len(ticks) > LARGEST_FRAME_COUNT:
                raise FormatError(f"'{path.name}' has more frames than a sweep can have")
        context = stream.codec_context
        promised = None if container.duration is None else container.duration / av.time_base
        if not ticks:
            raise FormatError(f"'{path.name}' holds no frames")
        return VideoIndex(
            size=(context.width, context.height),
            pixel_format=context.pix_fmt or "",
            time_base_s=Fraction(stream.time_base or 0),
            ticks=tuple(sorted(set(ticks))),
            key_ticks=tuple(sorted(set(keys))),
            promised_s=promised,
            doubled=len(ticks) - len(set(ticks)),
        )


class VideoFrames(LazyFrames):
    """Frames decoded when indexed; can be pickled and used after a fork.

    Args:
        path: The file.
        index: What :func:`index_video` found in it.
        gray: Whether to give brightness only.
    """

    def __init__(self, path: Path, index: VideoIndex, gray: bool) -> None:
        columns, rows = index.size
        self._deep = gray and index.pixel_format.startswith(("gray1", "gray9"))
        super().__init__(
            (len(index.ticks), rows, columns, *([] if gray else [3])),
            np.dtype(np.uint16 if self._deep else np.uint8),
        )
        self._path, self._index, self._gray = path.absolute(), index, gray
        self._number = {tick: i for i, tick in enumerate(index.ticks)}
        self._forget()

    def __getstate__(self) -> dict:
        """Return everything but the decoder and what it decoded."""
        kept = {k: v for k, v in self.__dict__.items() if k not in ("_decoded", "_decoder")}
        return {**kept, "_process": None, "_container": None}

    def __setstate__(self, state: dict) -> None:
        """Take over a pickled state, with no decoder yet."""
        self.__dict__.update(state)
        self._forget()

    def _forget(self) -> None:
        """Be as if no frame had been read."""
        self._process: int | None = os.getpid()
        self._container: av.container.InputContainer | None = None
        self._decoder: Iterator[VideoFrame] | None = None
        self._reached: int | None = None
        self._decoded: OrderedDict[int, np.ndarray] = OrderedDict()

    def _read(self, frame: int) -> np.ndarray:
        if self._process != os.getpid():
            self._forget()
        if frame not in self._decoded:
            try:
                with explaining(self._path):
                    self._decode_until(frame)
            except SonosweepError as error:
                self._forget()
                raise FormatError(
                    f"frame {frame} of '{self._path.name}' cannot be decoded: {error}"
                ) from error
        self._decoded.move_to_end(frame)
        return self._decoded[frame].copy()

    def _decode_until(self, frame: int) -> None:
        """Decode up to a frame: from here, else from a key frame before, else from the start."""
        target = self._index.ticks[frame]
        key = bisect_right(self._index.key_ticks, target) - 1
        keys = [self._index.key_ticks[k] for k in (key, key - 1) if k >= 0]
        if self._is_ahead(frame, keys) and self._advance(target):
            return
        for start in (*keys, None):
            try:
                self._start(start)
                if self._advance(target):
                    return
            except av.FFmpegError:
                # Some containers cannot seek exactly; the start of the file always works.
                if start is None:
                    raise
        raise FormatError("the decoder does not give it")

    def _is_ahead(self, frame: int, keys: list[int]) -> bool:
        """Say whether decoding on is the shortest way to a frame."""
        if self._reached is None or self._reached >= self._index.ticks[frame]:
            return False
        is_next = self._index.ticks[frame - 1] == self._reached
        return is_next or not keys or self._reached >= keys[0]

    def _start(self, tick: int | None) -> None:
        """Go to a key frame, or open the file anew."""
        if tick is None or self._container is None:
            if self._container is not None:
                self._container.close()
            self._container = _open(self._path)
        stream = _video_stream(self._container, self._path)
        if tick is not None:
            self._container.seek(tick, stream=stream)
        self._decoder = self._container.decode(stream)
        self._reached = None if tick is None else tick - 1

    def _advance(self, target: int) -> bool:
        """Decode until the target is there; say whether it is."""
        assert self._decoder is not None
        for decoded in self._decoder:
            # Of frames at the same time the first one counts, however it was reached.
            if decoded.pts is None or (self._reached is not None and decoded.pts <= self._reached):
                continue
            self._reached = decoded.pts
            number = self._number.get(decoded.pts)
            if number is not None and not decoded.is_corrupt:
                self._keep(number, decoded)
            if decoded.pts >= target:
                break
        return self._number[target] in self._decoded

    def _keep(self, number: int, decoded: VideoFrame) -> None:
        layout = ("gray16le" if self._deep else "gray") if self._gray else "rgb24"
        pixels = decoded.to_ndarray(format=layout)
        if pixels.shape != self.shape[1:]:
            raise FormatError(
                f"its size changes from {self.shape[1:3]} to {pixels.shape[:2]} rows and columns"
            )
        self._decoded[number] = pixels
        while len(self._decoded) * pixels.nbytes > CACHE_BYTES and len(self._decoded) > 1:
            self._decoded.popitem(last=False)


@contextmanager
def explaining(path: Path, problem: str = "is not a readable video") -> Iterator[None]:
    """Turn whatever FFmpeg raises into one sentence that says the problem."""
    try:
        yield
    except SonosweepError:
        raise
    except (OSError, ValueError, RuntimeError, MemoryError, av.FFmpegError) as error:
        reason = getattr(error, "strerror", None) or first_line(error)
        raise FormatError(f"'{path.name}' {problem} ({reason})") from error


def _open(path: Path) -> av.container.InputContainer:
    options = {"protocol_whitelist": "file", "format_whitelist": CONTAINERS}
    return av.open(str(path.absolute()), options=options)


def _video_stream(container: av.container.InputContainer, path: Path) -> av.VideoStream:
    stream = container.streams.best("video")
    if not isinstance(stream, av.VideoStream):
        raise FormatError(f"'{path.name}' holds no video")
    if stream.codec_context is None:
        raise FormatError(f"'{path.name}' is coded in a way that FFmpeg does not know")
    columns, rows = stream.codec_context.width, stream.codec_context.height
    if not 0 < columns * rows <= LARGEST_FRAME_PX:
        raise FormatError(f"'{path.name}' has frames of {columns} x {rows} pixels")
    return stream


def _has_colour(frames: VideoFrames) -> bool:
    """Say whether the first, the middle or the last frame is more than gray."""
    for i in dict.fromkeys((0, len(frames) // 2, len(frames) - 1)):
        try:
            levels = frames[i].astype(np.int16)
        except FormatError:
            if i == 0:
                raise
            continue  # whoever asks for this frame will be told
        if np.ptp(levels, axis=-1).max() > COLOUR_LEVELS:
            return True
    return False
