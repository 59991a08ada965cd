"""What stands between a broken file and the person who gave it to us."""

from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike
from typing import Protocol, runtime_checkable

import numpy as np

from sonosweep.errors import FormatError, SonosweepError

# Deflate codes a run of 258 bytes in no fewer than 2 bits: zlib's stated limit is 1032 : 1.
LARGEST_DEFLATE_RATIO = 1032
CHUNK_BYTES = 1 << 22


@runtime_checkable
class Readable(Protocol):
    """A file, compressed or not."""

    def read(self, size: int, /) -> bytes:
        """Return up to ``size`` bytes, none at the end."""
        ...

    def seek(self, offset: int, whence: int = 0, /) -> int:
        """Go to a position and return it."""
        ...


@contextmanager
def refusing(path: str | PathLike, what: str) -> Iterator[None]:
    """Turn whatever goes wrong while reading ``path`` into one sentence that names it.

    Args:
        path: The file, as the user gave it.
        what: What it should have been, such as ``"a NIfTI volume"``.

    Raises:
        FormatError: Instead of any other exception.
    """
    try:
        yield
    except FormatError:
        raise
    except SonosweepError as error:
        raise FormatError(f"{error} in '{path}'") from error
    except OSError as error:
        raise FormatError(f"cannot read '{path}': {error.strerror or error}") from error
    except Exception as error:
        # The libraries for these formats do not say what they raise on broken bytes, and it
        # is nearly everything: KeyError, struct.error, RecursionError, MemoryError, ...
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise FormatError(f"cannot read '{path}' as {what}: {reason}") from error


def check_size(expected_bytes: int, stored_bytes: int, ratio: int, path: str | PathLike) -> None:
    """Refuse a header that promises more than the file can hold, before memory is taken.

    Args:
        expected_bytes: What the header says.
        stored_bytes: What the file has.
        ratio: By how much the compression can shrink at best; 1 for none.
        path: For the message.

    Raises:
        FormatError: If it cannot be.
    """
    if expected_bytes > ratio * stored_bytes:
        raise FormatError(
            f"'{path}' is cut short or damaged: its header promises {expected_bytes:,} bytes of"
            f" voxels, but the file holds only {stored_bytes:,}"
            f"{' compressed' if ratio > 1 else ''}"
        )


def read_array(stream: Readable, count: int, dtype: np.dtype, path: str | PathLike) -> np.ndarray:
    """Return ``count`` numbers from a stream, in this machine's byte order.

    Args:
        stream: At the first byte of them.
        count: How many; check it with :func:`check_size` first.
        dtype: As they are stored.
        path: For the message.

    Raises:
        FormatError: If the stream ends before.
    """
    values = np.empty(count, dtype)
    target = values.view(np.uint8).data
    done = 0
    while done < len(target):
        chunk = stream.read(min(CHUNK_BYTES, len(target) - done))
        if not chunk:
            raise FormatError(
                f"'{path}' is cut short: {done:,} of {len(target):,} bytes of voxels are there"
            )
        target[done : done + len(chunk)] = chunk
        done += len(chunk)
    if not dtype.isnative:
        values = values.byteswap(inplace=True).view(dtype.newbyteorder("="))
    return values
