"""Channel samples that stay in an HDF5 file, in whatever order it stores its axes."""

import os
from collections.abc import Sequence
from pathlib import Path

import h5py
import numpy as np

from sonosweep.errors import FormatError, SonosweepError
from sonosweep.io.hdf5_access import (
    DAMAGE,
    LARGEST_CHUNK_BYTES,
    LARGEST_FRAME_COUNT,
    first_line,
)
from sonosweep.scan import LazyFrames

AXES = ("frames", "transmits", "elements", "samples")
LARGEST_CHANNEL_FRAME_BYTES = 2**30  # 75 angles of 256 elements and 4096 samples in float64: 0.6 GB


class HDF5ChannelFrames(LazyFrames):
    """Samples ``(frames, transmits, elements, samples)`` of an HDF5 file, read when indexed.

    They can be pickled and used after a fork.

    Args:
        path: The file.
        parts: Names of the data sets: one, or the real and the imaginary part.
        shape: Frames, transmits, elements, samples.
        dtype: Type of a sample.
        order: For each stored axis which of the four it is, or the one index to take of it.
        turns: Factor for each transmit.
    """

    def __init__(
        self,
        path: Path,
        parts: tuple[str, ...],
        shape: tuple[int, ...],
        dtype: np.dtype,
        order: tuple[str | int, ...],
        turns: np.ndarray | None = None,
    ) -> None:
        super().__init__(shape, dtype)
        self._path, self._parts, self._order, self._turns = path, parts, order, turns
        self._open: tuple[int, list[h5py.Dataset]] | None = None

    def __getstate__(self) -> dict:
        """Return everything but the open file, which another process cannot use."""
        return {**self.__dict__, "_open": None}

    def _read(self, frame: int) -> np.ndarray:
        where = tuple(
            frame if axis == "frames" else axis if isinstance(axis, int) else slice(None)
            for axis in self._order
        )
        kept = [axis for axis in self._order if isinstance(axis, str) and axis != "frames"]
        axes = [kept.index(axis) for axis in AXES if axis in kept]
        try:
            stored = [np.asarray(part[where]) for part in self._datasets()]
        except SonosweepError:
            raise
        except DAMAGE as error:
            raise FormatError(
                f"frame {frame} of '{self._path.name}' cannot be read ({first_line(error)})"
            ) from error
        samples = np.empty(self._shape[1:], self._dtype)
        target = samples.reshape([self._shape[AXES.index(name)] for name in AXES if name in kept])
        if len(stored) == 1:
            target[...] = stored[0].transpose(axes)
        else:
            target.real, target.imag = (part.transpose(axes) for part in stored)
        if self._turns is not None:
            samples *= self._turns[:, None, None]
        return samples

    def _datasets(self) -> list[h5py.Dataset]:
        """Return the data sets, opened once per process: HDF5 does not survive a fork."""
        if self._open is None or self._open[0] != os.getpid():
            file = h5py.File(self._path, "r")
            self._open = (os.getpid(), [file[name] for name in self._parts])
        return self._open[1]


def channel_frames(
    datasets: Sequence[h5py.Dataset],
    order: tuple[str | int, ...],
    turns: np.ndarray | None = None,
) -> HDF5ChannelFrames:
    """Return channel samples without reading them.

    Args:
        datasets: One of real or complex numbers, or the real and the imaginary part.
        order: For each stored axis which of ``"frames"``, ``"transmits"``, ``"elements"`` and
            ``"samples"`` it is, or the one index to take of it. An absent axis has length 1.
        turns: Factor for each transmit, of complex samples.

    Raises:
        FormatError: If they hold no numbers, have other axes, or are too large.
    """
    first = datasets[0]
    path = Path(first.file.filename)
    what = f"'{first.name.lstrip('/')}' in '{path.name}'"
    named = [axis if isinstance(axis, str) else f"index {axis}" for axis in order]
    kinds = "buifc" if len(datasets) == 1 else "buif"
    for dataset in datasets:
        if dataset.shape is None or dataset.dtype.kind not in kinds:
            raise FormatError(f"{what} must hold numbers, but is of type {dataset.dtype}")
        if len(dataset.shape) != len(order) or dataset.shape != first.shape:
            raise FormatError(
                f"{what} must have the axes {', '.join(named)}, but its shape is {dataset.shape}"
            )
    sizes = {axis: first.shape[k] for k, axis in enumerate(order) if isinstance(axis, str)}
    shape = tuple(sizes.get(axis, 1) for axis in AXES)
    dtype = first.dtype.newbyteorder("=")
    if len(datasets) == 2:
        dtype = np.result_type(first.dtype, np.complex64)
    check_sizes(what, shape, dtype)
    if first.chunks and np.prod(first.chunks, dtype=float) * first.dtype.itemsize > (
        LARGEST_CHUNK_BYTES
    ):
        raise FormatError(
            f"{what} is stored in chunks of {first.chunks}, so that one frame cannot be read"
            " alone: store it again with smaller chunks"
        )
    if turns is not None:
        turns = turns.astype(np.complex64) if np.any(turns != 1) else None
    if turns is not None and len(turns) != shape[1]:
        raise FormatError(f"{what} has {shape[1]} transmits, but {len(turns)} are described")
    parts = tuple(dataset.name for dataset in datasets)
    return HDF5ChannelFrames(path.resolve(), parts, shape, np.dtype(dtype), order, turns)


def check_sizes(what: str, shape: tuple[int, ...], dtype: np.dtype) -> None:
    """Refuse samples that are none, or too large to be those of a sweep.

    Args:
        what: What to call them in the message.
        shape: Frames, transmits, elements, samples.
        dtype: Type of a sample.

    Raises:
        FormatError: If so.
    """
    if min(shape) < 1:
        raise FormatError(f"{what} holds no samples: it has {_told(shape)}")
    largest = np.prod(shape[1:], dtype=float) * dtype.itemsize
    if shape[0] > LARGEST_FRAME_COUNT or largest > LARGEST_CHANNEL_FRAME_BYTES:
        raise FormatError(f"{what} is too large to be a sweep: it has {_told(shape)}")


def _told(shape: tuple[int, ...]) -> str:
    return ", ".join(f"{size} {axis}" for size, axis in zip(shape, AXES, strict=True))
