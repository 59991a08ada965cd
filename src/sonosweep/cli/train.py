"""``sonosweep train``: a motion network from a recipe."""

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from sonosweep.cli.inputs import OUTPUT, Force, Json


def train(
    recipe: Path,
    *,
    output: Annotated[Path | None, Parameter(name=["--output", "-o"], group=OUTPUT)] = None,
    set: Annotated[tuple[str, ...], Parameter(negative="")] = (),
    resume: Annotated[bool, Parameter(negative="")] = False,
    device: Literal["auto", "cpu", "cuda"] = "auto",
    force: Force = False,
    json: Json = False,
) -> None:
    """Train a motion network from a recipe.

    For several GPUs or machines, start it with torchrun: `torchrun --nproc-per-node 4
    -m sonosweep train RECIPE -o RUN`.

    Args:
        recipe: A TOML file; recipes/ holds those of the published weights.
        output: Folder of the run; otherwise runs/ and the recipe's name.
        set: A field of the recipe to change, as in network.name=cnn; may be repeated.
        resume: Go on with the run in the folder where it was stopped.
        device: Where to compute; auto takes a GPU if there is one.
    """
    from sonosweep.cli.output import say
    from sonosweep.cli.train_job import run_training

    folder = output or Path("runs") / recipe.stem
    line, facts = run_training(recipe, folder, set, resume, device, force)
    if line:
        say(line, facts, json)
