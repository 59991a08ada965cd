"""A recipe carried out: devices, precision, checkpoints, going on after a kill.

A run's folder holds ``recipe.toml`` (every field), ``checkpoint.ckpt`` (to go on from),
``log.csv``, ``training.html``, and at the end ``weights.safetensors``.
"""

import logging
import os
import signal
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from importlib.util import find_spec
from math import isnan
from pathlib import Path
from typing import Any

import lightning.pytorch as lightning
import torch

from sonosweep.errors import FormatError, RecipeError, TrainingError
from sonosweep.estimators.network import FrameShape, MotionNetwork, WindowNetwork
from sonosweep.estimators.weights import Builder, WeightsInfo, save_weights
from sonosweep.training.log import LOG, read_log
from sonosweep.training.module import MotionModule
from sonosweep.training.recipe import Recipe, recipe_text
from sonosweep.training.scans import TrainingScan, data_digest, open_data
from sonosweep.training.sequences import (
    MotionStatistics,
    TrainingBatches,
    check_lengths,
    motion_statistics,
    pairs_done,
)
from sonosweep.training.validate import scan_metrics
from sonosweep.training.watch import CHECKPOINT, Progress, RunWatch, mean_metrics

RECIPE, WEIGHTS = "recipe.toml", "weights.safetensors"
ADVICE = (
    ".*does not have many workers.*",  # frames are in memory, or made by a thread
    ".*GPU available but not used.*",
    r".*isinstance\(treespec, LeafSpec\).*",
)
"""Warnings of Lightning's that say nothing to whoever trains."""


@dataclass(frozen=True, eq=False)
class TrainedRun:
    """What came out.

    Attributes:
        weights: File.
        metrics: Of the scans for validation, at the end; ``"rae_of_mean"`` is that of always
            giving the mean motion.
        pairs: How many pairs of frames were learnt from.
        parameters: Of the network.
        cpu_s: CPU time of this process from the first step on, validation included.
    """

    weights: Path
    metrics: dict[str, float]
    pairs: int
    parameters: int
    cpu_s: float


def train(
    recipe: Recipe,
    folder: str | os.PathLike,
    *,
    resume: bool = False,
    build: Builder | None = None,
    device: str = "auto",
    progress: Progress | None = None,
    preparing: Progress | None = None,
) -> TrainedRun:
    """Train a network and write its weights.

    Under ``torchrun`` all processes share each batch; otherwise there is one.

    Args:
        recipe: What to do.
        folder: Of the run.
        resume: Whether to go on where the run in the folder was stopped; from the beginning
            if it had not come to a checkpoint.
        build: What makes networks by name; ``None`` knows all of ours.
        device: ``"cpu"``, ``"cuda"``, or ``"auto"``: a GPU if there is one.
        progress: Called with the pairs learnt from and all of them.
        preparing: Called with the scans that are ready and all of them.

    Raises:
        RecipeError: If the recipe names no network of ours, or is not that of the run to go
            on with.
        ScanError: If the data cannot be learnt from.
        FormatError: If a file cannot be read or written.
        TrainingError: If the loss is not a number, or memory is short.
    """
    place = Path(folder)
    going_on = resume and (place / RECIPE).exists()
    checkpoint = _checkpoint(recipe, place) if going_on else None
    with _memory_is_short(recipe):
        pool, validation = open_data(recipe.data, recipe.input, preparing)
    check_lengths(pool, validation, recipe.stages)
    statistics = motion_statistics(pool, recipe.scale)
    torch.manual_seed(recipe.seed)
    module = MotionModule(_network(recipe, build), recipe, statistics)
    if not going_on:
        _begin(recipe, place)
    watch = RunWatch(place, recipe, validation, progress)
    with _memory_is_short(recipe), _quiet():
        trainer = _trainer(recipe, watch, device, place)
        batches = TrainingBatches(
            pool,
            recipe.stages,
            statistics,
            recipe.augment,
            recipe.seed,
            trainer.global_rank,
            trainer.world_size,
            lambda: trainer.global_step,
        )
        _fit(trainer, module, batches, checkpoint)
    # A finished run that is gone on with takes no step in which to measure.
    found = watch.metrics or mean_metrics(module.validate_scans(validation))
    metrics = {**found, "rae_of_mean": _mean_motion_rae(statistics, validation)}
    info = _info(recipe, module, statistics, validation[0], data_digest(pool, validation), metrics)
    if trainer.is_global_zero:
        save_weights(place / WEIGHTS, module.network, info)
    pairs = pairs_done(recipe.stages, recipe.steps)
    spent = max((row.get("cpu_s", 0.0) for row in read_log(place / LOG)), default=0.0)
    return TrainedRun(place / WEIGHTS, metrics, pairs, info.parameters, spent)


def _checkpoint(recipe: Recipe, folder: Path) -> Path | None:
    """Return the checkpoint to go on from, if the run in the folder came to one."""
    text, before = recipe_text(recipe), (folder / RECIPE).read_text(encoding="utf-8")
    if before != text:
        theirs = (a for a, b in zip(text.splitlines(), before.splitlines(), strict=False) if a != b)
        raise RecipeError(
            f"the run in '{folder}' had another recipe, beginning with '{next(theirs, '')}':"
            " go on with that one, or choose another folder"
        )
    checkpoint = folder / CHECKPOINT
    return checkpoint if checkpoint.exists() else None


