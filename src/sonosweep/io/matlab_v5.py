"""Arrays and structs of MATLAB's version-5 files, checked byte by byte.

SciPy's reader trusts the sizes that a file states, and a damaged one ends the process
without a word. This one reads numbers and structs, which is all that a scan needs, and
believes nothing: it never reads past an element, nor unpacks more than it states.

References:
    MathWorks, "MAT-File Format", chapter 1, "Level 5 MAT-File Format".
"""

import math
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sonosweep.errors import FormatError

HEADER_BYTES = 128
MATRIX, COMPRESSED = 14, 15
STORED_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8"}
STORED_TYPES |= {12: "i8", 13: "u8"}
CELL_CLASS, STRUCT_CLASS, TEXT_CLASS = 1, 2, 4
TEXT_TYPES = {1: "latin-1", 2: "latin-1", 4: "utf-16", 16: "utf-8", 17: "utf-16"}
# Class of an array, and the type of its numbers once read.
CLASSES = {6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4"}
CLASSES |= {14: "i8", 15: "u8"}
COMPLEX_FLAG = 0x08
START_BYTES = 4096  # holds flags, axes and name of any array
LARGEST_ELEMENT_BYTES = 2**31
LARGEST_DEFLATE_RATIO = 1032  # zlib's stated limit
MOST_ELEMENTS = 10_000
MOST_AXES = 32

Element = bytes | memoryview
"""The bytes of an array in a file; views save copies."""


@dataclass(frozen=True)
class OldArray:
    """What the start of an element tells of the array in it.

    Attributes:
        name: Of the variable; ``""`` in a struct.
        shape: As MATLAB shows it.
        class_number: MATLAB's class of the array.
        is_complex: Whether there is an imaginary part.
        body: Where in the element the numbers or fields begin.
    """

    name: str
    shape: tuple[int, ...]
    class_number: int
    is_complex: bool
    body: int

    @property
    def dtype(self) -> np.dtype | None:
        """Type of the numbers; ``None`` if they are not real numbers."""
        known = self.class_number in CLASSES and not self.is_complex
        return np.dtype(CLASSES[self.class_number]) if known else None


@dataclass(frozen=True)
class OldFile:
    """A version-5 file.

    Attributes:
        path: Where it is.
        order: Byte order, ``"<"`` or ``">"``.
    """

    path: Path
    order: str

    def variables(self) -> Iterator[tuple[OldArray, int]]:
        """Give each variable and the place of its element; nothing large is read."""
        size = self.path.stat().st_size
        at = HEADER_BYTES
        for _ in range(MOST_ELEMENTS):
            if at + 8 > size:
                return
            kind, length, start = self._element(at)
            if start + length > size:
                raise FormatError(
                    f"'{self.path.name}' is cut short: a variable ends after the file"
                )
            if kind in (MATRIX, COMPRESSED) and length:
                yield self._start_of(at), at
            at = start + length
            if kind != COMPRESSED:
                at += -length % 8
        raise FormatError(f"'{self.path.name}' claims to hold more than {MOST_ELEMENTS} variables")

    def body(self, at: int) -> bytes:
        """Return a variable's whole element, unpacked."""
        kind, length, start = self._element(at)
        with self.path.open("rb") as stream:
            stream.seek(start)
            stored = stream.read(min(length, LARGEST_ELEMENT_BYTES))
        if kind != COMPRESSED:
            return stored
        unpacker = zlib.decompressobj()
        tag = unpacker.decompress(stored, 8)
        _, inner = self._matrix_tag(tag)
        if inner > min(LARGEST_DEFLATE_RATIO * max(length, 1), LARGEST_ELEMENT_BYTES):
            raise FormatError(f"a variable of '{self.path.name}' claims {inner:,} bytes")
        return unpacker.decompress(unpacker.unconsumed_tail, inner)

    def _element(self, at: int) -> tuple[int, int, int]:
        """Return type, length and start of the data of a top-level element."""
        with self.path.open("rb") as stream:
            stream.seek(at)
            kind, length = struct.unpack(self.order + "II", stream.read(8))
        return kind, length, at + 8

    def _matrix_tag(self, tag: bytes) -> tuple[int, int]:
        kind, length = struct.unpack(self.order + "II", tag)
        if kind != MATRIX:
            raise FormatError(f"'{self.path.name}' is damaged: packed data is no array")
        return kind, length

    def _start_of(self, at: int) -> OldArray:
        kind, length, start = self._element(at)
        with self.path.open("rb") as stream:
            stream.seek(start)
            stored = stream.read(min(length, START_BYTES))
        if kind == COMPRESSED:
            unpacked = zlib.decompressobj().decompress(stored, START_BYTES)
            self._matrix_tag(unpacked[:8])
            stored = unpacked[8:]
        return parse_array(stored, self.order)


def open_old(path: Path) -> OldFile:
    """Return a version-5 file after a look at its header.

    Raises:
        FormatError: If it is of another version or no MATLAB file.
    """
    with path.open("rb") as stream:
        header = stream.read(HEADER_BYTES)
    order = {b"IM": "<", b"MI": ">"}.get(header[126:128])
    if order is None or struct.unpack(order + "H", header[124:126])[0] != 0x0100:
        raise FormatError(
            f"'{path.name}' is no MATLAB file of version 5 or later: save it with -v7 or -v7.3"
        )
    return OldFile(path, order)


def parse_array(element: Element, order: str) -> OldArray:
    """Return what the start of an element tells; nothing behind that is looked at.

    Raises:
        FormatError: If it is no array.
    """
    _, flags, at = _part(element, 0, order)
    _, axes, at = _part(element, at, order)
    _, name, at = _part(element, at, order)
    if len(flags) < 8 or not 8 <= len(axes) <= 4 * MOST_AXES or len(axes) % 4:
        raise FormatError("an array states no class or no shape")
    (word,) = struct.unpack(order + "I", flags[:4])
    shape = struct.unpack(f"{order}{len(axes) // 4}i", axes)
    if min(shape) < 0:
        raise FormatError(f"an array has the shape {shape}")
    text = bytes(name).decode("utf-8", "replace").rstrip("\0")
    return OldArray(text, shape, word & 0xFF, bool(word >> 8 & COMPLEX_FLAG), at)


def read_numbers(element: Element, array: OldArray, order: str) -> np.ndarray:
    """Return the numbers of an array as MATLAB shows them.

    Raises:
        FormatError: If there are not as many as the shape needs.
    """
    kind, data, _ = _part(element, array.body, order)
    if array.dtype is None or kind not in STORED_TYPES:
        raise FormatError(f"'{array.name}' does not hold real numbers")
    numbers = np.frombuffer(data, np.dtype(order + STORED_TYPES[kind]))
    if float(len(numbers)) != np.prod(array.shape, dtype=float):
        raise FormatError(
            f"'{array.name}' has the shape {array.shape}, but there are {len(numbers)} numbers"
        )
    # MATLAB stores numbers in the smallest type that holds them.
    return numbers.astype(array.dtype).reshape(array.shape, order="F")


def read_fields(element: Element, array: OldArray, order: str) -> Iterator[tuple[str, Element]]:
    """Give the names and elements of the fields of a 1 x 1 struct, none for other arrays.

    Raises:
        FormatError: If the names are damaged.
    """
    if array.class_number == STRUCT_CLASS and all(size == 1 for size in array.shape):
        for fields in read_structs(element, array, order):
            yield from fields.items()


def read_structs(element: Element, array: OldArray, order: str) -> Iterator[dict[str, Element]]:
    """Give the elements of the fields of each struct of an array of structs; empty ones lack.

    Raises:
        FormatError: If the names are damaged, or there are fewer structs than stated.
    """
    _, width, at = _part(element, array.body, order)
    _, names, at = _part(element, at, order)
    if len(width) != 4:
        raise FormatError("a struct does not tell how long its field names are")
    (length,) = struct.unpack(order + "i", width)
    if not 0 < length <= 256 or len(names) // length > MOST_ELEMENTS:
        raise FormatError(f"a struct has field names of length {length}")
    known = [_text(bytes(names[k : k + length])) for k in range(0, len(names), length)]
    for _ in range(math.prod(array.shape) if known else 0):
        fields = {}
        for name in known:
            kind, inner, at = _part(element, at, order)
            if kind == MATRIX and len(inner):
                fields[name] = inner
        yield fields


def read_cells(element: Element, array: OldArray, order: str) -> Iterator[Element]:
    """Give the element of each cell, empty for an empty one.

    Raises:
        FormatError: If there are fewer than stated.
    """
    at = array.body
    for _ in range(math.prod(array.shape)):
        _, inner, at = _part(element, at, order)
        yield inner


def read_text(element: Element, array: OldArray, order: str) -> str:
    """Return a row of characters.

    Raises:
        FormatError: If it is none.
    """
    kind, data, _ = _part(element, array.body, order)
    if array.class_number != TEXT_CLASS or kind not in TEXT_TYPES:
        raise FormatError(f"'{array.name}' does not hold text")
    encoding = TEXT_TYPES[kind]
    if encoding == "utf-16":
        encoding = "utf-16-le" if order == "<" else "utf-16-be"
    return bytes(data).decode(encoding, "replace")


def _text(stored: bytes) -> str:
    return stored.split(b"\0")[0].decode("utf-8", "replace")


def _part(element: Element, at: int, order: str) -> tuple[int, Element, int]:
    """Return type and data of a part of an element, and where the next one begins."""
    if at + 8 > len(element):
        raise FormatError("an array is cut short")
    kind, length = struct.unpack_from(order + "II", element, at)
    if kind >> 16:
        # Up to four bytes of data share the eight bytes of the tag.
        length, kind = kind >> 16, kind & 0xFFFF
        if length > 4:
            raise FormatError("an array is damaged")
        return kind, element[at + 4 : at + 4 + length], at + 8
    if at + 8 + length > len(element):
        raise FormatError("an array is cut short")
    return kind, element[at + 8 : at + 8 + length], at + 8 + length + -length % 8
