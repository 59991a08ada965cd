"""Comparisons as results: tables, means with intervals, json."""

import json
import math
import os
from collections.abc import Sequence
from importlib.metadata import version

from sonosweep.errors import ScanError
from sonosweep.evaluate.compare import TrajectoryComparison
from sonosweep.evaluate.intervals import Interval, bootstrap_interval
from sonosweep.evaluate.tables import Cell, cell_text, markdown_table
from sonosweep.io.atomic import write_beside

# What people call the numbers, and their units.
LABELS = {
    "relative_error_mm": ("rAE, translation", "mm"),
    "relative_error_deg": ("rAE, rotation", "deg"),
    "relative_error_mixed": ("rAE as in the paper", "mm and deg"),
    "accumulated_error_mm": ("aAE, translation", "mm"),
    "accumulated_error_deg": ("aAE, rotation", "deg"),
    "accumulated_error_mixed": ("aAE as in the paper", "mm and deg"),
    "accumulated_angle_deg": ("angle to the true pose", "deg"),
    "relative_frame_error_mm": ("rFE", "mm"),
    "accumulated_frame_error_mm": ("aFE", "mm"),
    "correlation_cosine": ("Corr as in the paper", ""),
    "correlation_pearson": ("correlation of the movement", ""),
    "final_drift_mm": ("FD", "mm"),
    "final_drift_rate_path_percent": ("FDR, of the path (the paper's text)", "%"),
    "final_drift_rate_chord_percent": ("FDR, of the chord (its code)", "%"),
    "median_drift_mm": ("drift, median", "mm"),
    "maximum_drift_mm": ("drift, largest", "mm"),
    "path_length_mm": ("path, tracked", "mm"),
    "estimated_path_length_mm": ("path, estimated", "mm"),
    "global_pixel_error_mm": ("GPE", "mm"),
    "global_landmark_error_mm": ("GLE", "mm"),
    "local_pixel_error_mm": ("LPE", "mm"),
    "local_landmark_error_mm": ("LLE", "mm"),
}
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


def comparison_table(comparison: TrajectoryComparison) -> str:
    """Return the numbers of one scan as a Markdown table with their names and units."""
    numbers = comparison_row(comparison)
    rows: list[dict[str, Cell]] = [
        {"metric": label, "value": numbers[name], "unit": unit}
        for name, (label, unit) in LABELS.items()
        if numbers.get(name) is not None
    ]
    return markdown_table(rows)


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
            row[header] = interval_text(means.get(name), digits)
        rows.append(row)
    return markdown_table(rows, digits)


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


def interval_text(interval: Interval | None, digits: int = 3) -> str | None:
    """Return a mean and its interval as people read them; ``None`` for nothing."""
    if interval is None:
        return None
    mean = cell_text(interval.mean, digits)
    if interval.low is None or interval.high is None:
        return mean
    return f"{mean} [{cell_text(interval.low, digits)}, {cell_text(interval.high, digits)}]"
