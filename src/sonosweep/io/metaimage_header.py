"""The header of MetaImage files (``.mha``, ``.mhd``), read and written.

The header is text, one ``Name = Value`` a line, and ends with ``ElementDataFile``. Sizes
are written with the fastest axis first.
"""

import os
import re
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TypeVar

import numpy as np

from sonosweep.errors import FormatError, ScanError
from sonosweep.io.header_lines import header_lines, open_binary
from sonosweep.io.pixel_data import PixelData

ELEMENT_TYPES = {
    "MET_CHAR": "i1",
    "MET_UCHAR": "u1",
    "MET_SHORT": "i2",
    "MET_USHORT": "u2",
    "MET_INT": "i4",
    "MET_UINT": "u4",
    "MET_LONG": "i4",
    "MET_ULONG": "u4",
    "MET_LONG_LONG": "i8",
    "MET_ULONG_LONG": "u8",
    "MET_FLOAT": "f4",
    "MET_DOUBLE": "f8",
}
# MetaImage's own fields, and the two that PLUS adds for the whole file.
METAIMAGE_FIELDS = frozenset(
    {
        "ObjectType",
        "ObjectSubType",
        "NDims",
        "Comment",
        "AnatomicalOrientation",
        "BinaryData",
        "BinaryDataByteOrderMSB",
        "ElementByteOrderMSB",
        "CenterOfRotation",
        "CompressedData",
        "CompressedDataSize",
        "DimSize",
        "Kinds",
        "ElementSpacing",
        "ElementSize",
        "ElementType",
        "ElementNumberOfChannels",
        "Offset",
        "Position",
        "Origin",
        "TransformMatrix",
        "Rotation",
        "Orientation",
        "HeaderSize",
        "ElementDataFile",
        "UltrasoundImageOrientation",
        "UltrasoundImageType",
    }
)
# Where we keep what MetaImage has no word for; ITK passes unknown names on.
OWN_PREFIX = "Sonosweep_"
# IGSIO and 3D Slicer read lines of at most this many bytes and mistake the rest for the next.
LONGEST_WRITTEN_LINE = 990
COMPRESSION_LEVEL = 3  # B-mode: level 6 takes twice as long and saves nothing
# Room for the length of the compressed pixels, which is known only after the header.
PADDING = 20
# Above what files and arrays can count; NaN and infinity are not below it.
LARGEST_NUMBER = 2**62
Number = TypeVar("Number", int, float)


@dataclass(frozen=True)
class MetaImageHeader:
    """What a MetaImage header states.

    Attributes:
        path: The header's file.
        values: Every value by its name, in the order of the file.
        size: Samples along each axis, the fastest first.
        pixels: Where the pixels lie, shaped slowest axis first with channels last; ``None``
            if the size is 0 along some axis, as in files that hold only poses.
    """

    path: Path
    values: Mapping[str, str]
    size: tuple[int, ...]
    pixels: PixelData | None


def read_metaimage_header(path: str | os.PathLike) -> MetaImageHeader:
    """Return the header of a MetaImage file; no pixel is read.

    Raises:
        FormatError: If it is no MetaImage, is damaged, or its pixels are not all there.
    """
    path = Path(path)
    with open_binary(path) as file:
        values = _header_values(file, path)
        end = file.tell()
    size = tuple(header_counts(values, "DimSize", path))
    if len(size) != _header_count(values, "NDims", path) or min(size) < 0:
        raise FormatError(
            f"NDims = {values['NDims']} but DimSize = {values['DimSize']} in '{path}': expected"
            " one size of 0 or more per dimension"
        )
    pixels = None if min(size) == 0 else _find_pixels(values, size, path, end)
    return MetaImageHeader(path, values, size, pixels)


def header_numbers(values: Mapping[str, str], name: str, path: Path) -> list[float]:
    """Return the finite numbers of a header field.

    Raises:
        FormatError: If it is missing or holds something else.
    """
    return _convert(values, name, path, float, "numbers")


def header_counts(values: Mapping[str, str], name: str, path: Path) -> list[int]:
    """Return the whole numbers of a header field.

    Raises:
        FormatError: If it is missing or holds something else.
    """
    return _convert(values, name, path, int, "whole numbers")


def _convert(
    values: Mapping[str, str], name: str, path: Path, kind: type[Number], expected: str
) -> list[Number]:
    if name not in values:
        raise FormatError(f"'{path}' has no {name} in its header: it is damaged or another format")
    try:
        numbers = [kind(word) for word in values[name].split()]
    except ValueError:
        numbers = []
    if not numbers or not all(abs(number) < LARGEST_NUMBER for number in numbers):
        raise FormatError(f"{name} = {values[name][:60]} in '{path}': expected {expected}")
    return numbers


def _header_count(values: Mapping[str, str], name: str, path: Path) -> int:
    """Return the one whole number of a header field."""
    numbers = header_counts(values, name, path)
    if len(numbers) != 1:
        raise FormatError(f"{name} = {values[name][:60]} in '{path}': expected one number")
    return numbers[0]


def _header_values(file: IO[bytes], path: Path) -> dict[str, str]:
    values: dict[str, str] = {}
    for line in header_lines(file, path):
        name, equals, value = line.partition("=")
        if not equals and line.strip():
            break
        if equals:
            values[name.strip()] = value.strip()
        if name.strip() == "ElementDataFile":
            return values
    raise FormatError(
        f"'{path}' is no MetaImage, or was cut off: its header has no ElementDataFile line"
    )


