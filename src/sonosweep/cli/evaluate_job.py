"""The work of ``sonosweep evaluate --dataset``."""

import os
import shlex
import sys
from pathlib import Path
from typing import Any

from sonosweep.cli.evaluate import BenchmarkOptions
from sonosweep.cli.output import check_free
from sonosweep.cli.progress import progress
from sonosweep.errors import FormatError
from sonosweep.evaluate.baselines import decorrelation_baselines, quick_baselines
from sonosweep.evaluate.benchmark import run_benchmark
from sonosweep.evaluate.benchmark_table import benchmark_page, write_page
from sonosweep.evaluate.dataset_scans import DatasetScans, dataset_scans
from sonosweep.evaluate.methods import Method
from sonosweep.evaluate.paper_values import PaperTable
from sonosweep.evaluate.trained import trained_networks
from sonosweep.io.open import printable

OF_DATASET: dict[str, PaperTable] = {"dataset1": "dataset1", "dataset3": "dataset3"}


def run_evaluation(
    options: BenchmarkOptions, folder: Path, output: Path | None, force: bool
) -> tuple[str, dict[str, Any]]:
    """Compare the methods; return the page, and what was done as facts.

    Raises:
        ScanError: If there is nothing to compare, or a method cannot use a scan.
        FormatError: If something cannot be read or written.
    """
    files = _output_files(output, force)
    data = dataset_scans(folder, options.part or "test", options.scans)
    networks = trained_networks(options.weights)
    cache = options.cache or folder.resolve().parent / f"{folder.resolve().name}.results"
    methods = [
        *_baselines(options.baselines or "all", data, cache),
        *(network.method for network in networks),
    ]
    with progress("evaluating, frames") as show:
        rows = run_benchmark(
            data.scans,
            methods,
            cache,
            simulated=True,
            workers=options.workers if options.workers is not None else os.cpu_count() or 1,
            again=options.again,
            progress=show,
        )
    page = benchmark_page(
        rows,
        options.title or f"{data.recipe}: methods compared",
        {"command": f"`{_command()}`", "data": data.description},
        networks,
        options.against,
        options.paper or OF_DATASET.get(data.recipe),
    )
    if files is not None:
        write_page(page, rows, *files)
    return page, {
        "scans": len(data.scans),
        "methods": list(dict.fromkeys(method.name for method in methods)),
        "outputs": [str(file) for file in files or ()],
        "rows": rows,
    }


def _output_files(output: Path | None, force: bool) -> tuple[Path, Path] | None:
    """Return where the page and the table go."""
    if output is None:
        return None
    if output.suffix or output.is_dir():
        raise FormatError(f"'{output}' must be a name without suffix: .md and .csv are added")
    files = output.with_name(f"{output.name}.md"), output.with_name(f"{output.name}.csv")
    for file in files:
        check_free(file, force)
    return files


def _baselines(which: str, data: DatasetScans, cache: Path) -> list[Method]:
    if which == "none":
        return []
    quick = quick_baselines(data.training)
    if which == "quick":
        return quick
    with progress("calibrating the decorrelation estimator, scans") as show:
        return quick + decorrelation_baselines(data.teaching, cache, show)


def _command() -> str:
    """Return the command that was given."""
    return printable(shlex.join(["sonosweep", *sys.argv[1:]]))
