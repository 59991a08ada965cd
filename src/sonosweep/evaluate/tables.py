"""Results as tables: Markdown to read, csv and json to compute with."""

import csv
import json
import math
import os
from collections.abc import Mapping, Sequence
from importlib.metadata import version

from sonosweep.errors import ScanError
from sonosweep.evaluate.compare import TrajectoryComparison
from sonosweep.evaluate.intervals import Interval, bootstrap_interval
from sonosweep.io.atomic import write_beside

# The paper's names; each with the number that its tables print.
PAPER_COLUMNS = {
    "rAE": "relative_error_mixed",
    "aAE": "accumulated_error_mixed",
    "rFE (mm)": "relative_frame_error_mm",
    "aFE (mm)": "accumulated_frame_error_mm",
    "Corr": "correlation_cosine",
    "FD (mm)": "final_drift_mm",
    "FDR (% of path)": "final_drift_rate_path_percent",
    "FDR (% of chord)": "final_drift_rate_chord_percent",
}
Cell = str | int | float | bool | None


def comparison_row(comparison: TrajectoryComparison) -> dict[str, Cell]:
    """Return everything about one scan that is one number or word, by name."""
    row: dict[str, Cell] = {
        "scan": comparison.name,
        "subject": comparison.subject,
        "method": comparison.method,
        "matched_by": comparison.matched_by,
        "frames_without_pose": comparison.frames_without_pose,
        "direction_agrees": comparison.direction_agrees,
    }
    row |= comparison.metrics.as_dict()
    if comparison.tusrec is not None:
        row |= vars(comparison.tusrec)
    return row


def summarize(
    comparisons: Sequence[TrajectoryComparison], confidence: float = 0.95
) -> dict[str, Interval]:
    """Return the mean of each metric over the scans, with its bootstrap interval.

    Scans of one subject are drawn together if every scan names its subject. A metric that
    no scan has is left out.

    Raises:
        ScanError: If there is no scan.
    """
    if not comparisons:
        raise ScanError("there is no scan to summarize")
    subjects = [comparison.subject for comparison in comparisons]
    groups = subjects if all(subjects) else list(range(len(subjects)))
    result = {}
    for name in comparisons[0].metrics.as_dict():
        values = [comparison.metrics.as_dict()[name] for comparison in comparisons]
        pairs = [(v, g) for v, g in zip(values, groups, strict=True) if v is not None]
        if pairs and name != "frames":
            result[name] = bootstrap_interval(
                [float(value) for value, _ in pairs], [group for _, group in pairs], confidence
            )
    return result


def paper_table(comparisons: Sequence[TrajectoryComparison], digits: int = 3) -> str:
    """Return a Markdown table as the paper's: a row per method, mean and 95 % interval.

    Raises:
        ScanError: If there is no scan.
    """
    rows = []
    for method in dict.fromkeys(comparison.method for comparison in comparisons):
        chosen = [comparison for comparison in comparisons if comparison.method == method]
        means = summarize(chosen)
        row: dict[str, Cell] = {"method": method, "scans": len(chosen)}
        for header, name in PAPER_COLUMNS.items():
            row[header] = _interval_text(means.get(name), digits)
        rows.append(row)
    return markdown_table(rows, digits)


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
        lines.append([_cell_text(row.get(column), digits) for column in columns])
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


def write_json(comparisons: Sequence[TrajectoryComparison], path: str | os.PathLike) -> None:
    """Write every number of every scan, its drift per frame, and the means over the scans.

    Raises:
        ScanError: If there is no scan.
        FormatError: If the file cannot be written.
    """
    content = {
        "program": f"sonosweep {version('sonosweep')}",
        "scans": [_comparison_json(comparison) for comparison in comparisons],
        "means": {name: vars(interval) for name, interval in summarize(comparisons).items()},
    }
    with write_beside(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        json.dump(content, file, indent=2, allow_nan=False)
        file.write("\n")


def _comparison_json(comparison: TrajectoryComparison) -> dict[str, object]:
    drift = [None if math.isnan(value) else value for value in comparison.drift_mm.tolist()]
    return {
        **comparison_row(comparison),
        "points": comparison.points,
        "assumptions": list(comparison.assumptions),
        "drift_mm": drift,
    }


def _columns(rows: Sequence[Mapping[str, Cell]]) -> list[str]:
    if not rows:
        raise ScanError("a table needs a row")
    return list(dict.fromkeys(column for row in rows for column in row))


def _cell_text(value: Cell, digits: int) -> str:
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.{digits}g}" if abs(value) < 10**digits else f"{value:.0f}"
    return str(value).replace("|", "\\|").replace("\n", " ")


def _interval_text(interval: Interval | None, digits: int) -> str | None:
    if interval is None:
        return None
    mean = _cell_text(interval.mean, digits)
    if interval.low is None or interval.high is None:
        return mean
    return f"{mean} [{_cell_text(interval.low, digits)}, {_cell_text(interval.high, digits)}]"


def _markdown_line(cells: list[str], widths: list[int], right: list[bool]) -> str:
    padded = [
        cell.rjust(width) if at_right else cell.ljust(width)
        for cell, width, at_right in zip(cells, widths, right, strict=True)
    ]
    return "| " + " | ".join(padded) + " |"
