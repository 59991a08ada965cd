"""The arrays inside a MATLAB file, listed without reading them.

Files saved with ``-v7.3`` are HDF5, with MATLAB's axes in reverse and structs as groups;
for older ones see :mod:`sonosweep.io.matlab_v5`.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np

from sonosweep.errors import FormatError, SonosweepError
from sonosweep.io.hdf5_access import (
    LARGEST_ARRAY_BYTES,
    first_line,
    frames_from_dataset,
    open_hdf5,
    read_text_attribute,
)
from sonosweep.io.matlab_v5 import (
    LARGEST_ELEMENT_BYTES,
    Element,
    OldArray,
    OldFile,
    open_old,
    parse_array,
    read_fields,
    read_numbers,
)
from sonosweep.scan import Frames, LazyFrames

DEPTH = 4  # structs in structs


@dataclass(frozen=True)
class Variable:
    """One array of a MATLAB file.

    Attributes:
        shape: As MATLAB shows it.
        numeric: Whether it holds real numbers.
        load: Returns it as MATLAB shows it.
        frames: Returns its frames, read when indexed if the file allows.
    """

    shape: tuple[int, ...]
    numeric: bool
    load: Callable[[], np.ndarray]
    frames: Callable[[], Frames]


@dataclass(frozen=True)
class LoadOld:
    """Reads one variable of an older file; an object, so that frames can be pickled.

    Attributes:
        file: The file.
        place: Where in the file the variable is.
        fields: Which field of it, if it is a struct.
    """

    file: OldFile
    place: int
    fields: tuple[str, ...] = ()

    def __call__(self) -> np.ndarray:
        """Return the variable as MATLAB shows it."""
        with explaining(self.file.path):
            order = self.file.order
            element: Element = self.file.body(self.place)
            for field in self.fields:
                element = dict(read_fields(element, parse_array(element, order), order))[field]
            return read_numbers(element, parse_array(element, order), order)


class LoadedFrames(LazyFrames):
    """Frames of an older file, which are read all at once when the first is asked for.

    Args:
        path: The file, for messages.
        shape: Frames, rows, columns and, for colour, channels.
        dtype: Type of a pixel.
        load: Returns the array as MATLAB shows it.
    """

    def __init__(self, path: Path, shape: tuple[int, ...], dtype: np.dtype, load: LoadOld) -> None:
        super().__init__(shape, dtype)
        self._path, self._load = path, load
        self._array: np.ndarray | None = None

    def __getstate__(self) -> dict:
        """Return everything but what was loaded."""
        return {**self.__dict__, "_array": None}

    def _read(self, frame: int) -> np.ndarray:
        if self._array is None:
            array = self._load()
            if array.shape[-1] != len(self):
                raise FormatError(f"'{self._path.name}' changed after it was opened: open it again")
            self._array = array
        pixels = self._array[..., frame].reshape(self._shape[1:])
        return np.ascontiguousarray(pixels, dtype=self._dtype)


def list_old(path: Path, wanted: str | None) -> dict[str, Variable]:
    """Return the variables of an older file; fields only of the struct that is asked for."""
    variables: dict[str, Variable] = {}
    with explaining(path):
        file = open_old(path.absolute())
        for array, place in file.variables():
            variables[array.name] = _old_variable(array, LoadOld(file, place))
            if wanted is not None and wanted.startswith(f"{array.name}."):
                fields = _walk(file.body(place), file.order, (), DEPTH)
                for names, field in fields:
                    name = ".".join((array.name, *names))
                    variables[name] = _old_variable(field, LoadOld(file, place, names))
    return variables


def _walk(
    element: Element, order: str, names: tuple[str, ...], depth: int
) -> Iterator[tuple[tuple[str, ...], OldArray]]:
    """Give the arrays of nested structs and the names that lead to them."""
    for name, inner in read_fields(element, parse_array(element, order), order):
        array = parse_array(inner, order)
        yield (*names, name), array
        if depth:
            yield from _walk(inner, order, (*names, name), depth - 1)


def _old_variable(array: OldArray, load: LoadOld) -> Variable:
    shape, dtype = array.shape, array.dtype

    def frames() -> Frames:
        assert dtype is not None  # only numbers are taken for frames
        if np.prod(shape, dtype=float) * dtype.itemsize > LARGEST_ELEMENT_BYTES:
            raise FormatError(f"'{load.file.path.name}' is damaged: {array.name} is too large")
        channels = () if len(shape) == 3 or shape[2] == 1 else (shape[2],)
        whole = (shape[-1], shape[0], shape[1], *channels)
        return LoadedFrames(load.file.path, whole, dtype, load)

    return Variable(shape, dtype is not None, load, frames)


def list_new(file: Path) -> dict[str, Variable]:
    """Return the variables of a ``-v7.3`` file, fields of structs with dotted names."""
    with open_hdf5(file) as opened:
        return dict(_list_group(file, opened, "", DEPTH))


def _list_group(
    file: Path, group: h5py.Group, prefix: str, depth: int
) -> Iterator[tuple[str, Variable]]:
    for name in group:
        node = group.get(name)
        if name.startswith("#") or node is None:
            continue
        if isinstance(node, h5py.Group) and depth:
            yield from _list_group(file, node, f"{prefix}{name}.", depth - 1)
        elif isinstance(node, h5py.Dataset) and node.shape is not None:
            yield f"{prefix}{name}", _new_variable(file, node)


def _new_variable(file: Path, dataset: h5py.Dataset) -> Variable:
    where = dataset.name
    is_text = read_text_attribute(dataset, "MATLAB_class") == "char"

    def load() -> np.ndarray:
        with open_hdf5(file) as opened:
            stored = opened[where]
            if stored.nbytes > LARGEST_ARRAY_BYTES:
                raise FormatError(f"'{where.lstrip('/')}' in '{file.name}' is too large")
            return np.asarray(stored[()]).T  # HDF5 keeps MATLAB's axes in reverse

    def frames() -> Frames:
        with open_hdf5(file) as opened:
            stored = opened[where]
            return frames_from_dataset(stored, (1, 0) if len(stored.shape) == 3 else (2, 1, 0))

    numeric = dataset.dtype.kind in "buif" and not is_text
    return Variable(dataset.shape[::-1], numeric, load, frames)


@contextmanager
def explaining(file: Path) -> Iterator[None]:
    """Turn whatever the MATLAB readers raise on damaged bytes into one sentence.

    Raises:
        FormatError: Instead of any other exception.
    """
    try:
        yield
    except SonosweepError:
        raise
    except Exception as error:
        raise FormatError(
            f"'{file.name}' is not a readable MATLAB file ({first_line(error)}); save it again"
        ) from error
