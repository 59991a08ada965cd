"""Which code made a result: a text that changes when the code does."""

import hashlib
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).parents[1]


@cache
def source_digest(*parts: str) -> str:
    """Return a text that differs for different versions of these parts of the program.

    The version number alone would let results of changed code join those that were kept.

    Args:
        parts: Folders and files of the package, such as ``"geometry"``.
    """
    found = hashlib.sha256()
    for part in parts:
        path = PACKAGE / part
        for file in sorted(path.glob("*.py")) if path.is_dir() else (path,):
            found.update(file.name.encode() + b"\0" + file.read_bytes())
    return found.hexdigest()
