"""Many comparisons as one result: means with intervals, the paper's table, files."""

import json
import os
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

from sonosweep.errors import FormatError, ScanError
from sonosweep.evaluate.compare import TrajectoryComparison
from sonosweep.evaluate.intervals import Interval, bootstrap_interval
from sonosweep.evaluate.tables import Cell, cell_text, markdown_table, write_csv
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


def write_comparison(
    comparisons: TrajectoryComparison | Sequence[TrajectoryComparison], path: str | os.PathLike
) -> None:
    """Write one comparison or several: as ``.csv``, one line per scan, or as ``.json``.

    The json holds the drift of every frame, too, and the means over the scans.

    Raises:
        ScanError: If there is no scan.
        FormatError: If the file ends in something else, or cannot be written.
    """
    several = [comparisons] if isinstance(comparisons, TrajectoryComparison) else list(comparisons)
    suffix = Path(path).suffix.lower()
    if suffix == ".csv":
        write_csv([comparison.as_row() for comparison in several], path)
    elif suffix == ".json":
        _write_json(several, path)
    else:
        raise FormatError(f"comparisons are written as .json or .csv, not as '{Path(path).name}'")


def _write_json(comparisons: Sequence[TrajectoryComparison], path: str | os.PathLike) -> None:
    content = {
        "program": f"sonosweep {version('sonosweep')}",
        "scans": [comparison.as_dict() for comparison in comparisons],
        "means": {name: vars(interval) for name, interval in summarize(comparisons).items()},
    }
    with write_beside(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        json.dump(content, file, indent=2, allow_nan=False)
        file.write("\n")


def _interval_text(interval: Interval | None, digits: int) -> str | None:
    if interval is None:
        return None
    mean = cell_text(interval.mean, digits)
    if interval.low is None or interval.high is None:
        return mean
    return f"{mean} [{cell_text(interval.low, digits)}, {cell_text(interval.high, digits)}]"