def _find_pixels(
    values: Mapping[str, str], sizes: tuple[int, ...], path: Path, header_end: int
) -> PixelData:
    dtype = _pixel_type(values, path)
    channels = 1
    if "ElementNumberOfChannels" in values:
        channels = _header_count(values, "ElementNumberOfChannels", path)
    if channels < 1:
        raise FormatError(f"ElementNumberOfChannels = {channels} in '{path}': expected 1 or more")
    shape = sizes[::-1] if channels == 1 else (*sizes[::-1], channels)
    source = data_file(values["ElementDataFile"], path)
    offset = header_end if source == path else 0
    compressed = values.get("CompressedData", "False").lower() == "true"
    available = source.stat().st_size - offset
    stated = int(np.prod([*shape, dtype.itemsize], dtype=object))
    if "HeaderSize" in values and source != path:
        skip = _header_count(values, "HeaderSize", path)
        # -1 means: the pixels are the end of the file, whatever comes before.
        skip = available - stated if skip == -1 else skip
        offset, available = offset + skip, available - skip
    if compressed and "CompressedDataSize" in values:
        length = _header_count(values, "CompressedDataSize", path)
        if length > available:
            raise FormatError(
                f"'{path}' states {length} compressed bytes but holds {available}: it was cut"
                " off; copy or export it again"
            )
        available = length or available
    if offset < 0 or available < 0:
        raise FormatError(f"the pixels of '{path}' would start outside the file: it is damaged")
    return PixelData(source, offset, available, compressed, dtype, shape)


def _pixel_type(values: Mapping[str, str], path: Path) -> np.dtype:
    name = values.get("ElementType", "")
    if name not in ELEMENT_TYPES:
        raise FormatError(
            f"ElementType = {name[:60]} in '{path}': expected one of {', '.join(ELEMENT_TYPES)}"
        )
    if values.get("BinaryData", "True").lower() != "true":
        raise FormatError(f"'{path}' holds its pixels as text: export it with BinaryData = True")
    swapped = values.get("BinaryDataByteOrderMSB", values.get("ElementByteOrderMSB", "False"))
    return np.dtype((">" if swapped.lower() == "true" else "<") + ELEMENT_TYPES[name])


def data_file(name: str, header: Path) -> Path:
    """Return the file that a header names for its pixels.

    Raises:
        FormatError: If there is no such plain file, or it names several.
    """
    if name.upper() == "LOCAL":
        return header
    if name.split()[:1] == ["LIST"] or "%" in name or not name:
        raise FormatError(f"'{header}' spreads its pixels over several files: export it as one")
    try:
        source = header.parent / name
        found = source.is_file()
    except (OSError, ValueError):
        found = False
    if not found:
        raise FormatError(
            f"'{header}' keeps its pixels in '{name[:200]}', which is not beside it: copy both"
        )
    return source


def own_fields(settings: Mapping[str, str]) -> dict[str, str]:
    """Return settings as header fields of our own; line breaks become blanks, long ones end."""
    fields = {}
    for name, value in settings.items():
        field = OWN_PREFIX + re.sub(r"\W", "_", name, flags=re.ASCII)
        room = LONGEST_WRITTEN_LINE - len(field) - 3
        text = " ".join(str(value).split()).encode()[:room]
        fields[field] = text.decode(errors="ignore")
    return fields


def write_header_and_pixels(
    file: IO[bytes], fields: Mapping[str, str], pieces: Iterable[np.ndarray], compress: bool
) -> None:
    """Write a whole local MetaImage: header, then pixels, compressed as one zlib stream."""
    lines = [f"{name} = {value}" for name, value in fields.items()]
    if compress:
        lines.insert(lines.index("CompressedData = True") + 1, "CompressedDataSize = ")
    place = 0
    for line in lines:
        text = line.encode()
        if line == "CompressedDataSize = ":
            place = file.tell() + len(text)
            text += b" " * PADDING
        file.write(text + b"\n")
    file.write(b"ElementDataFile = LOCAL\n")
    start = file.tell()
    write_pixels(file, pieces, compress)
    if compress:
        length = file.tell() - start
        file.seek(place)
        file.write(str(length).encode())


def write_pixels(
    file: IO[bytes], pieces: Iterable[np.ndarray], compress: bool, gzip: bool = False
) -> None:
    """Write pixels piece by piece, raw or as one zlib or gzip stream."""
    if not compress:
        for piece in pieces:
            file.write(piece.data)
        return
    deflater = zlib.compressobj(COMPRESSION_LEVEL, wbits=zlib.MAX_WBITS | (16 if gzip else 0))
    for piece in pieces:
        file.write(deflater.compress(piece.data))
    file.write(deflater.flush())


def element_type(dtype: np.dtype) -> str:
    """Return MetaImage's word for a pixel type.

    Raises:
        ScanError: If it has none.
    """
    for name, code in ELEMENT_TYPES.items():
        if np.dtype(dtype).str[1:] == code:
            return name
    raise ScanError(f"pixels of type {dtype} cannot be written: convert them to uint8 or float32")


def numbers_text(numbers: Iterable[float]) -> str:
    """Return numbers so that reading them gives the same floats, in as few digits as do."""
    # Adding 0 turns -0 into 0.
    return " ".join(repr(float(number) + 0.0).removesuffix(".0") for number in numbers)
