"""The headers of NRRD sequences: PLUS's ``.igs.nrrd`` and 3D Slicer's ``.seq.nrrd``.

``field: value`` is NRRD's own, ``key:=value`` is anybody's; an empty line ends the header.
Sizes are written with the fastest axis first.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np

from sonosweep.errors import FormatError
from sonosweep.io.header_lines import header_lines, open_binary
from sonosweep.io.metaimage_header import data_file, header_counts
from sonosweep.io.pixel_data import PixelData

# NRRD's own fields, in lower case, and the two that IGSIO adds for the whole file.
NRRD_FIELDS = frozenset(
    {
        "type",
        "dimension",
        "space",
        "space dimension",
        "space units",
        "sizes",
        "space directions",
        "spacings",
        "axis mins",
        "axis maxs",
        "kinds",
        "labels",
        "units",
        "endian",
        "encoding",
        "space origin",
        "data file",
        "datafile",
        "thicknesses",
        "centers",
        "centerings",
        "content",
        "measurement frame",
        "byte skip",
        "byteskip",
        "line skip",
        "lineskip",
        "min",
        "max",
        "number",
        "block size",
        "sample units",
        "old min",
        "old max",
        "ultrasound image orientation",
        "ultrasound image type",
    }
)
VALUE_TYPES = {
    "i1": ("signed char", "int8", "int8_t"),
    "u1": ("unsigned char", "uchar", "uint8", "uint8_t"),
    "i2": ("short", "short int", "signed short", "signed short int", "int16", "int16_t"),
    "u2": ("unsigned short", "ushort", "unsigned short int", "uint16", "uint16_t"),
    "i4": ("int", "signed int", "int32", "int32_t"),
    "u4": ("unsigned int", "uint", "uint32", "uint32_t"),
    "i8": ("longlong", "long long", "long long int", "signed long long", "int64", "int64_t"),
    "u8": ("unsigned long long", "ulonglong", "unsigned long long int", "uint64", "uint64_t"),
    "f4": ("float",),
    "f8": ("double",),
}
VECTOR = re.compile(r"none|\(([^()]*)\)", re.IGNORECASE)


@dataclass(frozen=True)
class NrrdHeader:
    """What an NRRD header states.

    Attributes:
        values: Fields (names in lower case) and keys (as written), in the order of the file.
        size: Samples along each axis, the fastest first.
        kinds: What each axis is, in that order; empty if not stated.
        spacing: Distance between samples along each axis, NaN where not stated.
        pixels: Where the pixels lie, slowest axis first; ``None`` if there are none.
    """

    values: Mapping[str, str]
    size: tuple[int, ...]
    kinds: tuple[str, ...]
    spacing: tuple[float, ...]
    pixels: PixelData | None


def read_nrrd_header(path: Path) -> NrrdHeader:
    """Return the header of an NRRD file; no pixel is read.

    Raises:
        FormatError: If it is no NRRD, uses an encoding other than raw and gzip, or its pixels
            are not all there.
    """
    with open_binary(path) as file:
        values = _header_values(file, path)
        end = file.tell()
    size = tuple(header_counts(values, "sizes", path))
    dimension = header_counts(values, "dimension", path)
    kinds = tuple(values.get("kinds", "").split())
    if dimension != [len(size)] or min(size) < 0 or len(kinds) not in (0, len(size)):
        raise FormatError(
            f"dimension, sizes and kinds of '{path}' do not agree: {values['dimension'][:20]},"
            f" {values['sizes'][:40]} and {values.get('kinds', 'none')[:60]}"
        )
    pixels = None if min(size) == 0 else _find_pixels(values, size, path, end)
    return NrrdHeader(values, size, kinds, _spacing(values, len(size)), pixels)


def _header_values(file: IO[bytes], path: Path) -> dict[str, str]:
    lines = header_lines(file, path)
    magic = file.read(4)
    if magic != b"NRRD":
        raise FormatError(f"'{path}' is no NRRD file: it does not start with NRRD")
    next(lines, "")
    values: dict[str, str] = {}
    for line in lines:
        if not line.strip():
            return values
        if line.startswith("#"):
            continue
        name, colon, value = line.partition(":")
        if not colon:
            raise FormatError(f"the header of '{path}' holds a line without colon: '{line[:40]}'")
        # IGSIO writes what is not NRRD's with "=" or without.
        name, lower = name.strip(), name.strip().lower()
        values[lower if lower in NRRD_FIELDS else name] = value.removeprefix("=").strip()
    if "data file" in values or "datafile" in values:
        return values
    raise FormatError(f"'{path}' was cut off: no empty line ends its header")


def _find_pixels(
    values: Mapping[str, str], size: tuple[int, ...], path: Path, header_end: int
) -> PixelData:
    encoding = values.get("encoding", "").lower()
    if encoding not in ("raw", "gz", "gzip"):
        raise FormatError(
            f"encoding '{encoding[:40]}' of '{path}' cannot be read: save it as raw or gzip"
        )
    source = data_file(values.get("data file", values.get("datafile", "LOCAL")), path)
    offset = header_end if source == path else 0
    dtype = _value_type(values, path)
    available = source.stat().st_size - offset
    for field in ("byte skip", "byteskip", "line skip", "lineskip"):
        if values.get(field, "0") == "-1" and "byte" in field and encoding == "raw":
            skip = available - int(np.prod([*size, dtype.itemsize], dtype=object))
            offset, available = offset + skip, available - skip
        elif values.get(field, "0") != "0":
            raise FormatError(f"{field} in '{path}' cannot be read: save it again without")
    if offset < 0 or available < 0:
        raise FormatError(f"the pixels of '{path}' would start outside the file: it is damaged")
    return PixelData(source, offset, available, encoding != "raw", dtype, size[::-1])


def _value_type(values: Mapping[str, str], path: Path) -> np.dtype:
    stated = values.get("type", "").lower()
    for code, words in VALUE_TYPES.items():
        if stated in words:
            order = ">" if values.get("endian", "little").lower() == "big" else "<"
            return np.dtype(order + code)
    raise FormatError(f"type '{stated[:40]}' of '{path}' cannot be read: save it as uint8 or float")


def _spacing(values: Mapping[str, str], axes: int) -> tuple[float, ...]:
    """Return the spacing of each axis, NaN where none is stated or it makes no sense."""
    unknown = (float("nan"),) * axes
    try:
        if "space directions" in values:
            found = VECTOR.finditer(values["space directions"])
            vectors = [[float(n) for n in (m[1] or "nan").split(",")] for m in found]
            spacing = tuple(float(np.linalg.norm(vector)) for vector in vectors)
        else:
            spacing = tuple(float(word) for word in values.get("spacings", "").split())
    except ValueError:
        return unknown
    return spacing if len(spacing) == axes else unknown
