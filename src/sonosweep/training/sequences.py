"""Batches of windows, drawn at random and the same for the same seed.

Every scan gives one window with a random start in each round over the scans, as in the
paper. Which window is the n-th of a run follows from the seed and n alone, so that a run
can go on where it was killed, and several processes can share it.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Num
from torch import Tensor

from sonosweep.errors import ScanError
from sonosweep.geometry import motion_from_step, steps_from_poses
from sonosweep.training.augment import (
    AugmentSettings,
    draw_looks,
    mirror_lateral,
    reverse_in_elevational_mirror,
)
from sonosweep.training.recipe import Stage
from sonosweep.training.scans import ScanPool, TrainingScan

FLIPPED = 0.5  # share of the windows that are seen in a mirror
SPREAD_PERCENTILE = 98.0  # of |motion|; the released code's scale


class Batch(NamedTuple):
    """Windows to learn from.

    Attributes:
        frames: As stored: uint8, or float16 from 0 to 1.
        motion: Of each step, in scaled units.
        looks: Changes of the image, see :mod:`sonosweep.training.augment`.
    """

    frames: Num[Tensor, "batch frames channels rows columns"]
    motion: Float[Tensor, "batch steps motion=6"]
    looks: Float[Tensor, "batch looks=5"]


@dataclass(frozen=True, eq=False)
class MotionStatistics:
    """What motions of the training scans are like.

    Attributes:
        scale: Of each of the six numbers (mm, rad).
        mean: Of each of them.
    """

    scale: Float[Tensor, "motion=6"]
    mean: Float[Tensor, "motion=6"]


@dataclass(frozen=True)
class Step:
    """One change of the weights.

    Attributes:
        stage: Number of its stage.
        first_window: Number of its first window among all of the run.
        share: Of the stage that is done, 0 to 1.
    """

    stage: int
    first_window: int
    share: float


class TrainingBatches:
    """The batches of a run, from any step on.

    Args:
        pool: Scans to draw from.
        stages: Of the recipe.
        statistics: Motions are divided by their scale.
        augment: How windows are changed.
        seed: Of all that is random.
        rank: Number of this process.
        processes: How many share each batch.
        first_step: Asked when batches are begun with: the step that is to come.
    """

    def __init__(
        self,
        pool: ScanPool,
        stages: Sequence[Stage],
        statistics: MotionStatistics,
        augment: AugmentSettings,
        seed: int,
        rank: int = 0,
        processes: int = 1,
        first_step: Callable[[], int] = lambda: 0,
    ) -> None:
        self._pool, self._stages, self._statistics = pool, tuple(stages), statistics
        self._augment, self._seed = augment, seed
        self._rank, self._processes, self._first_step = rank, processes, first_step
        for stage in stages:
            if stage.batch % processes:
                raise ScanError(
                    f"a batch of {stage.batch} cannot be shared by {processes} processes: make"
                    " it a multiple"
                )

    def __iter__(self) -> Iterator[Batch]:
        """Give the batches that are to come; the next is made while one is used."""
        total = sum(stage.steps for stage in self._stages)
        with ThreadPoolExecutor(max_workers=1) as worker:
            coming: Future[Batch] | None = None
            for step in range(self._first_step(), total):
                coming = coming or worker.submit(self.batch, step)
                batch = coming.result()
                coming = worker.submit(self.batch, step + 1) if step + 1 < total else None
                yield batch

    def batch(self, step: int) -> Batch:
        """Return this process's share of the batch of a step."""
        place = step_place(self._stages, step)
        stage = self._stages[place.stage]
        share = stage.batch // self._processes
        first = place.first_window + self._rank * share
        windows = [self._window(number, stage) for number in range(first, first + share)]
        poses = torch.stack([w.scan.poses[torch.from_numpy(w.frames)] for w in windows])
        motion = motion_from_step(steps_from_poses(poses))
        mirrored = torch.tensor([w.mirrored for w in windows])[:, None, None]
        backward = torch.tensor([w.backward for w in windows])[:, None, None]
        motion = torch.where(mirrored, mirror_lateral(motion), motion)
        motion = torch.where(backward, reverse_in_elevational_mirror(motion), motion)
        return Batch(
            torch.from_numpy(np.stack([_pixels(window) for window in windows])),
            (motion / self._statistics.scale).float(),
            torch.from_numpy(np.stack([window.looks for window in windows])),
        )

    def _window(self, number: int, stage: Stage) -> "_Window":
        """Return the n-th window of the run."""
        epoch, turn = divmod(number, len(self._pool))
        order = np.random.default_rng((self._seed, 0, epoch)).permutation(len(self._pool))
        scan = self._pool.scan(epoch, int(order[turn]))
        draw = np.random.default_rng((self._seed, 1, number))
        frames = draw_window(scan, stage, draw)
        flips = draw.random(2) < FLIPPED
        return _Window(
            scan,
            frames,
            bool(flips[0]) and self._augment.mirror,
            bool(flips[1]) and self._augment.reverse,
            draw_looks(self._augment, draw),
        )


