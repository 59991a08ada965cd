"""Experiments: how good estimates are, over one scan or many."""

from sonosweep.evaluate.compare import TrajectoryComparison, compare_trajectories
from sonosweep.evaluate.intervals import Interval, bootstrap_interval, paired_interval
from sonosweep.evaluate.summary import (
    comparison_row,
    comparison_table,
    paper_table,
    summarize,
    write_json,
)
from sonosweep.evaluate.tables import markdown_table, write_csv

__all__ = [
    "Interval",
    "TrajectoryComparison",
    "bootstrap_interval",
    "compare_trajectories",
    "comparison_row",
    "comparison_table",
    "markdown_table",
    "paired_interval",
    "paper_table",
    "summarize",
    "write_csv",
    "write_json",
]
