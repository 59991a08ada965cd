"""Output folders that are either whole or not there."""

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sonosweep.errors import FormatError


@contextmanager
def write_folder_beside(path: str | os.PathLike, ours: str) -> Iterator[Path]:
    """Give a temporary folder beside ``path``; rename it to ``path`` if all goes well.

    Whatever goes wrong inside the block, interruption included, leaves ``path`` as it was.

    Args:
        path: Where the folder is to be in the end.
        ours: Pattern of the files that may be replaced. A folder with anything else in it
            is never touched.

    Raises:
        FormatError: If something else is in the way, the place cannot be written to, or
            the disk is full.
    """
    target = Path(path)
    temporary = None
    try:
        _refuse_foreign(target, ours)
        target.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(dir=target.parent, prefix=".writing-"))
        yield temporary
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o777 & ~umask)
        _put_in_place(temporary, target)
    except OSError as error:
        raise FormatError(f"cannot write '{target}': {error.strerror or error}") from error
    finally:
        if temporary is not None:
            shutil.rmtree(temporary, ignore_errors=True)


def _refuse_foreign(target: Path, ours: str) -> None:
    if not target.exists():
        return
    if not target.is_dir():
        raise FormatError(f"'{target}' is a file; give a new folder")
    foreign = next((p.name for p in target.iterdir() if not p.match(ours)), None)
    if foreign is not None:
        raise FormatError(
            f"folder '{target}' holds other files, such as '{foreign}'; give a new folder"
        )


def _put_in_place(temporary: Path, target: Path) -> None:
    """Rename, moving what was there aside until the new folder stands."""
    if not target.exists():
        temporary.rename(target)
        return
    aside = Path(tempfile.mkdtemp(dir=target.parent, prefix=".replaced-"))
    target.rename(aside)  # a folder may be renamed onto an empty one
    try:
        temporary.rename(target)
    except OSError:
        aside.rename(target)
        raise
    shutil.rmtree(aside, ignore_errors=True)