def _begin(recipe: Recipe, folder: Path) -> None:
    """Leave the recipe in the folder, and nothing of a run that was there before."""
    if int(os.environ.get("RANK", "0")) > 0:  # one process writes
        return
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name in (CHECKPOINT, LOG, WEIGHTS):
            (folder / name).unlink(missing_ok=True)
        (folder / RECIPE).write_text(recipe_text(recipe), encoding="utf-8")
    except OSError as error:
        raise FormatError(f"cannot write to '{folder}': {error.strerror or error}") from error


def _network(recipe: Recipe, build: Builder | None) -> MotionNetwork:
    if build is None:
        from sonosweep.estimators.network_names import build_network

        build = build_network
    shape = FrameShape(recipe.input.count, recipe.input.rows, recipe.input.columns)
    chosen = recipe.network
    network = build(chosen.name, chosen.options, shape, chosen.preset)
    for number, stage in enumerate(recipe.stages):
        if isinstance(network, WindowNetwork) and stage.window != network.window:
            raise RecipeError(
                f"network '{chosen.name}' reads {network.window} frames at once: the window of"
                f" stage {number} must be that, not {stage.window}"
            )
    return network


def _trainer(
    recipe: Recipe, callback: lightning.Callback, device: str, folder: Path
) -> lightning.Trainer:
    gpu = device == "auto" and torch.cuda.is_available()
    if device == "cuda" and not torch.cuda.is_available():
        raise TrainingError("there is no GPU that PyTorch can use: leave out --device cuda")
    processes = int(os.environ.get("WORLD_SIZE", "1"))
    local = int(os.environ.get("LOCAL_WORLD_SIZE", "1"))
    logger: Any = False
    if find_spec("tensorboard") is not None:
        from lightning.pytorch.loggers import TensorBoardLogger

        logger = TensorBoardLogger(folder, name="tensorboard", version="")
    return lightning.Trainer(
        accelerator="gpu" if device == "cuda" or gpu else "cpu",
        devices=local,
        num_nodes=processes // local,
        strategy="ddp" if processes > 1 else "auto",
        precision="bf16-mixed" if recipe.precision == "bf16" else "32-true",
        max_steps=recipe.steps,
        max_epochs=-1,
        gradient_clip_val=recipe.optimizer.clip,
        callbacks=[callback],
        logger=logger,
        log_every_n_steps=1,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        num_sanity_val_steps=0,
        use_distributed_sampler=False,
        default_root_dir=folder,
    )


def _fit(
    trainer: lightning.Trainer,
    module: MotionModule,
    batches: TrainingBatches,
    checkpoint: Path | None,
) -> None:
    interrupt = signal.getsignal(signal.SIGINT)
    try:
        trainer.fit(module, batches, ckpt_path=checkpoint, weights_only=True)
    except SystemExit as left:  # which is how Lightning passes Ctrl-C on
        signal.signal(signal.SIGINT, interrupt)
        raise KeyboardInterrupt from left


def _mean_motion_rae(statistics: MotionStatistics, validation: Sequence[TrainingScan]) -> float:
    """Return the relative error of always giving the mean motion of the training scans."""
    found = [
        scan_metrics(statistics.mean.expand(len(scan.frames) - 1, 6).float(), scan)
        for scan in validation
    ]
    return mean_metrics(found)["rae"]


def _info(
    recipe: Recipe,
    module: MotionModule,
    statistics: MotionStatistics,
    scan: TrainingScan,
    digest: str,
    metrics: dict[str, float],
) -> WeightsInfo:
    return WeightsInfo(
        network=recipe.network.name,
        preset=recipe.network.preset,
        options=recipe.network.options,
        input=recipe.input,
        spacing_mm=scan.spacing_mm,
        center_mm=scan.center,
        window=max(stage.window for stage in recipe.stages),
        motion_scale=tuple(statistics.scale.tolist()),
        mean_motion=tuple(statistics.mean.tolist()),
        parameters=sum(p.numel() for p in module.network.parameters()),
        recipe=recipe_text(recipe),
        data=digest,
        metrics={name: None if isnan(value) else value for name, value in metrics.items()},
        made=datetime.now(UTC).date().isoformat(),
        version=version("sonosweep"),
    )


@contextmanager
def _memory_is_short(recipe: Recipe) -> Iterator[None]:
    """Turn a lack of memory into a sentence that names what to lower."""
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        words = str(error).lower()
        if isinstance(error, MemoryError) or "out of memory" in words or "allocate" in words:
            largest = max(recipe.stages, key=lambda stage: stage.batch * stage.window)
            raise TrainingError(
                f"out of memory: lower the batch ({largest.batch}) or window ({largest.window})"
                f" of stage {recipe.stages.index(largest)}, the input's rows and columns, or"
                " data.cache_gb"
            ) from error
        raise


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep Lightning's advice from the terminal."""
    loud = [logging.getLogger(name) for name in ("lightning.pytorch", "lightning.fabric")]
    levels = [logger.level for logger in loud]
    for logger in loud:
        logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            for words in ADVICE:
                warnings.filterwarnings("ignore", message=words)
            yield
    finally:
        for logger, level in zip(loud, levels, strict=True):
            logger.setLevel(level)
