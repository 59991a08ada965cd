"""Structs, cells, text and numbers of a MATLAB file, whatever its version.

Both kinds of file answer the same questions: version 5 is read whole, one variable at a time,
when that variable is asked for; ``-v7.3`` is HDF5, in which structs are groups, and arrays of
structs and cells hold references.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import Literal

import h5py
import numpy as np

from sonosweep.errors import FormatError
from sonosweep.io.hdf5_access import LARGEST_ARRAY_BYTES, open_hdf5, read_text_attribute
from sonosweep.io.matlab_v5 import (
    CELL_CLASS,
    CLASSES,
    STRUCT_CLASS,
    TEXT_CLASS,
    Element,
    OldFile,
    open_old,
    parse_array,
    read_cells,
    read_numbers,
    read_structs,
    read_text,
)
from sonosweep.io.matlab_variables import explaining

Kind = Literal["numbers", "text", "struct", "cell", "other"]
MOST_ITEMS = 1_000_000  # of an array of structs
LONGEST_TEXT = 1_000_000


class MatNode(ABC):
    """One array of a MATLAB file.

    Attributes:
        name: How to reach it, such as ``"Receive(3).startSample"``.
        kind: What it holds.
        shape: As MATLAB shows it.
    """

    name: str
    kind: Kind
    shape: tuple[int, ...]

    @property
    def count(self) -> int:
        """How many structs, cells or numbers there are."""
        return math.prod(self.shape)

    @abstractmethod
    def field(self, name: str, item: int = 0) -> "MatNode | None":
        """Return a field of one struct of an array of structs; ``None`` if it has none."""

    @abstractmethod
    def cell(self, item: int) -> "MatNode | None":
        """Return what a cell holds; ``None`` for an empty one."""

    @abstractmethod
    def numbers(self) -> np.ndarray:
        """Return real numbers, as MATLAB shows them."""

    @abstractmethod
    def text(self) -> str:
        """Return a row of characters."""

    def _refuse(self, wanted: str) -> FormatError:
        shape = " x ".join(map(str, self.shape))
        return FormatError(f"{self.name} must hold {wanted}, but is {self.kind} ({shape})")

    def _check_item(self, item: int) -> None:
        if not 0 <= item < self.count <= MOST_ITEMS:
            raise FormatError(f"{self.name} has {self.count} entries, there is no {item + 1}")


class OldNode(MatNode):
    """An array of a version-5 file, in memory.

    Args:
        name: How to reach it.
        element: Its bytes.
        order: Byte order.
    """

    def __init__(self, name: str, element: Element, order: str) -> None:
        self.name, self._element, self._order = name, element, order
        self._array = parse_array(element, order)
        self.shape = self._array.shape
        self.kind = self._kind()

    def field(self, name: str, item: int = 0) -> MatNode | None:
        """Return a field of one struct of an array of structs; ``None`` if it has none."""
        if self.kind != "struct":
            raise self._refuse("a struct")
        self._check_item(item)
        element = self._structs[item].get(name)
        return None if element is None else self._child(f"{self._at(item)}.{name}", element)

    def cell(self, item: int) -> MatNode | None:
        """Return what a cell holds; ``None`` for an empty one."""
        if self.kind != "cell":
            raise self._refuse("cells")
        self._check_item(item)
        element = self._cells[item]
        return self._child(f"{self.name}{{{item + 1}}}", element) if len(element) else None

    def numbers(self) -> np.ndarray:
        """Return real numbers, as MATLAB shows them."""
        if self.kind != "numbers":
            raise self._refuse("real numbers")
        return read_numbers(self._element, self._array, self._order)

    def text(self) -> str:
        """Return a row of characters."""
        if self.kind != "text" or self.count > LONGEST_TEXT:
            raise self._refuse("text")
        return read_text(self._element, self._array, self._order) if self.count else ""

    @cached_property
    def _structs(self) -> list[dict[str, Element]]:
        return list(read_structs(self._element, self._array, self._order))

    @cached_property
    def _cells(self) -> list[Element]:
        return list(read_cells(self._element, self._array, self._order))

    def _kind(self) -> Kind:
        number = self._array.class_number
        if number in CLASSES and not self._array.is_complex:
            return "numbers"
        known: dict[int, Kind] = {CELL_CLASS: "cell", STRUCT_CLASS: "struct", TEXT_CLASS: "text"}
        return known.get(number, "other")

    def _at(self, item: int) -> str:
        return self.name if self.count == 1 else f"{self.name}({item + 1})"

    def _child(self, name: str, element: Element) -> "OldNode":
        return OldNode(name, element, self._order)


class NewNode(MatNode):
    """An array of a ``-v7.3`` file that is open.

    Args:
        name: How to reach it.
        item: Its group or data set.
    """

    def __init__(self, name: str, item: h5py.Group | h5py.Dataset) -> None:
        self.name, self.item = name, item
        self._references: dict[str, np.ndarray] = {}
        self._class = read_text_attribute(item, "MATLAB_class") or ""
        self.shape, self.kind = self._shape(), self._kind()

    def field(self, name: str, item: int = 0) -> MatNode | None:
        """Return a field of one struct of an array of structs; ``None`` if it has none."""
        if self.kind != "struct":
            raise self._refuse("a struct")
        self._check_item(item)
        if self._is_array:
            if name not in self._references and name in self.item:
                self._references[name] = _read_references(self.item[name])
            places = self._references.get(name)
            where = f"{self.name}({item + 1}).{name}"
            return None if places is None else self._follow(places, item, where)
        found = self.item.get(name)
        return None if found is None else NewNode(f"{self.name}.{name}", found)

    def cell(self, item: int) -> MatNode | None:
        """Return what a cell holds; ``None`` for an empty one."""
        if self.kind != "cell":
            raise self._refuse("cells")
        self._check_item(item)
        node = self._follow(_read_references(self.item), item, f"{self.name}{{{item + 1}}}")
        return node if node.count else None

    def numbers(self) -> np.ndarray:
        """Return real numbers, as MATLAB shows them."""
        if self.kind != "numbers" or (self.count and self.item.nbytes > LARGEST_ARRAY_BYTES):
            raise self._refuse("real numbers")
        if self.count == 0:
            return np.zeros(self.shape)
        return np.asarray(self.item[()]).T  # HDF5 keeps MATLAB's axes in reverse

    def text(self) -> str:
        """Return a row of characters."""
        if self.kind != "text" or self.count > LONGEST_TEXT:
            raise self._refuse("text")
        if self.count == 0:
            return ""
        return "".join(map(chr, np.asarray(self.item[()]).T.ravel().tolist()))

    @cached_property
    def _is_array(self) -> bool:
        """Whether the group is an array of structs: references, which are no cells."""
        members = [self.item.get(name) for name in list(self.item)[:4]]
        return bool(members) and all(
            _holds_references(member) and "MATLAB_class" not in member.attrs for member in members
        )

    def _shape(self) -> tuple[int, ...]:
        if isinstance(self.item, h5py.Group):
            first = self.item.get(next(iter(self.item), ""))
            return first.shape[::-1] if self._is_array else (1, 1)
        if "MATLAB_empty" in self.item.attrs or self.item.shape is None:
            return (0, 0)
        return self.item.shape[::-1]

    def _kind(self) -> Kind:
        if isinstance(self.item, h5py.Group):
            return "struct"
        if self._class == "cell" or _holds_references(self.item):
            return "cell"
        if self._class == "char":
            return "text"
        return "numbers" if self.item.dtype.kind in "buif" else "other"

    def _follow(self, places: np.ndarray, item: int, name: str) -> "NewNode":
        if item >= len(places):
            raise FormatError(f"{name} is damaged: there are {len(places)} entries")
        return NewNode(name, self.item.file[places[item]])


def _read_references(dataset: h5py.Dataset) -> np.ndarray:
    """Return the references of an array of structs or cells, in MATLAB's order."""
    if not _holds_references(dataset) or math.prod(dataset.shape) > MOST_ITEMS:
        raise FormatError(f"'{dataset.name}' is damaged: it should hold references")
    return np.asarray(dataset[()]).ravel()  # HDF5 keeps MATLAB's axes in reverse


