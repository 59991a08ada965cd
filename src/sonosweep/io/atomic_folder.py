"""Output folders that are either whole or not there."""

import os
import secrets
import shutil
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
    _refuse_foreign(target, ours)
    with staged_folder(target) as temporary:
        yield temporary
        kept = {item.name for item in temporary.iterdir()}
    for item in target.iterdir():
        if item.name not in kept and _is_ours(item, ours):
            item.unlink()


@contextmanager
def staged_folder(folder: Path) -> Iterator[Path]:
    """Give a temporary folder; its files arrive in ``folder`` if all goes well.

    Files of the same name are replaced and others stay. Whatever goes wrong inside the
    block, interruption included, leaves ``folder`` as it was and nothing beside it.

    Raises:
        FormatError: If the place cannot be written to, or the disk is full.
    """
    # Named before it is made, so that an interruption at any moment finds it.
    temporary = temporary_for(folder)
    try:
        temporary.mkdir(parents=True)
        yield temporary
        put_in_place(temporary, folder)
    except FormatError as error:  # people know the folder, not the temporary one
        raise FormatError(str(error).replace(str(temporary), str(folder))) from error
    except OSError as error:
        raise FormatError(f"cannot write to '{folder}': {error.strerror or error}") from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def temporary_for(path: Path) -> Path:
    """Return an unused name from which something can be renamed to ``path``.

    For a folder that exists it lies inside, which may be another disk than its parent.
    """
    name = f".writing-{secrets.token_hex(6)}"
    return path / name if path.is_dir() else path.parent / name


def put_in_place(temporary: Path, folder: Path) -> None:
    """Give ``folder`` what is in a temporary folder, replacing what has the same name.

    A new folder appears at once; of two programs that make it, only one succeeds.
    """
    if not (folder.exists() and folder.samefile(temporary.parent)):
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
