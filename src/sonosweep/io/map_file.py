"""What a network shows of each step, in an HDF5 file that grows as it runs.

One dataset of half precision by map, ``/attention`` for example, with the steps along its
first axis: entry 0 belongs to the step from frame 0 to frame 1.
"""

import os
from collections.abc import Mapping
from pathlib import Path

import h5py
import torch
from jaxtyping import Float
from torch import Tensor

from sonosweep.errors import FormatError
from sonosweep.io.disk_sink import DiskSink
from sonosweep.io.hdf5_access import open_hdf5

FORMAT = "sonosweep maps 1"
STEPS_PER_CHUNK = 32


class MapFile:
    """A file of maps, open for writing until the end of a ``with`` block.

    Args:
        path: Where.

    Raises:
        FormatError: If it cannot be written.
        OSError: When the disk is full.
    """

    def __init__(self, path: str | os.PathLike) -> None:
        self.path = Path(path)
        try:
            self._sink = DiskSink(self.path).__enter__()
        except OSError as error:
            raise FormatError(f"cannot write '{path}': {error.strerror or error}") from error
        self._file = h5py.File(self._sink, "w")
        self._file.attrs["format"] = FORMAT

    def __enter__(self) -> "MapFile":
        """Return the file."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the file."""
        self._file.close()
        self._sink.__exit__(None, None, None)
        self._sink.check()

    def append(self, first: int, maps: Mapping[str, Float[Tensor, "steps ..."]]) -> None:
        """Write the maps of some steps.

        Args:
            first: Number of the first of these steps.
            maps: By name.
        """
        for name, values in maps.items():
            size = tuple(values.shape[1:])
            stored = self._file.get(name) or self._file.create_dataset(
                name,
                shape=(0, *size),
                maxshape=(None, *size),
                chunks=(STEPS_PER_CHUNK, *size),
                dtype="f2",
                compression="gzip",
                compression_opts=1,
            )
            stored.resize(first + len(values), axis=0)
            stored[first:] = values.numpy()
        self._sink.check()


def read_maps(path: str | os.PathLike, step: int) -> dict[str, Float[Tensor, "..."]]:
    """Return the maps of one step of a file that :class:`MapFile` wrote."""
    with open_hdf5(path) as file:
        return {name: torch.from_numpy(values[step]).float() for name, values in file.items()}
