"""The frames of one DICOM file, decoded one at a time.

Colour comes out as RGB whatever the file stores; MONOCHROME1 is turned so that more is
brighter. Patient identity is in the header and is never passed on.
"""

import struct
import warnings
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from pydicom import Dataset, dcmread
from pydicom.encaps import parse_basic_offsets, parse_fragments
from pydicom.filereader import read_file_meta_info
from pydicom.pixels import apply_color_lut, get_decoder
from pydicom.pixels.utils import as_pixel_options
from pydicom.uid import UID, DeflatedExplicitVRLittleEndian

from sonosweep.errors import FormatError
from sonosweep.io.guard import check_size, refusing

COLORS = ("RGB", "YBR_FULL", "YBR_FULL_422", "YBR_ICT", "YBR_RCT")
GRAYS = ("MONOCHROME1", "MONOCHROME2", "PALETTE COLOR")
PIXEL_DATA = (0x7FE0, 0x0010)
# A black 8 x 8 block is at least 2 bits of JPEG (512 : 1 at 8 bits); what claims to be
# smaller than twice that is a damaged header.
LARGEST_RATIO = 1024


@dataclass(frozen=True, eq=False)
class DicomFrames:
    """Frames of a DICOM file; each index opens the file and decodes one.

    Attributes:
        path: The file.
        start: Where in it the value of Pixel Data begins.
        options: What the decoder needs to know, from the header.
        palette: The header, if its colour table turns indices into colour.
        shape: Frames, rows, columns and, for colour, 3.
        dtype: Of the frames given.
        white: What MONOCHROME1 pixels are subtracted from; ``None`` for others.
    """

    path: Path
    start: int
    options: dict[str, Any]
    palette: Dataset | None
    shape: tuple[int, ...]
    dtype: np.dtype
    white: int | None = None

    def __len__(self) -> int:
        """Return the number of frames."""
        return self.shape[0]

    def __getitem__(self, index: int | slice) -> np.ndarray:
        """Return one frame, or the frames of a slice.

        Raises:
            FormatError: If a frame cannot be decoded.
        """
        if isinstance(index, slice):
            chosen = range(len(self))[index]
            stack = np.empty((len(chosen), *self.shape[1:]), self.dtype)
            for k, frame in enumerate(chosen):
                stack[k] = self[frame]
            return stack
        return self._read(range(len(self))[index])

    def _read(self, index: int) -> np.ndarray:
        with refusing(self.path, f"DICOM (frame {index})"), self.path.open("rb") as file:
            file.seek(self.start)
            decoder = get_decoder(self.options["transfer_syntax_uid"])
            frame, _ = decoder.as_array(file, index=index, **self.options)
            if self.palette is not None:
                frame = _eight_bits(apply_color_lut(frame, self.palette))
            if self.white is not None:
                frame = np.asarray(self.white - frame.astype(np.int32), self.dtype)
            if frame.shape != self.shape[1:]:
                raise FormatError(
                    f"frame {index} of '{self.path}' decodes to {frame.shape}; its header says"
                    f" {self.shape[1:]}"
                )
            return frame.astype(self.dtype, copy=False)


def _eight_bits(color: np.ndarray) -> np.ndarray:
    return (color >> 8).astype(np.uint8) if color.dtype == np.uint16 else color.astype(np.uint8)


def is_dicom(path: str | PathLike) -> bool:
    """Say whether a file has DICOM's mark after its preamble."""
    try:
        with Path(path).open("rb") as file:
            return file.read(132)[128:] == b"DICM"
    except OSError:
        return False


