"""``sonosweep evaluate``: how far an estimate is from the tracker."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from sonosweep.cli.inputs import OUTPUT, Force, InputOptions, Json, read

if TYPE_CHECKING:
    from sonosweep.scan import Trajectory


def evaluate(
    estimated: Path,
    tracked: Path,
    /,
    *,
    output: Annotated[Path | None, Parameter(name=["--output", "-o"], group=OUTPUT)] = None,
    inputs: InputOptions | None = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """Compare an estimated trajectory with the tracked poses of the scan it came from.

    Args:
        estimated: Trajectory (.csv, TUM, .igs.mha, .tfm), or a folder that `reconstruct` wrote.
        tracked: The tracked scan.
        output: Where to write the numbers: .json or .csv; both with no suffix.
    """
    from sonosweep.cli.output import check_free, say
    from sonosweep.evaluate import compare_trajectories, write_comparison

    paths = _outputs(output)
    for path in paths:
        check_free(path, force)
    scan = read(tracked, inputs)
    result = compare_trajectories(_trajectory(estimated), scan)
    for path in paths:
        write_comparison(result, path)
    say(result.table(), result.as_dict(), json)


def _outputs(output: Path | None) -> tuple[Path, ...]:
    if output is None:
        return ()
    if output.suffix:
        return (output,)
    return (output.with_suffix(".json"), output.with_suffix(".csv"))


def _trajectory(path: Path) -> "Trajectory":
    from sonosweep.io import read_trajectory

    return read_trajectory(path / "trajectory.csv" if path.is_dir() else path)
