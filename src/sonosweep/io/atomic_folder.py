"""Output folders that are either whole or not there."""

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sonosweep.errors import FormatError


@contextmanager
def write_folder_beside(path: str | os.PathLike, ours: tuple[str, ...]) -> Iterator[Path]:
    """Give a temporary folder; its files arrive at ``path`` if all goes well.

    Whatever goes wrong inside the block, interruption included, leaves ``path`` as it was.

    Args:
        path: Where the folder is to be in the end.
        ours: Patterns of the files that may be replaced. A folder with anything else in it
            is never touched.

    Raises:
        FormatError: If something else is in the way, the place cannot be written to, or
            the disk is full.
    """
    target = Path(path)
    temporary = None
    try:
        _refuse_foreign(target, ours)
        temporary = temporary_for(target)
        yield temporary
        kept = {item.name for item in temporary.iterdir()}
        put_in_place(temporary, target)
        for item in target.iterdir():
            if item.name not in kept and _is_ours(item, ours):
                item.unlink()
    except FormatError as error:
        raise named_after(target, temporary, error) from error
    except OSError as error:
        raise FormatError(f"cannot write '{target}': {error.strerror or error}") from error
    finally:
        if temporary is not None:
            shutil.rmtree(temporary, ignore_errors=True)


def temporary_for(folder: Path) -> Path:
    """Return a new temporary folder from which files can be renamed into ``folder``.

    It lies in ``folder`` where that exists, which may be another disk than its parent.
    """
    if folder.is_dir():
        return Path(tempfile.mkdtemp(dir=folder, prefix=".writing-"))
    folder.parent.mkdir(parents=True, exist_ok=True)
    return Path(tempfile.mkdtemp(dir=folder.parent, prefix=".writing-"))


def named_after(folder: Path, temporary: Path | None, error: FormatError) -> FormatError:
    """Return an error that names the folder people know instead of the temporary one."""
    return FormatError(str(error).replace(str(temporary), str(folder)))


def put_in_place(temporary: Path, folder: Path) -> None:
    """Give ``folder`` what is in a temporary folder, replacing what has the same name.

    A new folder appears at once; of two programs that make it, only one succeeds.
    """
    if not (folder.exists() and folder.samefile(temporary.parent)):
        # mkdtemp makes folders that only their owner can enter; give what umask would have.
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o777 & ~umask)
        temporary.rename(folder)
        return
    for item in sorted(temporary.iterdir()):
        target = folder / item.name
        if target.is_dir() and not target.is_symlink():
            shutil.rmtree(target)
        item.replace(target)


def _refuse_foreign(target: Path, ours: tuple[str, ...]) -> None:
    if not target.exists():
        return
    if not target.is_dir():
        raise FormatError(f"'{target}' is a file; give a new folder")
    foreign = next((p.name for p in target.iterdir() if not _is_ours(p, ours)), None)
    if foreign is not None:
        raise FormatError(
            f"folder '{target}' holds other files, such as '{foreign}'; give a new folder"
        )


def _is_ours(item: Path, ours: tuple[str, ...]) -> bool:
    return item.is_file() and any(item.match(pattern) for pattern in ours)
