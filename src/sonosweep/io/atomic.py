"""Output files that are either whole or not there."""

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sonosweep.errors import FormatError


@contextmanager
def write_beside(path: str | os.PathLike) -> Iterator[Path]:
    """Give a temporary path in the same folder; rename it to ``path`` if all goes well.

    Whatever goes wrong inside the block, interruption included, leaves ``path`` as it was
    and no temporary file behind. The temporary name ends like ``path``, for libraries that
    look at the suffix.

    Args:
        path: Where the file is to be in the end; its folder is made.

    Raises:
        FormatError: If the folder cannot be written to, or the disk is full.
    """
    target = Path(path)
    temporary = None
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(
            dir=target.parent, prefix=".writing-", suffix="".join(target.suffixes[-2:])
        )
        os.close(handle)
        temporary = Path(name)
        yield temporary
        # mkstemp makes files that only their owner can read; give what umask would have.
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)
        temporary.replace(target)
    except OSError as error:
        raise FormatError(f"cannot write '{target}': {error.strerror or error}") from error
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)
