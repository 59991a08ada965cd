"""Scans, recipes and networks that take milliseconds."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from sonosweep.estimators.network import (
    FrameShape,
    MotionNetwork,
    NetworkOutput,
    RecurrentNetwork,
    WindowNetwork,
)
from sonosweep.geometry import poses_from_steps, step_from_motion, steps_from_poses
from sonosweep.io.hdf5 import write_scan
from sonosweep.scan import Calibration, Scan
from sonosweep.training.recipe import Recipe

SIDE_PX = 32
MEAN_MOTION = (0.0, 0.0, 0.3, 0.0, 0.0, 0.0)
SPREAD = (0.1, 0.05, 0.1, 0.003, 0.003, 0.002)


class TinyRecurrent(RecurrentNetwork):
    """Two heads on the difference of two frames; part of it is dropped while training."""

    def __init__(self, shape: FrameShape, drop: float = 0.1) -> None:
        super().__init__()
        self.frame_shape = shape
        self.conv = nn.Conv2d(shape.channels, 4, 5, stride=4)
        self.drop = nn.Dropout(drop)
        self.lstm = nn.LSTM(8, 8, batch_first=True)
        self.first, self.second = nn.Linear(8, 6), nn.Linear(8, 6)

    def encode(self, frames: Tensor) -> tuple[Tensor, ...]:
        """Return a few features."""
        return (self.conv(frames),)

    def compare(self, first: tuple[Tensor, ...], second: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        """Return their means, and those of their difference."""
        together = torch.cat((first[0], (second[0] - first[0]).abs()), dim=1)
        return (self.drop(together.mean((-2, -1))),)

    def regress(
        self, pairs: tuple[Tensor, ...], state: tuple[Tensor, ...] | None
    ) -> tuple[NetworkOutput, tuple[Tensor, ...]]:
        """Return two heads and their mean."""
        hidden, after = self.lstm(pairs[0], state)
        heads = (self.first(hidden), self.second(hidden))
        motion = (heads[0] + heads[1]) / 2
        return NetworkOutput(motion, heads, embedding=hidden[:, -1]), after


class TinyWindow(WindowNetwork):
    """A linear map of the means of three frames."""

    window = 3

    def __init__(self, shape: FrameShape) -> None:
        super().__init__()
        self.frame_shape = shape
        self.linear = nn.Linear(3, 12)

    def forward(self, frames: Tensor) -> NetworkOutput:
        """Return motions that depend on brightness alone."""
        motion = self.linear(frames.mean((2, 3, 4))).unflatten(1, (2, 6))
        return NetworkOutput(motion, (motion,))


class Broken(WindowNetwork):
    """Fine at first; later its answer, or the slope of it, is not a number."""

    window = 2

    def __init__(self, shape: FrameShape, after: int, infinite_slope: bool) -> None:
        super().__init__()
        self.frame_shape = shape
        self.weight = nn.Parameter(torch.ones(6))
        self.left, self.infinite_slope = after, infinite_slope

    def forward(self, frames: Tensor) -> NetworkOutput:
        """Return the weights, and in training after a while what is no number."""
        steps = frames.shape[1] - 1
        motion = self.weight.expand(len(frames), steps, 6)
        if self.training:
            self.left -= 1
        if self.left < 0:
            root = (self.weight - self.weight.detach()).abs().sqrt()  # infinite slope at 0
            motion = motion + root if self.infinite_slope else motion * torch.nan
        return NetworkOutput(motion, (motion,))


def build(name: str, options: Mapping[str, Any], shape: FrameShape, preset: str) -> MotionNetwork:
    """Return a network of this file by name."""
    if name == "window":
        return TinyWindow(shape)
    if name == "broken":
        return Broken(shape, int(options["after"]), bool(options["infinite_slope"]))
    return TinyRecurrent(shape, **options)


def tiny_scan(
    seed: int, frames: int = 12, subject: str | None = None, side_px: int = SIDE_PX, **fields: Any
) -> Scan:
    """Return a tracked scan of noise."""
    draw = np.random.default_rng(seed)
    motion = np.array(MEAN_MOTION) + draw.normal(0, SPREAD, (frames - 1, 6))
    steps = step_from_motion(torch.from_numpy(motion))
    return Scan(
        name=f"scan{seed}",
        frames=draw.integers(0, 256, (frames, side_px, side_px), dtype=np.uint8),
        calibration=Calibration((0.3, 0.2)),
        image_to_reference=poses_from_steps(steps, torch.eye(4, dtype=torch.float64)),
        subject=subject or f"subject{seed}",
        **fields,
    )


def tiny_files(folder: Path, count: int = 3) -> list[str]:
    """Write scans of different subjects and return their paths."""
    return write_files(folder, [tiny_scan(seed) for seed in range(count)])


def telling_files(folder: Path, count: int = 3) -> list[str]:
    """Write scans whose brightness tells how far the probe went."""
    return write_files(folder, [telling_scan(seed) for seed in range(count)])


def telling_scan(seed: int) -> Scan:
    """Return a scan whose gray level goes up and down by 100 for each mm of elevation."""
    scan = tiny_scan(seed, frames=60)
    assert scan.image_to_reference is not None
    steps = steps_from_poses(scan.image_to_reference)
    way_mm = np.concatenate(([0.0], steps[:, 2, 3].numpy().cumsum()))
    level = 25 + 100 * np.abs(way_mm % 4 - 2)
    frames = np.broadcast_to(level[:, None, None], scan.frames.shape).astype(np.uint8)
    return replace(scan, frames=frames)


def write_files(folder: Path, scans: Sequence[Scan]) -> list[str]:
    """Write scans and return their paths."""
    for scan in scans:
        write_scan(scan, folder / f"{scan.name}.h5")
    return [str(folder / f"{scan.name}.h5") for scan in scans]


def tiny_recipe(files: list[str], **changes: Any) -> Recipe:
    """Return a recipe of ten steps; the last file is for validation."""
    content: dict[str, Any] = {
        "network": {"name": "tiny"},
        "input": {"rows": SIDE_PX, "columns": SIDE_PX},
        "data": {"train": files[:-1], "validation": files[-1:]},
        "stages": [
            {"pairs": 24, "window": 2, "batch": 4, "learning_rate": 1e-2},
            {"pairs": 24, "window": 4, "batch": 2, "learning_rate": 1e-3},
        ],
        "precision": "fp32",
        "validations": 2,
    }
    return Recipe.model_validate(content | changes)
