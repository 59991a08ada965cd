"""What is compared with what: methods that turn a scan into a trajectory.

A method can be sent to another process, and its digest changes with whatever its answer
depends on, so that results can be kept.
"""

import hashlib
from abc import ABC, abstractmethod
from dataclasses import asdict, dataclass
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from sonosweep.errors import ScanError
from sonosweep.estimators import DecorrelationCurve, DecorrelationEstimator
from sonosweep.estimators.estimator import Progress
from sonosweep.geometry import (
    motion_from_step,
    poses_from_steps,
    step_from_motion,
    steps_from_poses,
)
from sonosweep.io.source_digest import source_digest
from sonosweep.reconstruct import estimate_trajectory
from sonosweep.reconstruct.estimate import MIRRORED as OUT_OF_PLANE
from sonosweep.scan import Scan, Trajectory

ANSWERING = (
    "geometry",
    "scan",
    "imaging",
    "metrics",
    "estimators",
    "reconstruct",
    "evaluate/compare.py",
    "evaluate/methods.py",
)
"""Parts of the program that an answer, or how it is measured, depends on."""

Kind = Literal["plain", "oracle", "network"]
Motion = tuple[float, float, float, float, float, float]


@dataclass(frozen=True)
class Method(ABC):
    """One way from frames to poses.

    Attributes:
        name: Row of the table.
    """

    name: str

    @property
    def kind(self) -> Kind:
        """``"oracle"`` if it looks at the tracker, which only a yardstick may."""
        return "plain"

    @property
    def run(self) -> str:
        """Which of several trainings of one network; empty for everything else."""
        return ""

    @property
    def origin(self) -> dict[str, str]:
        """What a row of the table says about it beside its name."""
        return {"weights": "", "arithmetic": ""}

    @abstractmethod
    def trajectory(self, scan: Scan, progress: Progress | None = None) -> Trajectory:
        """Return the poses of a scan.

        Raises:
            ScanError: If the scan cannot be used.
        """

    def digest(self) -> str:
        """Return a text that differs for methods that may answer differently."""
        return _text_digest(type(self).__name__, sorted(asdict(self).items()))


@dataclass(frozen=True)
class NoMotion(Method):
    """Says that the probe never moved."""

    name: str = "no motion"

    def trajectory(self, scan: Scan, progress: Progress | None = None) -> Trajectory:
        """Return the same pose for every frame."""
        return _steady(scan, torch.zeros(6, dtype=torch.float64))


@dataclass(frozen=True)
class MeanMotion(Method):
    """Gives every step the mean motion of other scans.

    Attributes:
        name: Row of the table.
        motion: Mean of a step, mm and rad.
    """

    name: str = "mean motion of the training scans"
    motion: Motion = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

    def trajectory(self, scan: Scan, progress: Progress | None = None) -> Trajectory:
        """Return a steady movement."""
        return _steady(scan, torch.tensor(self.motion, dtype=torch.float64))


@dataclass(frozen=True)
class TrueMean(Method):
    """Gives every step the true mean motion of its own sweep, which nobody knows."""

    name: str = "true mean of each sweep (oracle)"

    @property
    def kind(self) -> Kind:
        """It looks at the tracker."""
        return "oracle"

    def trajectory(self, scan: Scan, progress: Progress | None = None) -> Trajectory:
        """Return a steady movement as fast as the tracked one."""
        return _steady(scan, tracked_motion(scan).mean(0))


@dataclass(frozen=True)
class Decorrelation(Method):
    """The estimator from speckle alone.

    Attributes:
        name: Row of the table.
        curve: ``None`` guesses the elevational scale from the size of the speckle.
        direction: 1 if the probe sweeps towards +z, -1 if the other way.
        stretch: By which what was seen out of the plane, shifts and turns, is multiplied: a
            scale that was measured on other scans.
    """

    name: str = "decorrelation, scale guessed"
    curve: DecorrelationCurve | None = None
    direction: int = 1
    stretch: float = 1.0

    def trajectory(self, scan: Scan, progress: Progress | None = None) -> Trajectory:
        """Return what the speckle says."""
        found = estimate_trajectory(
            scan, DecorrelationEstimator(self.curve), self.direction, progress
        )
        if self.stretch == 1:
            return found
        motion = motion_from_step(steps_from_poses(found.image_to_reference))
        motion[:, OUT_OF_PLANE] *= self.stretch
        poses = poses_from_steps(step_from_motion(motion), found.image_to_reference[0])
        return Trajectory(poses, timestamps_s=scan.timestamps_s, assumptions=found.assumptions)


@dataclass(frozen=True)
class Network(Method):
    """A trained network.

    Attributes:
        name: Row of the table; several trainings of one network share it.
        weights: The file.
        training: Which of these trainings.
        direction: -1 if the probe sweeps the other way than it did in training.
    """

    weights: Path
    training: str = ""
    direction: int = 1

    @property
    def kind(self) -> Kind:
        """It learned."""
        return "network"

    @property
    def run(self) -> str:
        """Which training."""
        return self.training

    def trajectory(self, scan: Scan, progress: Progress | None = None) -> Trajectory:
        """Return what the network reads off the frames."""
        from sonosweep.estimators.learned import LearnedEstimator

        return estimate_trajectory(scan, LearnedEstimator(self.weights), self.direction, progress)

    def digest(self) -> str:
        """Return a text that depends on what the file holds, not on what it is called."""
        return _text_digest(self.content, self.direction, self.arithmetic)

    @cached_property
    def content(self) -> str:
        """Digest of the file."""
        return file_digest(self.weights)

    @cached_property
    def arithmetic(self) -> str:
        """Precision and device."""
        from sonosweep.estimators.learned import LearnedEstimator

        return LearnedEstimator(self.weights).arithmetic

    @property
    def origin(self) -> dict[str, str]:
        """Which weights, by their file's digest, and how they are worked with."""
        return {"weights": self.content[:12], "arithmetic": self.arithmetic}


def tracked_motion(scan: Scan) -> Tensor:
    """Return the motion (mm, rad) of each step between two tracked frames.

    Raises:
        ScanError: If there is none.
    """
    poses = scan.image_to_reference
    if poses is None or len(poses) < 2:
        raise ScanError(f"'{scan.name}' has no tracked steps")
    flags = torch.ones(len(poses), dtype=torch.bool) if scan.tracked is None else scan.tracked
    both = flags[1:] & flags[:-1]
    if not bool(both.any()):
        raise ScanError(f"'{scan.name}' has no tracked steps")
    return motion_from_step(steps_from_poses(poses.double())[both])


def code_digest() -> str:
    """Return a short text that differs for other code that answers depend on."""
    return hashlib.sha256(
        f"{version('sonosweep')} {source_digest(*ANSWERING)}".encode()
    ).hexdigest()[:12]


def file_digest(path: Path) -> str:
    """Return a text that differs for files with other content."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()[:32]


def _text_digest(*facts: object) -> str:
    return hashlib.sha256(repr((code_digest(), *facts)).encode()).hexdigest()[:32]


def _steady(scan: Scan, motion: Tensor) -> Trajectory:
    """Return the trajectory in which every step has this motion."""
    step = step_from_motion(motion).expand(len(scan.frames) - 1, 4, 4)
    first = torch.eye(4, dtype=torch.float64)
    return Trajectory(poses_from_steps(step, first), timestamps_s=scan.timestamps_s)
