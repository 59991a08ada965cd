"""Small text tables of numbers, as people write them: csv, tabs or blanks."""

import os
from pathlib import Path

from sonosweep.errors import FormatError

LARGEST_TEXT_BYTES = 2**28


def read_text(path: str | os.PathLike) -> str:
    """Return the text of a small file, without a byte-order mark.

    Raises:
        FormatError: If it is missing, too large or no text.
    """
    file = Path(path)
    if not file.is_file():
        raise FormatError(f"there is no file '{file}'")
    try:
        if file.stat().st_size > LARGEST_TEXT_BYTES:
            raise FormatError(f"'{file.name}' is too large to be a table of numbers")
        text = file.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise FormatError(f"'{file.name}' is not a text file: byte {error.start} says no") from None
    except OSError as error:
        raise FormatError(f"cannot read '{file}': {error.strerror or error}") from error
    if "\0" in text:
        raise FormatError(f"'{file.name}' is not a text file: it holds zero bytes")
    return text


def split_cells(line: str) -> list[str]:
    """Return the cells of a line, parted by semicolons, commas, tabs or blanks.

    With semicolons, a comma is a decimal point, as spreadsheets write in half of Europe.
    """
    if ";" in line:
        return [cell.strip().replace(",", ".") for cell in line.split(";")]
    if "," in line:
        return [cell.strip() for cell in line.split(",")]
    return line.split()


def parse_numbers(cells: list[str], where: str) -> list[float]:
    """Return cells as numbers.

    Args:
        cells: Texts.
        where: Line and file, for the message.

    Raises:
        FormatError: If one of them is no number.
    """
    numbers = []
    for cell in cells:
        try:
            numbers.append(float(cell))
        except ValueError:
            raise FormatError(f"'{cell[:40]}' is not a number, in {where}") from None
    return numbers


def is_number(cell: str) -> bool:
    """Say whether a cell is a number."""
    try:
        float(cell)
    except ValueError:
        return False
    return True
