"""Pixels that stay in their file until they are asked for.

MetaImage and NRRD keep their pixels as one block, raw or as one zlib or gzip stream. Raw
blocks are mapped for the moment of one read. A stream has no random access: it is inflated
once, at the first read, into memory or, when large, into a temporary file. What a header
states is checked against the file before anything is allocated.
"""

import math
import shutil
import tempfile
import weakref
import zlib
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np

from sonosweep.errors import FormatError

LARGEST_IN_MEMORY_BYTES = 256 << 20
# Deflate cannot shrink data more than this (zlib technical details), so a header that
# states more is wrong, and found out without inflating anything.
LARGEST_DEFLATE_RATIO = 1032
CHUNK_BYTES = 1 << 20
# Bytes of a gzip header and trailer and of deflate's block headers, with room to spare.
STREAM_OVERHEAD_BYTES = 64


@dataclass(frozen=True)
class PixelData:
    """Where in a file a block of pixels lies, and how it is stored.

    Attributes:
        path: The file that holds it.
        offset: Bytes before it.
        stored_bytes: Its length in the file.
        compressed: Whether it is a zlib or gzip stream.
        dtype: Type of one value, with its byte order.
        shape: Size along each axis, the slowest first (NumPy's C order).
    """

    path: Path
    offset: int
    stored_bytes: int
    compressed: bool
    dtype: np.dtype
    shape: tuple[int, ...]

    def __post_init__(self) -> None:
        """Check the stated size against the file.

        Raises:
            FormatError: If the file cannot hold what is stated.
        """
        stated = self.stated_bytes
        what = f"'{self.path}' states {_times(self.shape)} values of {self.dtype.itemsize} byte"
        if not self.compressed and self.stored_bytes != stated:
            raise FormatError(
                f"{what}, {stated} bytes, but holds {self.stored_bytes} bytes of pixels: it was"
                " cut off or its header is wrong; copy or export it again"
            )
        most = LARGEST_DEFLATE_RATIO * self.stored_bytes
        if self.compressed and stated > most + STREAM_OVERHEAD_BYTES:
            raise FormatError(
                f"{what}, {stated} bytes, but its {self.stored_bytes} compressed bytes cannot hold"
                f" more than {most}: it was cut off or its header is wrong"
            )

    @property
    def stated_bytes(self) -> int:
        """Length of the block once inflated."""
        return math.prod(self.shape) * self.dtype.itemsize


class StoredFrames:
    """Frames that are read from a file when indexed; each read is a copy.

    The memory that stays in use is that of one frame, and for a compressed file of up to
    256 MB all frames from the first read on. Larger ones are inflated into a temporary file
    in the folder that ``TMPDIR`` names, which vanishes with this object.

    Args:
        pixels: Where the frames are.
        axes: Which stored axes are the frames, rows, columns and, for colour, channels.
            Axes that are not named must have size 1.
    """

    def __init__(self, pixels: PixelData, axes: tuple[int, ...]) -> None:
        self._pixels = pixels
        self._axes = axes
        self._rest = tuple(axis for axis in range(len(pixels.shape)) if axis not in axes)
        self._version = _version(pixels.path)
        self._array: np.ndarray | None = None
        self._temporary: IO[bytes] | None = None

    def __reduce__(self) -> tuple:
        """Let another process open the file for itself."""
        return StoredFrames, (self._pixels, self._axes)

    @property
    def shape(self) -> tuple[int, ...]:
        """Frames, rows, columns and, for colour, channels."""
        return tuple(self._pixels.shape[axis] for axis in self._axes)

    @property
    def dtype(self) -> np.dtype:
        """Type of a pixel, in this machine's byte order."""
        return self._pixels.dtype.newbyteorder("=")

    def __len__(self) -> int:
        """Return the number of frames."""
        return self.shape[0]

    def __getitem__(self, index: int | slice) -> np.ndarray:
        """Return one frame, or the frames of a slice.

        Raises:
            FormatError: If the file was changed since it was opened, or its stream is
                damaged or holds another number of bytes than stated.
        """
        stored = self._stored().transpose(self._axes + self._rest)
        arranged = stored.reshape(stored.shape[: len(self._axes)])
        return np.array(arranged[index], dtype=self.dtype, order="C")

    def _stored(self) -> np.ndarray:
        """Return the block in its stored order; a mapping is let go after each read."""
        if self._array is not None:
            return self._array
        if self._temporary is None and self._pixels.compressed:
            self._inflate()
            return self._stored()
        if self._temporary is None:
            _check_unchanged(self._pixels.path, self._version)
        source = self._temporary or self._pixels.path
        offset = 0 if self._temporary else self._pixels.offset
        try:
            return np.memmap(source, self._pixels.dtype, "r", offset, self._pixels.shape)
        except (OSError, ValueError) as error:
            raise FormatError(f"cannot read '{self._pixels.path}': {error}") from error

    def _inflate(self) -> None:
        _check_unchanged(self._pixels.path, self._version)
        if self._pixels.stated_bytes <= LARGEST_IN_MEMORY_BYTES:
            self._array = read_pixels(self._pixels)
        else:
            self._temporary = _inflate_to_file(self._pixels)
            weakref.finalize(self, self._temporary.close)


