"""``sonosweep evaluate``: how far estimates are from the tracker, of one scan or a data set."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Group, Parameter

from sonosweep.cli.inputs import OUTPUT, Force, InputOptions, Json, read
from sonosweep.cli.whole_number import WHOLE
from sonosweep.errors import FormatError, ScanError

if TYPE_CHECKING:
    from torch import Tensor

    from sonosweep.scan import Trajectory

BENCHMARK = Group("A data set", sort_key=1)


@Parameter(name="*", group=BENCHMARK)
@dataclass(frozen=True)
class BenchmarkOptions:
    """Which methods are compared on which scans.

    Attributes:
        dataset: Folder that `simulate --dataset` made.
        part: Scans of the data set to evaluate on.
        weights: Trained networks: names of shipped weights, .safetensors files, or folders of
            training runs. Those that differ in the seed alone share a row; NAME=WEIGHTS
            names it.
        baselines: Methods without a network to compare with: all; quick, without speckle
            decorrelation; or none. What they learn they learn from the training scans, the
            decorrelation estimator also from those for validation.
        scans: Only the first so many.
        against: Method that every other one is compared with, scan by scan; moglo otherwise.
        paper: Table of the paper to print below; that of the data set otherwise.
        workers: Processes, one thread each.
        cache: Folder where results of single scans are kept, so that a run can go on; beside
            the data set otherwise.
        again: Compute again what is kept there.
        title: Of the page.
    """

    dataset: Path | None = None
    part: Literal["validation", "test"] | None = None
    weights: Annotated[
        tuple[str, ...], Parameter(negative="", consume_multiple=True, show_default=False)
    ] = ()
    baselines: Literal["all", "quick", "none"] | None = None
    scans: Annotated[int | None, WHOLE] = None
    against: str | None = None
    paper: Literal["dataset1", "ablation1", "ablation2", "dataset3"] | None = None
    workers: Annotated[int | None, WHOLE] = None
    cache: Path | None = None
    again: Annotated[bool, Parameter(negative="", show_default=False)] = False
    title: str | None = None


def evaluate(
    estimated: Path | None = None,
    tracked: Path | None = None,
    /,
    *,
    output: Annotated[Path | None, Parameter(name=["--output", "-o"], group=OUTPUT)] = None,
    benchmark: BenchmarkOptions | None = None,
    inputs: InputOptions | None = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """Compare an estimated trajectory with the tracked poses of the scan it came from.

    The landmarks of a TUS-REC scan count too if they lie in the folders above it. With
    --dataset, compare many methods on many scans instead, and write a page and a table.

    Args:
        estimated: Trajectory (.csv, TUM, .igs.mha, .tfm), or a folder that `reconstruct` wrote.
        tracked: The tracked scan.
        output: Where to write the numbers: .json or .csv; both with no suffix. With --dataset:
            a name without suffix, for .md and .csv.
    """
    if benchmark is not None:
        _evaluate_dataset(estimated, benchmark, output, inputs, force, json)
    elif estimated is None or tracked is None:
        raise ScanError(
            "give an estimated trajectory and the tracked scan, or a folder with --dataset"
        )
    else:
        _evaluate_scan(estimated, tracked, output, inputs, force, json)


def _evaluate_scan(
    estimated: Path,
    tracked: Path,
    output: Path | None,
    inputs: InputOptions | None,
    force: bool,
    json: bool,
) -> None:
    """Compare one trajectory with one scan."""
    from sonosweep.cli.output import check_free, say
    from sonosweep.evaluate import (
        compare_trajectories,
        comparison_row,
        comparison_table,
        write_csv,
        write_json,
    )
    from sonosweep.scan import locate_image

    paths = _outputs(output)
    for path in paths:
        check_free(path, force)
    scan = locate_image(read(tracked, inputs))
    result = compare_trajectories(_trajectory(estimated), scan, landmarks=_landmarks(tracked))
    row = comparison_row(result)
    for path in paths:
        if path.suffix.lower() == ".csv":
            write_csv([row], path)
        else:
            write_json([result], path)
    say(f"{result}\n\n{comparison_table(result)}", row, json)


def _evaluate_dataset(
    estimated: Path | None,
    options: BenchmarkOptions,
    output: Path | None,
    inputs: InputOptions | None,
    force: bool,
    json: bool,
) -> None:
    """Compare many methods on many scans."""
    if options.dataset is None:
        raise ScanError(
            "--part, --weights, --baselines, --scans, --against, --paper, --workers, --cache,"
            " --again and --title are about a data set: give --dataset too"
        )
    if estimated is not None:
        raise ScanError(f"--dataset compares methods: leave out '{estimated}', or --dataset")
    if inputs is not None:
        raise ScanError("the scans of a data set say how they are read: leave out such options")
    from sonosweep.cli.evaluate_job import run_evaluation
    from sonosweep.cli.output import say

    line, facts = run_evaluation(options, options.dataset, output, force)
    say(line, facts, json)


def _outputs(output: Path | None) -> tuple[Path, ...]:
    if output is None:
        return ()
    if output.suffix.lower() in (".json", ".csv"):
        return (output,)
    if output.is_dir():
        raise FormatError(f"'{output}' is a folder: name a file in it, ending with .json or .csv")
    if output.suffix:
        raise FormatError(f"'{output}' must end with .json or .csv, or with neither for both")
    return (output.with_suffix(".json"), output.with_suffix(".csv"))


def _trajectory(path: Path) -> "Trajectory":
    from sonosweep.io import read_trajectory

    return read_trajectory(path / "trajectory.csv" if path.is_dir() else path)


def _landmarks(scan: Path) -> "Tensor | None":
    """Return the landmarks of a TUS-REC scan; ``None`` for others and where there are none."""
    from sonosweep.io.hdf5_access import hdf5_holds
    from sonosweep.io.tusrec import find_tusrec_landmarks, is_tusrec, read_tusrec_landmarks

    if not (scan.is_file() and is_tusrec(scan)):
        return None
    file = find_tusrec_landmarks(scan)
    return read_tusrec_landmarks(scan, file) if file and hdf5_holds(file, scan.stem) else None
