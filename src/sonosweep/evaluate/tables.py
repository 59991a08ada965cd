"""Rows of results as text: Markdown to read, csv to compute with."""

import csv
import os
from collections.abc import Mapping, Sequence

from sonosweep.errors import ScanError
from sonosweep.io.atomic import write_beside

Cell = str | int | float | bool | None


def markdown_table(rows: Sequence[Mapping[str, Cell]], digits: int = 3) -> str:
    """Return rows as a Markdown table; numbers to the right, ``-`` for what is missing.

    Args:
        rows: Cells by column; the first row gives the order, new columns follow.
        digits: Significant digits of a number that is not whole.

    Raises:
        ScanError: If there is no row.
    """
    columns = _columns(rows)
    lines = [[column.replace("|", "\\|") for column in columns]]
    for row in rows:
        lines.append([cell_text(row.get(column), digits) for column in columns])
    right = [all(not isinstance(row.get(column), str) for row in rows) for column in columns]
    widths = [max(3, *(len(line[k]) for line in lines)) for k in range(len(columns))]
    texts = [_markdown_line(line, widths, right) for line in lines]
    rule = [("-" * (w - 1) + ":") if r else "-" * w for w, r in zip(widths, right, strict=True)]
    return "\n".join([texts[0], "| " + " | ".join(rule) + " |", *texts[1:]]) + "\n"


def write_csv(rows: Sequence[Mapping[str, Cell]], path: str | os.PathLike) -> None:
    """Write rows as csv, full precision, empty for what is missing.

    Raises:
        ScanError: If there is no row.
        FormatError: If the file cannot be written.
    """
    columns = _columns(rows)
    with (
        write_beside(path) as temporary,
        temporary.open("w", newline="", encoding="utf-8") as file,
    ):
        writer = csv.DictWriter(file, columns, restval="", lineterminator="\n")
        writer.writeheader()
        for row in rows:
            writer.writerow({name: "" if value is None else value for name, value in row.items()})


def _columns(rows: Sequence[Mapping[str, Cell]]) -> list[str]:
    if not rows:
        raise ScanError("a table needs a row")
    return list(dict.fromkeys(column for row in rows for column in row))


def cell_text(value: Cell, digits: int = 3) -> str:
    """Return a cell as people read it: ``digits`` significant ones, ``-`` for nothing."""
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.{digits}g}" if abs(value) < 10**digits else f"{value:.0f}"
    return str(value).replace("|", "\\|").replace("\n", " ")


def _markdown_line(cells: list[str], widths: list[int], right: list[bool]) -> str:
    padded = [
        cell.rjust(width) if at_right else cell.ljust(width)
        for cell, width, at_right in zip(cells, widths, right, strict=True)
    ]
    return "| " + " | ".join(padded) + " |"