def open_dicom(path: str | PathLike) -> tuple[Dataset, DicomFrames]:
    """Return the header of a DICOM image and its frames, which are read when indexed.

    Raises:
        FormatError: If it is no DICOM image, promises more pixels than the file can hold,
            or is compressed in a way that we cannot decode.
    """
    with refusing(path, "a DICOM image"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        syntax = UID(read_file_meta_info(path).TransferSyntaxUID)
        if syntax == DeflatedExplicitVRLittleEndian:
            raise FormatError(f"'{path}' is deflated as a whole, which is not supported")
        with Path(path).open("rb") as file:
            header = dcmread(file, stop_before_pixels=True)
            options = as_pixel_options(header, transfer_syntax_uid=syntax)
            options.update(pixel_keyword="PixelData", pixel_vr="OW")
            length = _read_pixel_element(file, syntax, path)
            start = file.tell()
            frames = _describe_frames(Path(path), start, header, options)
            _check_pixels(file, frames, length)
        return header, frames


def _read_pixel_element(file: BinaryIO, syntax: UID, path: str | PathLike) -> int:
    """Read the tag of Pixel Data and return the length of its value."""
    order = "<" if syntax.is_little_endian else ">"
    start = file.read(8)
    if len(start) < 8 or struct.unpack(order + "HH", start[:4]) != PIXEL_DATA:
        raise FormatError(f"'{path}' holds no image: it has no Pixel Data")
    raw = start[4:] if syntax.is_implicit_VR else file.read(4)
    return int(struct.unpack(order + "I", raw)[0])


def _describe_frames(
    path: Path, start: int, header: Dataset, options: dict[str, Any]
) -> DicomFrames:
    photometric = str(options["photometric_interpretation"])
    bits, signed = int(options["bits_allocated"]), bool(options["pixel_representation"])
    samples = int(options["samples_per_pixel"])
    if photometric not in (COLORS if samples == 3 else GRAYS):
        raise FormatError(
            f"'{path}' stores its {samples} samples per pixel as {photometric}; expected"
            f" {', '.join(COLORS)} or {', '.join(GRAYS)}"
        )
    if bits not in (8, 16) or (samples == 3 and bits != 8):
        raise FormatError(f"'{path}' has {bits} bits per sample; expected 8, or 16 without colour")
    in_color = samples == 3 or photometric == "PALETTE COLOR"
    shape = (int(options["number_of_frames"]), int(options["rows"]), int(options["columns"]))
    if min(shape) < 1:
        raise FormatError(f"'{path}' has {shape} frames, rows and columns")
    white = -1 if signed else (1 << int(options["bits_stored"])) - 1
    return DicomFrames(
        path=path,
        start=start,
        options=options,
        palette=header if photometric == "PALETTE COLOR" else None,
        shape=(*shape, 3) if in_color else shape,
        dtype=np.dtype(np.uint8 if in_color else f"{'i' if signed else 'u'}{bits // 8}"),
        white=white if photometric == "MONOCHROME1" else None,
    )


def _check_pixels(file: BinaryIO, frames: DicomFrames, length: int) -> None:
    """Refuse headers that promise more than is there; find compressed frames."""
    options, path = frames.options, frames.path
    stored = file.seek(0, 2) - frames.start
    file.seek(frames.start)
    samples = int(options["samples_per_pixel"])
    frame_bytes = frames.shape[1] * frames.shape[2] * samples * int(options["bits_allocated"]) // 8
    if not options["transfer_syntax_uid"].is_encapsulated:
        if options["photometric_interpretation"] == "YBR_FULL_422":
            frame_bytes = frame_bytes * 2 // 3
        check_size(len(frames) * frame_bytes, min(stored, length), 1, path)
        return
    check_size(frame_bytes, stored, LARGEST_RATIO, path)
    _check_decoder(options["transfer_syntax_uid"], path)
    table = parse_basic_offsets(file)
    if not table and "extended_offsets" not in options:
        _index_fragments(file, frames)
    elif table and (len(table) != len(frames) or table[-1] >= stored):
        raise FormatError(f"'{path}' is cut short: it has not all of its {len(frames)} frames")


def _check_decoder(syntax: UID, path: Path) -> None:
    """Refuse compressions for which no decoder is installed."""
    try:
        available = get_decoder(syntax).is_available
    except NotImplementedError:
        available = False
    if not available:
        raise FormatError(
            f"'{path}' is compressed as {syntax.name}, for which no decoder is installed;"
            " convert it to uncompressed DICOM"
        )


def _index_fragments(file: BinaryIO, frames: DicomFrames) -> None:
    """Find each frame once, so that reading one does not mean walking over those before."""
    base = file.tell()
    count, positions = parse_fragments(file)
    if count < len(frames):
        raise FormatError(
            f"'{frames.path}' is cut short: its header promises {len(frames)} frames and"
            f" {count} are there"
        )
    if count == len(frames):
        lengths = []
        for position in positions:
            file.seek(position + 4)
            lengths.append(struct.unpack("<I", file.read(4))[0])
        frames.options["extended_offsets"] = ([p - base for p in positions], lengths)
