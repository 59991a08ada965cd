"""What trainings gave, as Markdown: one row a run, from its log and its weights.

Run ``python benchmarks/training_summary.py runs/table1/* > docs/results/training.md``.
"""

import sys
import tomllib
from pathlib import Path

from sonosweep.estimators.shipped import find_weights
from sonosweep.estimators.weights import read_weights_info
from sonosweep.evaluate.tables import Cell, markdown_table
from sonosweep.training.log import LOG, read_log

LAST = 0.05  # share of the log over whose end the loss is averaged


def main(runs: list[str]) -> None:
    """Print the table."""
    print("# Trainings\n")
    print(f"`python benchmarks/training_summary.py {' '.join(runs)}`\n")
    print(
        "Loss in training is the mean over the last 5 % of the pairs. The other numbers are of the"
        " scans for validation, at the end; CPU time is of one thread, on a machine that had"
        " other work, validation included.\n"
    )
    print(markdown_table([_row(run) for run in runs]))


def _row(run: str) -> dict[str, Cell]:
    info, log = read_weights_info(find_weights(run)), read_log(Path(run) / LOG)
    end = [row for row in log if row["pairs"] > (1 - LAST) * log[-1]["pairs"]]
    spent = log[-1].get("cpu_s")
    return {
        "run": "/".join(Path(run).parts[-2:]),
        "network": info.network,
        "seed": tomllib.loads(info.recipe)["seed"],
        "parameters": info.parameters,
        "pairs": int(log[-1]["pairs"]),
        "CPU (min)": None if spent is None else round(spent / 60, 1),
        "loss": sum(row["loss"] for row in end) / len(end),
        "correlation, elevational": info.metrics["r_elevational"],
        "rAE": info.metrics["rae"],
        "rAE of mean motion": info.metrics["rae_of_mean"],
        "FDR (% of path)": info.metrics["fdr"],
    }


if __name__ == "__main__":
    main(sys.argv[1:])
