"""What is done between the steps of a run: log, validation, checkpoints."""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import lightning.pytorch as lightning
import numpy as np
import torch

from sonosweep.training.log import RunLog
from sonosweep.training.module import MotionModule, learning_rate
from sonosweep.training.recipe import Recipe
from sonosweep.training.scans import TrainingScan
from sonosweep.training.sequences import pairs_done

CHECKPOINT = "checkpoint.ckpt"
LOGGED_STEPS = 200  # lines in the log of a run, about

Progress = Callable[[int, int], None]
"""Called with (done, total) as a long computation goes on."""


class RunWatch(lightning.Callback):
    """What is done between the steps: progress, log, validation, checkpoints."""

    def __init__(
        self,
        folder: Path,
        recipe: Recipe,
        validation: Sequence[TrainingScan],
        progress: Progress | None,
    ) -> None:
        self._folder, self._recipe, self._validation = folder, recipe, validation
        self._progress = progress
        self._log_every = max(1, recipe.steps // LOGGED_STEPS)
        self._validate_every = max(1, recipe.steps // recipe.validations)
        self._saved_s = time.monotonic()
        self._sums: dict[str, float] = {}
        self._count = 0
        self.metrics: dict[str, float] = {}

    def on_train_start(self, trainer: lightning.Trainer, module: lightning.LightningModule) -> None:
        """Begin the log, or go on with it."""
        if trainer.is_global_zero:
            self._log = RunLog(self._folder, self._recipe, trainer.global_step)
        self._saved_s = time.monotonic()

    def on_train_batch_end(
        self,
        trainer: lightning.Trainer,
        module: lightning.LightningModule,
        outputs: Any,  # Any: whatever training_step gave
        batch: Any,
        batch_idx: int,
    ) -> None:
        """Do what is due after a step."""
        assert isinstance(module, MotionModule)
        step = trainer.global_step
        for name, value in module.latest.items():
            self._sums[name] = self._sums.get(name, 0.0) + value
        self._count += 1
        last = step >= self._recipe.steps
        validates = step % self._validate_every == 0 or last
        if step % self._log_every == 0 or validates:
            self._report(trainer, module, step, validates)
        if self._is_checkpoint_due(trainer) or validates:
            save_checkpoint(trainer, self._folder / CHECKPOINT)
            self._saved_s = time.monotonic()

    def _report(
        self, trainer: lightning.Trainer, module: MotionModule, step: int, validates: bool
    ) -> None:
        row = {name: total / self._count for name, total in self._sums.items()}
        row["learning_rate"] = learning_rate(self._recipe.stages, step - 1)
        self._sums, self._count = {}, 0
        if validates:
            self.metrics = mean_metrics(
                gathered(
                    module.validate_scans(
                        self._validation[trainer.global_rank :: trainer.world_size]
                    ),
                    trainer,
                )
            )
            row |= self.metrics
        if not trainer.is_global_zero:
            return
        pairs = pairs_done(self._recipe.stages, step)
        self._log.write(step, pairs, row)
        if trainer.logger is not None:
            trainer.logger.log_metrics(row, step)
        if self._progress is not None:
            self._progress(pairs, pairs_done(self._recipe.stages, self._recipe.steps))

    def _is_checkpoint_due(self, trainer: lightning.Trainer) -> bool:
        due = time.monotonic() - self._saved_s > 60 * self._recipe.checkpoint_minutes
        return bool(trainer.strategy.broadcast(due)) if trainer.world_size > 1 else due


def save_checkpoint(trainer: lightning.Trainer, path: Path) -> None:
    """Write a checkpoint that is whole or not there; called by all processes."""
    temporary = path.with_name(f".writing-{path.name}")
    trainer.save_checkpoint(temporary)
    if trainer.is_global_zero:
        temporary.replace(path)


def gathered(found: list[dict[str, float]], trainer: lightning.Trainer) -> list[dict[str, float]]:
    """Return what all processes found together."""
    if trainer.world_size == 1:
        return found
    everyone: list[list[dict[str, float]]] = [[] for _ in range(trainer.world_size)]
    torch.distributed.all_gather_object(everyone, found)
    return [one for theirs in everyone for one in theirs]


def mean_metrics(found: Sequence[dict[str, float]]) -> dict[str, float]:
    """Return the mean over scans of each number."""
    return {name: float(np.mean([one[name] for one in found])) for name in found[0]}