def _holds_references(item: object) -> bool:
    return (
        isinstance(item, h5py.Dataset)
        and item.shape is not None
        and h5py.check_ref_dtype(item.dtype) is h5py.Reference
    )


class _OldVariables(Mapping[str, MatNode]):
    """The variables of a version-5 file, each read when it is first asked for."""

    def __init__(self, file: OldFile) -> None:
        self._file = file
        self._places = {array.name: place for array, place in file.variables()}
        self._read: dict[str, OldNode] = {}

    def __getitem__(self, name: str) -> MatNode:
        if name not in self._read:
            body = memoryview(self._file.body(self._places[name]))
            self._read[name] = OldNode(name, body, self._file.order)
        return self._read[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._places)

    def __len__(self) -> int:
        return len(self._places)


@contextmanager
def open_mat(path: Path) -> Iterator[Mapping[str, MatNode]]:
    """Give the variables of a MATLAB file of any version since 5, by name.

    Whatever goes wrong inside becomes one sentence; nodes are of use only inside.

    Raises:
        FormatError: If there is no such file, or it is damaged.
    """
    if not path.is_file():
        raise FormatError(f"there is no file '{path}'")
    with explaining(path):
        if not h5py.is_hdf5(str(path)):
            yield _OldVariables(open_old(path.absolute()))
            return
        with open_hdf5(path) as file:
            yield {
                name: NewNode(name, item)
                for name in file
                if not name.startswith("#") and (item := file.get(name)) is not None
            }