@dataclass(frozen=True, eq=False)
class _Window:
    """A window and how it is changed.

    Attributes:
        scan: Where it is from.
        frames: Their numbers.
        mirrored: Whether it is seen in a lateral mirror.
        backward: Whether it is played backwards, in an elevational mirror.
        looks: Changes of the image.
    """

    scan: TrainingScan
    frames: np.ndarray
    mirrored: bool
    backward: bool
    looks: np.ndarray


def _pixels(window: _Window) -> np.ndarray:
    pixels = window.scan.stack(window.frames)
    if window.mirrored:
        pixels = pixels[..., ::-1]
    return pixels[::-1] if window.backward else pixels


def check_lengths(
    pool: ScanPool, validation: Sequence[TrainingScan], stages: Sequence[Stage]
) -> None:
    """Check that every scan has a window for each stage, and those for validation a step.

    Raises:
        ScanError: If not.
    """
    for place in range(len(pool)):
        scan = pool.scan(0, place)
        for stage in stages:
            if not any(len(scan.starts(stage.window, stride)) for stride in stage.strides):
                raise _too_short(scan, stage.window)
    for scan in validation:
        if not len(scan.starts(2)):
            raise ScanError(f"'{scan.name}' has no two tracked frames in a row to measure on")


def _too_short(scan: TrainingScan, window: int) -> ScanError:
    return ScanError(
        f"'{scan.name}' has no {window} tracked frames in a row: shorten the window of the stage,"
        " or leave the scan out"
    )


def draw_window(scan: TrainingScan, stage: Stage, draw: np.random.Generator) -> np.ndarray:
    """Return the numbers of a window's frames, its start and stride drawn at random.

    Raises:
        ScanError: If the scan is shorter than the window.
    """
    starts = {stride: scan.starts(stage.window, stride) for stride in stage.strides}
    strides = [stride for stride, found in starts.items() if len(found)]
    if not strides:
        raise _too_short(scan, stage.window)
    stride = strides[int(draw.integers(len(strides)))]
    start = starts[stride][int(draw.integers(len(starts[stride])))]
    return start + stride * np.arange(stage.window)


def step_place(stages: Sequence[Stage], step: int) -> Step:
    """Return where in the run a step is.

    Raises:
        ScanError: If the run has fewer steps.
    """
    left, windows = step, 0
    for number, stage in enumerate(stages):
        if left < stage.steps:
            return Step(number, windows + left * stage.batch, left / stage.steps)
        left -= stage.steps
        windows += stage.steps * stage.batch
    raise ScanError(f"a run of {step - left} steps has no step {step}")


def pairs_done(stages: Sequence[Stage], step: int) -> int:
    """Return how many pairs of frames were learnt from before a step."""
    pairs, left = 0, step
    for stage in stages:
        done = min(left, stage.steps)
        pairs += done * stage.batch * (stage.window - 1)
        left -= done
    return pairs


def motion_statistics(pool: ScanPool, kind: str = "percentile") -> MotionStatistics:
    """Return the scale and mean of the motions of the scans of the first round.

    Args:
        pool: Scans to train on, and no others.
        kind: ``"percentile"`` of the size, or standard ``"deviation"``.

    Raises:
        ScanError: If one of the six numbers never changes.
    """
    motions = []
    for place in range(len(pool)):
        scan = pool.scan(0, place)
        motions.append(scan.motion()[scan.starts(2)])
    motion = torch.cat(motions)
    if not len(motion):
        raise ScanError("the scans to train on have no tracked frames in a row")
    if kind == "percentile":
        scale = torch.from_numpy(np.percentile(motion.abs().numpy(), SPREAD_PERCENTILE, axis=0))
    else:
        scale = motion.std(0)
    if not bool((scale > 0).all()):
        raise ScanError("a part of the motion is the same in all training scans: nothing to learn")
    return MotionStatistics(scale, motion.mean(0))
