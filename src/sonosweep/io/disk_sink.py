"""A file that fails once and quietly: HDF5 crashes the process if a full disk stops it.

The HDF5 library cannot close a file whose last bytes it could not write; Python then dies
of a segmentation fault, without a message. So the library writes through this object,
which keeps the first error to itself, drops everything after it, and tells the caller.
"""

import os
from pathlib import Path
from typing import Any


class DiskSink:
    """A binary file that remembers the first error instead of raising it.

    Buffers are of any type that :class:`memoryview` takes; h5py brings its own.

    Args:
        path: The file to write; it is emptied.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._error: OSError | None = None

    def __enter__(self) -> "DiskSink":
        """Open the file."""
        self._file = self._path.open("w+b", buffering=0)
        return self

    def __exit__(self, *_: object) -> None:
        """Close the file."""
        self._file.close()

    def check(self) -> None:
        """Raise the error that stopped the writing, if one did.

        Raises:
            OSError: What the system said, such as "No space left on device".
        """
        if self._error is not None:
            raise self._error

    def write(self, data: Any) -> int:
        """Write all of the bytes, or none once there was an error."""
        view = memoryview(data).cast("B")
        done = 0
        try:
            while self._error is None and done < len(view):
                done += self._file.write(view[done:]) or 0
        except OSError as error:
            self._error = error
        return len(view)

    def readinto(self, buffer: Any) -> int:
        """Fill the buffer from the file; what was dropped reads as zeros."""
        view = memoryview(buffer).cast("B")
        count = self._file.readinto(view) or 0
        view[count:] = bytes(len(view) - count)
        return len(view)

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Move to a place in the file."""
        return self._file.seek(offset, whence)

    def tell(self) -> int:
        """Return the place in the file."""
        return self._file.tell()

    def truncate(self, size: int | None = None) -> int:
        """Set the size of the file."""
        try:
            return self._file.truncate(size)
        except OSError as error:
            self._error = self._error or error
            return size or 0

    def read(self, size: int = -1) -> bytes:
        """Return bytes from the file."""
        return self._file.read(size) or b""

    def flush(self) -> None:
        """Do nothing: there is no buffer."""
