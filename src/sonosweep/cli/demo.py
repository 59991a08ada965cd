"""``sonosweep demo``: the whole job on the sweep that comes with the package."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from sonosweep.cli.inputs import OUTPUT, Force, Json


def demo(
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"], group=OUTPUT)] = Path("demo"),
    force: Force = False,
    json: Json = False,
) -> None:
    """Reconstruct a real liver sweep twice: with its tracked poses, and from images alone.

    Writes both volumes, both trajectories and report.html, which shows them, their
    difference, and how good or bad the sensorless result is.

    Args:
        output: Folder to write.
    """
    from sonosweep.cli.demo_job import run_demo
    from sonosweep.cli.output import say, whole_folder

    with whole_folder(output, force) as temporary:
        result = run_demo(temporary)
    say(
        f"{result.line}\nOpen {output / 'report.html'} in a browser.",
        {**result.summary, "output": str(output)},
        json,
    )
