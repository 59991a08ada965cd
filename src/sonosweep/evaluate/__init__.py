"""Experiments: how good estimates are, over one scan or many."""

from sonosweep.evaluate.compare import TrajectoryComparison, compare_trajectories
from sonosweep.evaluate.intervals import Interval, bootstrap_interval, paired_interval
from sonosweep.evaluate.summary import paper_table, summarize, write_comparison
from sonosweep.evaluate.tables import markdown_table, write_csv

__all__ = [
    "Interval",
    "TrajectoryComparison",
    "bootstrap_interval",
    "compare_trajectories",
    "markdown_table",
    "paired_interval",
    "paper_table",
    "summarize",
    "write_comparison",
    "write_csv",
]
