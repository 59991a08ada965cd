"""A new HDF5 file that appears under its name only when it is complete."""

import os
from collections.abc import Iterator
from contextlib import contextmanager

import h5py

from sonosweep.errors import FormatError, SonosweepError
from sonosweep.io.atomic import write_beside
from sonosweep.io.disk_sink import DiskSink
from sonosweep.io.hdf5_access import DAMAGE, first_line


@contextmanager
def new_hdf5(path: str | os.PathLike) -> Iterator[tuple[h5py.File, DiskSink]]:
    """Give a file to fill, and the sink under it, which tells of a full disk when checked.

    Raises:
        FormatError: If HDF5 cannot hold what is written, or the disk is full.
    """
    with write_beside(path) as temporary:
        try:
            with DiskSink(temporary) as sink:
                with h5py.File(sink, "w") as file:
                    yield file, sink
                sink.check()
        except (SonosweepError, OSError):
            raise
        except DAMAGE as error:
            raise FormatError(f"cannot write '{path}': {first_line(error)}") from error
