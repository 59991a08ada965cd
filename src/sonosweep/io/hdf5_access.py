"""What every HDF5 reader shares: frames that stay in the file, small arrays, clear errors.

h5py reports damage with almost any exception, and an HDF5 file can state sizes that it
does not hold. So every size is looked at before anything is read, and whatever h5py raises
comes out as one sentence.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np

from sonosweep.errors import FormatError, SonosweepError
from sonosweep.scan import LazyFrames

DAMAGE = (
    OSError,
    RuntimeError,
    LookupError,
    ValueError,
    TypeError,
    ArithmeticError,
    AttributeError,
    MemoryError,
    SystemError,
)
LARGEST_FRAME_BYTES = 2**28
LARGEST_CHUNK_BYTES = 2**29
LARGEST_ARRAY_BYTES = 2**28
LARGEST_FRAME_COUNT = 10_000_000  # more than four days at 25 frames/s


@contextmanager
def open_hdf5(path: str | os.PathLike) -> Iterator[h5py.File]:
    """Give the open file; everything that h5py raises inside becomes a FormatError.

    Raises:
        FormatError: If there is no such file, or it is not HDF5, or is damaged.
    """
    name = Path(path).name
    if not Path(path).is_file():
        raise FormatError(f"there is no file '{path}'")
    try:
        with h5py.File(path, "r") as file:
            yield file
    except SonosweepError:
        raise
    except DAMAGE as error:
        raise FormatError(
            f"'{name}' is not a readable HDF5 file ({first_line(error)}); copy or export it again"
        ) from error


def first_line(error: BaseException) -> str:
    """Return what an exception says, in one line of a length that fits a message."""
    text = str(error.args[0] if isinstance(error, KeyError) and error.args else error)
    lines = text.strip().splitlines() or [type(error).__name__]
    return lines[0][:160]


def hdf5_holds(path: str | os.PathLike, *names: str) -> bool:
    """Say whether a file is HDF5 and has data sets of these names at its root."""
    try:
        with open_hdf5(path) as file:
            return all(isinstance(file.get(name), h5py.Dataset) for name in names)
    except SonosweepError:
        return False


def get_dataset(group: h5py.Group, name: str) -> h5py.Dataset:
    """Return a data set that holds real numbers.

    Raises:
        FormatError: If there is none of this name; the message names those there are.
    """
    node = group.get(name)
    file = Path(group.file.filename).name
    if not isinstance(node, h5py.Dataset):
        if name in list(group):
            raise FormatError(f"'{name}' in '{file}' is damaged or no data set")
        known = ", ".join(list(group)[:12]) or "nothing"
        raise FormatError(f"'{file}' has no data set '{name}'; it holds {known}")
    if node.dtype.kind not in "buif" or node.shape is None:
        raise FormatError(f"'{name}' in '{file}' must hold numbers, but is of type {node.dtype}")
    return node


def read_array(
    group: h5py.Group, name: str, shape: tuple[int | None, ...], frames: int | None = None
) -> np.ndarray:
    """Return a small data set as float64.

    Args:
        group: Where it is.
        name: What it is called.
        shape: What its shape must be; ``None`` for an axis of any size.
        frames: How many frames there are, for a message about counts.

    Raises:
        FormatError: If there is none, it is no array of numbers, or its shape differs.
    """
    dataset = get_dataset(group, name)
    file = Path(group.file.filename).name
    if frames is not None and dataset.shape[:1] and dataset.shape[0] != frames:
        raise FormatError(f"{frames} frames but {dataset.shape[0]} '{name}' in '{file}'")
    fits = len(dataset.shape) == len(shape) and all(
        expected in (None, actual) for expected, actual in zip(shape, dataset.shape, strict=True)
    )
    if not fits or dataset.nbytes > LARGEST_ARRAY_BYTES:
        wanted = " x ".join("any" if size is None else str(size) for size in shape)
        raise FormatError(
            f"'{name}' in '{file}' must have the shape {wanted}, but has {dataset.shape}"
        )
    return np.asarray(dataset[()]).astype(np.float64)


def read_text_attribute(node: h5py.HLObject, name: str) -> str | None:
    """Return an attribute that holds text of a fixed length, ``None`` for any other.

    Text of variable length is not read: where the file is damaged, HDF5 follows its
    address to anywhere in memory and the process dies.
    """
    if name not in node.attrs:
        return None
    attribute = node.attrs.get_id(name)
    if attribute.dtype.kind != "S" or attribute.shape != ():
        return None
    return bytes(np.asarray(node.attrs[name])[()]).decode("utf-8")


def read_number_attribute(node: h5py.HLObject, name: str, count: int) -> list[float]:
    """Return an attribute that holds so many numbers.

    Raises:
        FormatError: If there is none, or it holds something else.
    """
    file = Path(node.file.filename).name
    if name not in node.attrs:
        raise FormatError(f"'{node.name}' in '{file}' has no attribute '{name}'")
    attribute = node.attrs.get_id(name)
    if attribute.dtype.kind not in "buif" or np.prod(attribute.shape, dtype=float) != count:
        raise FormatError(
            f"attribute '{name}' of '{node.name}' in '{file}' must be {count} numbers"
        )
    return [float(value) for value in np.ravel(node.attrs[name])]


class HDF5Frames(LazyFrames):
    """Frames of an HDF5 data set, read when indexed; can be pickled and used after a fork.

    Args:
        path: The file.
        dataset: Name of the data set; its first axis counts frames.
        shape: Frames, rows, columns and, for colour, channels.
        dtype: Type of a pixel.
        axes: The order in which the axes of a stored frame give rows, columns and
            channels; ``None`` if they are stored so.
    """

    def __init__(
        self,
        path: Path,
        dataset: str,
        shape: tuple[int, ...],
        dtype: np.dtype,
        axes: tuple[int, ...] | None = None,
    ) -> None:
        super().__init__(shape, dtype)
        self._path, self._name, self._axes = path, dataset, axes
        self._open: tuple[int, h5py.Dataset] | None = None

    def __getstate__(self) -> dict:
        """Return everything but the open file, which another process cannot use."""
        return {**self.__dict__, "_open": None}

    def _read(self, frame: int) -> np.ndarray:
        try:
            stored = np.asarray(self._dataset()[frame])
        except SonosweepError:
            raise
        except DAMAGE as error:
            raise FormatError(
                f"frame {frame} of '{self._path.name}' cannot be read ({first_line(error)})"
            ) from error
        pixels = stored if self._axes is None else stored.transpose(self._axes)
        return np.ascontiguousarray(pixels.reshape(self._shape[1:]), dtype=self._dtype)

    def _dataset(self) -> h5py.Dataset:
        """Return the data set, opened once per process: HDF5 does not survive a fork."""
        if self._open is None or self._open[0] != os.getpid():
            dataset = h5py.File(self._path, "r")[self._name]
            if dataset.shape[0] != len(self):
                raise FormatError(f"'{self._path.name}' changed after it was opened: open it again")
            self._open = (os.getpid(), dataset)
        return self._open[1]


def frames_from_dataset(
    dataset: h5py.Dataset,
    axes: tuple[int, ...] | None = None,
    channels: tuple[int, ...] = (3, 4),
) -> HDF5Frames:
    """Return the frames of a data set without reading them.

    Args:
        dataset: Its first axis counts frames.
        axes: As in :class:`HDF5Frames`. A single channel is dropped.
        channels: How many are allowed besides one.

    Raises:
        FormatError: If it has no frames, too large ones, or no numbers.
    """
    path = Path(dataset.file.filename)
    what = f"'{dataset.name.lstrip('/')}' in '{path.name}'"
    if (
        dataset.shape is None
        or len(dataset.shape) not in (3, 4)
        or dataset.dtype.kind not in "buif"
    ):
        raise FormatError(
            f"{what} must hold frames of numbers (frames, rows, columns), but is of shape"
            f" {dataset.shape} and type {dataset.dtype}"
        )
    stored = dataset.shape[1:]
    size = tuple(stored[axis] for axis in axes) if axes is not None else stored
    if len(size) == 3 and size[2] == 1:
        size = size[:2]
    _check_sizes(what, dataset, size, channels)
    dtype = dataset.dtype.newbyteorder("=")
    return HDF5Frames(path.resolve(), dataset.name, (dataset.shape[0], *size), dtype, axes)


def _check_sizes(
    what: str, dataset: h5py.Dataset, size: tuple[int, ...], channels: tuple[int, ...]
) -> None:
    item = dataset.dtype.itemsize
    if dataset.shape[0] < 1 or min(size) < 1:
        raise FormatError(f"{what} holds no pixels: its shape is {dataset.shape}")
    if len(size) == 3 and size[2] not in channels:
        allowed = f"{', '.join(str(n) for n in (1, *channels[:-1]))} or {channels[-1]}"
        raise FormatError(f"{what} must have {allowed} channels, but its shape is {dataset.shape}")
    if dataset.shape[0] > LARGEST_FRAME_COUNT or np.prod(size, dtype=float) * item > (
        LARGEST_FRAME_BYTES
    ):
        raise FormatError(f"{what} is too large to be a sweep: its shape is {dataset.shape}")
    if dataset.chunks and np.prod(dataset.chunks, dtype=float) * item > LARGEST_CHUNK_BYTES:
        raise FormatError(
            f"{what} is stored in chunks of {dataset.chunks}, so that one frame cannot be read"
            " alone: store it again with chunks of one frame"
        )
