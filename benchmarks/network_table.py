"""The shipped networks side by side, as Markdown: size, speed, error, and the paper's numbers.

Run ``python benchmarks/network_table.py docs/results/table1.csv`` on the table that
``sonosweep evaluate --dataset`` wrote. Speed is that of the evaluation: CPU time of one thread
from frames on disk to a trajectory, on a machine that had other work.
"""

import csv
import sys
from pathlib import Path

from sonosweep.estimators.network_names import NETWORKS
from sonosweep.estimators.shipped import find_weights
from sonosweep.estimators.weights import read_weights_info
from sonosweep.evaluate.benchmark import Row
from sonosweep.evaluate.method_summary import MethodResult, method_results
from sonosweep.evaluate.paper_values import COLUMNS, PAPER_TABLES
from sonosweep.evaluate.summary import interval_text
from sonosweep.evaluate.tables import Cell, markdown_table

ERRORS = {
    "rAE": "relative_error_mixed",
    "rFE (mm)": "relative_frame_error_mm",
    "FDR (% of path)": "final_drift_rate_path_percent",
}


def main(table: Path) -> None:
    """Print ours, then the paper's: never in one table."""
    with table.open(newline="", encoding="utf-8") as file:
        rows = [_row(texts) for texts in csv.DictReader(file)]
    results = {result.name: result for result in method_results(rows)}
    print(markdown_table([_ours(results[name], rows) for name in NETWORKS]))
    paper = PAPER_TABLES["dataset1"].rows
    printed = {name.lower(): dict(zip(COLUMNS, paper[name], strict=True)) for name in paper}
    chosen = ("rAE", "rFE", "FDR")
    print(
        markdown_table(
            [
                {"name": f"`{name}`", **{column: printed[name][column] for column in chosen}}
                for name in NETWORKS
            ],
            digits=4,
        )
    )


def _row(texts: dict[str, str]) -> Row:
    """Return a row of the file, its numbers that are needed here as numbers."""
    numbers = ("frames", "cpu_s", *ERRORS.values())
    return {**texts, **{column: float(texts[column]) for column in numbers}}


def _ours(result: MethodResult, rows: list[Row]) -> dict[str, Cell]:
    own = [row for row in rows if row["method"] == result.name]
    frames, spent_s = (
        sum(float(row[column] or 0) for row in own) for column in ("frames", "cpu_s")
    )
    return {
        "name": f"`{result.name}`",
        "parameters": f"{read_weights_info(find_weights(result.name)).parameters / 1e6:.2f} M",
        "ms per frame": spent_s / frames * 1e3,
        "trainings": result.runs,
        **{title: interval_text(result.interval(metric)) for title, metric in ERRORS.items()},
    }


if __name__ == "__main__":
    main(Path(sys.argv[1]))
