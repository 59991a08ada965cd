"""``sonosweep evaluate``: how far an estimate is from the tracker."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from sonosweep.cli.inputs import OUTPUT, Force, InputOptions, Json, read
from sonosweep.errors import FormatError

if TYPE_CHECKING:
    from torch import Tensor

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

    The landmarks of a TUS-REC scan count too if they lie in the folders above it.

    Args:
        estimated: Trajectory (.csv, TUM, .igs.mha, .tfm), or a folder that `reconstruct` wrote.
        tracked: The tracked scan.
        output: Where to write the numbers: .json or .csv; both with no suffix.
    """
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
