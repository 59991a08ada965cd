"""What a verb leaves behind: a line or JSON on standard output, and whole files."""

import json
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from sonosweep.errors import FormatError
from sonosweep.io.atomic_folder import staged_folder


def say(line: str, facts: Mapping[str, Any], as_json: bool) -> None:
    """Print the summary line, or with ``--json`` the facts, on standard output."""
    print(json.dumps(plain(facts)) if as_json else line)


def plain(value: Any) -> Any:  # Any: whatever JSON can hold
    """Return the value as JSON holds it: numbers that are not finite become ``null``."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Path):
        return str(value)
    return value


def check_free(path: Path, force: bool) -> None:
    """Refuse to overwrite.

    Raises:
        FormatError: If ``path`` exists, and ``--force`` was not given; an empty folder is
            no obstacle.
    """
    occupied = any(path.iterdir()) if path.is_dir() else path.exists()
    if occupied and not force:
        raise FormatError(f"'{path}' exists: choose another output or add --force")


@contextmanager
def whole_folder(folder: Path, force: bool) -> Iterator[Path]:
    """Give a temporary folder whose files all arrive in ``folder`` at the end, or none.

    With ``force``, files of the same name are replaced and other files stay. Of two runs
    into one new folder, the second is refused when it comes to write.

    Raises:
        FormatError: If ``folder`` holds files already and ``force`` is not set, or it
            cannot be written to.
    """
    if folder.exists() and not folder.is_dir():
        raise FormatError(f"'{folder}' is a file, an output folder is needed")
    check_free(folder, force)
    with staged_folder(folder) as temporary:
        yield temporary
