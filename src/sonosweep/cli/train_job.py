"""The work of ``sonosweep train``."""

import os
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from sonosweep.cli.output import check_free
from sonosweep.cli.progress import progress
from sonosweep.errors import TrainingError
from sonosweep.training.recipe import read_recipe


def run_training(
    path: Path, folder: Path, changes: tuple[str, ...], resume: bool, device: str, force: bool
) -> tuple[str, dict[str, Any]]:
    """Train as a recipe says; return what to say, and as facts: nothing in a helping process.

    Raises:
        TrainingError: If what training needs is not installed, or it cannot go on.
    """
    if find_spec("lightning") is None:
        raise TrainingError("training needs Lightning: pip install 'sonosweep[train]'")
    recipe = read_recipe(path, changes)
    first = os.environ.get("RANK", "0") == "0"
    if first and not resume:
        check_free(folder, force)
    from sonosweep.training.run import train

    shows = _Shows()
    try:
        run = train(
            recipe,
            folder,
            resume=resume,
            device=device,
            preparing=shows.of("reading scans, scans") if first else None,
            progress=shows.of(f"training {recipe.network.name}, pairs") if first else None,
        )
    finally:
        shows.close()
    if not first:
        return "", {}
    found = run.metrics
    line = (
        f"{recipe.network.name}, {run.parameters / 1e6:.2f} M parameters, {run.pairs} pairs in"
        f" {run.cpu_s / 60:.1f} CPU-minutes:"
        f" elevational correlation {found['r_elevational']:.3f}, rAE {found['rae']:.4f} (mean"
        f" motion {found['rae_of_mean']:.4f}), FDR {found['fdr']:.1f} % in validation ->"
        f" {run.weights}"
    )
    facts = {
        "network": recipe.network.name,
        "parameters": run.parameters,
        "pairs": run.pairs,
        "cpu_s": run.cpu_s,
        "metrics": found,
        "weights": run.weights,
    }
    return line, facts


class _Shows:
    """Progress of one task after the other."""

    def __init__(self) -> None:
        self._open: Any = None  # a context that is entered
        self._task = ""

    def of(self, task: str) -> Callable[[int, int], None]:
        """Return what to call as a task goes on; it ends the one before."""

        def show(done: int, total: int) -> None:
            if self._task != task:
                self.close()
                self._task, self._open = task, progress(task)
                self._show = self._open.__enter__()
            self._show(done, total)

        return show

    def close(self) -> None:
        """End the task that goes on."""
        if self._open is not None:
            self._open.__exit__(None, None, None)
            self._open = None
