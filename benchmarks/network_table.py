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
from sonosweep.evaluate.benchmark_table import interval_text
from sonosweep.evaluate.intervals import bootstrap_interval
from sonosweep.evaluate.paper_values import COLUMNS, PAPER_TABLES
from sonosweep.evaluate.tables import Cell, markdown_table

ERRORS = {
    "rAE": "relative_error_mixed",
    "rFE (mm)": "relative_frame_error_mm",
    "FDR (% of path)": "final_drift_rate_path_percent",
}


def main(table: Path) -> None:
    """Print ours, then the paper's: never in one table."""
    with table.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    print(markdown_table([_ours(name, rows) for name in NETWORKS]))
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


def _ours(name: str, rows: list[dict[str, str]]) -> dict[str, Cell]:
    own = [row for row in rows if row["method"] == name]
    frames, spent_s = (sum(float(row[column]) for row in own) for column in ("frames", "cpu_s"))
    return {
        "name": f"`{name}`",
        "parameters": f"{read_weights_info(find_weights(name)).parameters / 1e6:.2f} M",
        "ms per frame": spent_s / frames * 1e3,
        "trainings": len({row["run"] for row in own}),
        **{title: _interval(own, column) for title, column in ERRORS.items()},
    }


def _interval(rows: list[dict[str, str]], column: str) -> Cell:
    """Return the mean over the sweeps, each the mean over trainings, with its interval."""
    values: dict[str, list[float]] = {}
    for row in rows:
        values.setdefault(row["scan"], []).append(float(row[column]))
    return interval_text(bootstrap_interval([sum(v) / len(v) for v in values.values()]))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
