"""Output files that are either whole or not there."""

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
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
    # Named before it is made, so that an interruption at any moment finds it.
    ending = "".join(target.suffixes[-2:])
    temporary = target.parent / f".writing-{secrets.token_hex(6)}{ending}"
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        temporary.touch(exist_ok=False)
        yield temporary
        temporary.replace(target)
    except OSError as error:
        raise FormatError(f"cannot write '{target}': {error.strerror or error}") from error
    finally:
        with suppress(OSError):  # there is none if its folder cannot be entered
            temporary.unlink()
