"""The arrays inside a MATLAB file, listed without reading them.

Files saved with ``-v7.3`` are HDF5, with MATLAB's axes in reverse and structs as groups.
Older ones (version 5 and 4) are read by SciPy, their structs by pymatreader.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import pymatreader
import scipy.io

from sonosweep.errors import FormatError, SonosweepError
from sonosweep.io.hdf5_access import (
    LARGEST_ARRAY_BYTES,
    first_line,
    frames_from_dataset,
    open_hdf5,
)
from sonosweep.io.lazy_index import read_indexed
from sonosweep.scan import Frames

INTEGERS = [f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)]
NUMERIC = ("double", "single", "logical", *INTEGERS)
LARGEST_OLD_BYTES = 2**32  # variables of older files end at 2 GiB; double that for structs
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
        path: The file.
        name: The variable, with dots for the fields of structs.
    """

    path: Path
    name: str

    def __call__(self) -> np.ndarray:
        """Return the variable as MATLAB shows it."""
        top, *fields = self.name.split(".")
        with explaining(self.path):
            if not fields:
                loaded = scipy.io.loadmat(self.path, variable_names=[top])[top]
                return np.asarray(loaded)
            value = pymatreader.read_mat(self.path, variable_names=[top])[top]
            for field in fields:
                value = value[field]
            return np.asarray(value)


class LoadedFrames:
    """Frames of an older file, which are read all at once when the first is asked for.

    Args:
        path: The file, for messages.
        shape: Frames, rows, columns and, for colour, channels.
        dtype: Type of a pixel.
        load: Returns the array as MATLAB shows it.
    """

    def __init__(self, path: Path, shape: tuple[int, ...], dtype: np.dtype, load: LoadOld) -> None:
        self._path, self._shape, self._dtype, self._load = path, shape, dtype, load
        self._array: np.ndarray | None = None

    @property
    def shape(self) -> tuple[int, ...]:
        """Frames, rows, columns and, for colour, channels."""
        return self._shape

    @property
    def dtype(self) -> np.dtype:
        """Type of a pixel."""
        return self._dtype

    def __len__(self) -> int:
        """Return the number of frames."""
        return self._shape[0]

    def __getitem__(self, index: int | slice) -> np.ndarray:
        """Return one frame, or the frames of a slice."""
        return read_indexed(index, self._shape, self._dtype, self._read)

    def __getstate__(self) -> dict:
        """Return everything but what was loaded."""
        return {**self.__dict__, "_array": None}

    def _read(self, frame: int) -> np.ndarray:
        if self._array is None:
            array = self._load()
            if np.iscomplexobj(array) or array.dtype.kind not in "buif":
                raise FormatError(f"the frames of '{self._path.name}' are no real numbers")
            if array.shape[-1] != len(self):
                raise FormatError(f"'{self._path.name}' changed after it was opened: open it again")
            self._array = array
        pixels = self._array[..., frame].reshape(self._shape[1:])
        return np.ascontiguousarray(pixels, dtype=self._dtype)


def list_old(file: Path, wanted: str | None) -> dict[str, Variable]:
    """Return the variables of an older file; fields only of the struct that was asked for."""
    with explaining(file):
        listed = scipy.io.whosmat(file)
    variables = {
        str(name): _old_variable(file, str(name), tuple(map(int, shape)), str(kind))
        for name, shape, kind in listed
    }
    if wanted is None or "." not in wanted or wanted.split(".")[0] not in variables:
        return variables
    if file.stat().st_size > LARGEST_OLD_BYTES:
        raise FormatError(f"'{file.name}' is too large to look into its structs: save it as -v7.3")
    top = wanted.split(".")[0]
    with explaining(file):
        struct = pymatreader.read_mat(file, variable_names=[top])[top]
    for name, value in _walk(struct, top, DEPTH):
        array = np.asarray(value)
        variables[name] = _old_variable(file, name, array.shape, array.dtype.name, array.dtype)
    return variables


def _walk(value: object, name: str, depth: int) -> Iterator[tuple[str, object]]:
    """Give the arrays of nested structs with dotted names."""
    if isinstance(value, dict) and depth:
        for field, inner in value.items():
            yield from _walk(inner, f"{name}.{field}", depth - 1)
    elif isinstance(value, np.ndarray | float | int):
        yield name, value


def _old_variable(
    file: Path, name: str, shape: tuple[int, ...], kind: str, dtype: np.dtype | None = None
) -> Variable:
    types = {"double": "float64", "single": "float32", "logical": "uint8"}
    numeric = kind in NUMERIC or (dtype is not None and dtype.kind in "buif")
    pixel = dtype if dtype is not None else np.dtype(types.get(kind, kind) if numeric else "u1")
    load = LoadOld(file.absolute(), name)

    def frames() -> Frames:
        if np.prod(shape, dtype=float) * pixel.itemsize > LARGEST_OLD_BYTES:
            raise FormatError(f"'{name}' in '{file.name}' is too large: save it as -v7.3")
        rest = () if len(shape) == 3 or shape[2] == 1 else (shape[2],)
        whole = (shape[-1], shape[0], shape[1], *rest)
        return LoadedFrames(file.absolute(), whole, pixel.newbyteorder("="), load)

    return Variable(shape, numeric, load, frames)


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
    kind = dataset.attrs.get("MATLAB_class", b"double")
    is_text = kind in (b"char", "char")

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