def read_pixels(pixels: PixelData) -> np.ndarray:
    """Return the whole block in memory, in the stored axis order and byte order.

    Raises:
        FormatError: If the stream is damaged or holds another number of bytes than stated.
    """
    flat = np.empty(pixels.stated_bytes, np.uint8)
    filled = 0
    for chunk in inflated_chunks(pixels) if pixels.compressed else _raw_chunks(pixels):
        flat[filled : filled + len(chunk)] = np.frombuffer(chunk, np.uint8)
        filled += len(chunk)
    return flat.view(pixels.dtype).reshape(pixels.shape)


def inflated_chunks(pixels: PixelData) -> Iterator[bytes]:
    """Yield the inflated block in pieces of at most 1 MB, and never more than is stated.

    Raises:
        FormatError: If the stream is damaged, ends early, or holds more than is stated.
    """
    left = pixels.stated_bytes
    for piece in _inflate_stream(pixels):
        left -= len(piece)
        if left < 0:
            raise FormatError(
                f"'{pixels.path}' holds more pixels than the {_times(pixels.shape)} that its"
                " header states: correct the header or export it again"
            )
        yield piece
    if left:
        raise FormatError(
            f"the compressed pixels of '{pixels.path}' end {left} bytes short of the"
            f" {_times(pixels.shape)} that its header states: copy or export it again"
        )


def _inflate_stream(pixels: PixelData) -> Iterator[bytes]:
    automatic = zlib.MAX_WBITS | 32  # zlib or gzip, by the first bytes
    inflater = zlib.decompressobj(automatic)
    try:
        for stored in _raw_chunks(pixels):
            while stored and not inflater.eof:
                yield inflater.decompress(stored, CHUNK_BYTES)
                stored = inflater.unconsumed_tail
        # All input is in, but a piece may have been full before all output was out.
        while piece := inflater.decompress(b"", CHUNK_BYTES):
            yield piece
    except zlib.error as error:
        raise FormatError(
            f"the compressed pixels of '{pixels.path}' are damaged ({error}): copy it again"
        ) from error


def _raw_chunks(pixels: PixelData) -> Iterator[bytes]:
    left = pixels.stored_bytes
    try:
        with pixels.path.open("rb") as file:
            file.seek(pixels.offset)
            while left > 0 and (chunk := file.read(min(CHUNK_BYTES, left))):
                left -= len(chunk)
                yield chunk
    except OSError as error:
        raise FormatError(f"cannot read '{pixels.path}': {error.strerror}") from error
    if left:
        raise FormatError(f"'{pixels.path}' became shorter while it was read: copy it again")


def _inflate_to_file(pixels: PixelData) -> IO[bytes]:
    folder = tempfile.gettempdir()
    room = shutil.disk_usage(folder).free
    if room < pixels.stated_bytes:
        raise FormatError(
            f"'{pixels.path}' needs {pixels.stated_bytes / 1e9:.1f} GB of temporary room in"
            f" '{folder}', which has {room / 1e9:.1f} GB: name a larger folder with TMPDIR"
        )
    try:
        with ExitStack() as on_failure:
            file = on_failure.enter_context(tempfile.TemporaryFile(prefix="sonosweep-"))
            for chunk in inflated_chunks(pixels):
                file.write(chunk)
            file.flush()
            on_failure.pop_all()
            return file
    except OSError as error:
        raise FormatError(f"cannot write temporary frames in '{folder}': {error}") from error


def _version(path: Path) -> tuple[int, int, int]:
    """Return what changes when a file is written again."""
    try:
        status = path.stat()
    except OSError as error:
        raise FormatError(f"cannot read '{path}': {error.strerror}") from error
    return status.st_ino, status.st_size, status.st_mtime_ns


def _check_unchanged(path: Path, version: tuple[int, int, int]) -> None:
    if _version(path) != version:
        raise FormatError(f"'{path}' was changed after it was opened: open it again")


def _times(shape: tuple[int, ...]) -> str:
    """Return a size as headers state it, the fastest axis first."""
    return " x ".join(str(size) for size in reversed(shape))
