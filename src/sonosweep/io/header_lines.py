"""The lines of a text header that stands before binary pixels."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from sonosweep.errors import FormatError

# One line may hold the time of every frame of a long .seq.nrrd.
LONGEST_LINE_BYTES = 16 << 20


@contextmanager
def open_binary(path: Path) -> Iterator[IO[bytes]]:
    """Open a file for reading; whatever the system says against it is one sentence.

    Raises:
        FormatError: If it is not there, not a plain file, or cannot be read.
    """
    try:
        if not path.is_file():
            kind = "is not a file" if path.exists() else "does not exist"
            raise FormatError(f"'{path}' {kind}")
        with path.open("rb") as file:
            yield file
    except OSError as error:
        raise FormatError(f"cannot read '{path}': {error.strerror or error}") from error


def header_lines(file: IO[bytes], path: Path) -> Iterator[str]:
    """Yield the lines of a header, without the line ends.

    Raises:
        FormatError: If a line is longer than any header's, or holds bytes that are not text.
    """
    while line := file.readline(LONGEST_LINE_BYTES):
        if len(line) == LONGEST_LINE_BYTES or b"\0" in line:
            raise FormatError(f"the header of '{path}' is not text: it is damaged or not a header")
        yield line.decode("utf-8", errors="replace").rstrip("\r\n")
