"""Scans as training reads them, and where they come from."""

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from torch import Tensor

from sonosweep.errors import ScanError
from sonosweep.estimators.network_input import (
    COMPANIONS,
    InputSettings,
    center_mm,
    center_poses,
    network_frames,
    network_scan,
)
from sonosweep.geometry import motion_from_step, steps_from_poses
from sonosweep.io import open_scan
from sonosweep.scan import Frames, Scan
from sonosweep.scan.split import Split
from sonosweep.simulate import dataset_files, dataset_recipe, refuse_test_subjects
from sonosweep.simulate.datasets import PlannedScan, program_digest
from sonosweep.simulate.planned_sweep import planned_body, simulate_planned
from sonosweep.training.recipe import DataRecipe, SimulatedData

SPACING_TOLERANCE = 0.01  # of the pixel size, by which scans that are learnt from may differ
LAST_SEED = 99
SHUFFLE = 7  # has no divisor in common with the scans of a data set: neighbors differ

Progress = Callable[[int, int], None]


@dataclass(frozen=True, eq=False)
class TrainingScan:
    """A scan whose frames are as a network reads them.

    Attributes:
        name: Of the scan.
        subject: Who was scanned.
        frames: ``(frames, channels, rows, columns)``; an array if they are in memory.
        poses: Of the centre of the frame in the reference.
        tracked: Which of them are known.
        image_poses: Of the image, as in scans.
        spacing_mm: Of the pixels, lateral and axial.
        center: Of the frame, in image coordinates.
    """

    name: str
    subject: str
    frames: Frames
    poses: Float[Tensor, "frames 4 4"]
    tracked: Bool[np.ndarray, " frames"]
    image_poses: Float[Tensor, "frames 4 4"]
    spacing_mm: tuple[float, float]
    center: tuple[float, float]

    def starts(self, window: int, stride: int = 1) -> np.ndarray:
        """Return the frames with which a window of tracked frames can begin."""
        reach = (window - 1) * stride
        count = len(self.frames) - reach
        if count < 1:
            return np.zeros(0, dtype=int)
        usable = np.ones(count, dtype=bool)
        for offset in range(0, reach + 1, stride):
            usable &= self.tracked[offset : offset + count]
        return np.flatnonzero(usable)

    def motion(self) -> Float[Tensor, "steps motion=6"]:
        """Return the motion (mm, rad) of each step; that of frames not tracked is NaN."""
        return motion_from_step(steps_from_poses(self.poses))

    def stack(self, frames: np.ndarray) -> np.ndarray:
        """Return these frames."""
        if isinstance(self.frames, np.ndarray):
            return self.frames[frames]
        return np.stack([self.frames[int(frame)] for frame in frames])

    def digest(self) -> bytes:
        """Return bytes that differ for other scans."""
        facts = repr((self.name, self.subject, self.frames.shape, self.spacing_mm)).encode()
        first = np.ascontiguousarray(self.frames[0]).tobytes()
        return hashlib.sha256(facts + self.poses.numpy().tobytes() + first).digest()


class ScanPool(ABC):
    """Scans to draw windows from; which they are may change from round to round."""

    @abstractmethod
    def __len__(self) -> int:
        """Return how many there are in each round."""

    @abstractmethod
    def scan(self, epoch: int, place: int) -> TrainingScan:
        """Return one of them, the same whenever it is asked for."""

    @abstractmethod
    def digest(self) -> bytes:
        """Return bytes that differ for pools with other scans."""


class FixedScans(ScanPool):
    """The same scans in every round."""

    def __init__(self, scans: Sequence[TrainingScan]) -> None:
        self._scans = tuple(scans)

    def __len__(self) -> int:
        """Return how many there are."""
        return len(self._scans)

    def scan(self, epoch: int, place: int) -> TrainingScan:
        """Return the scan of a place."""
        return self._scans[place]

    def digest(self) -> bytes:
        """Return bytes made of those of the scans."""
        return b"".join(scan.digest() for scan in self._scans)


class SimulatedScans(ScanPool):
    """Scans made when they are first asked for, which give way to others one by one."""

    def __init__(self, data: SimulatedData, settings: InputSettings) -> None:
        self._data, self._settings = data, settings
        self._made: dict[int, tuple[int, TrainingScan]] = {}

    def __len__(self) -> int:
        """Return how many there are at a time."""
        return self._data.scans

    def scan(self, epoch: int, place: int) -> TrainingScan:
        """Return the scan of a place in a round."""
        age = epoch // self._data.epochs_per_scan if self._data.epochs_per_scan else 0
        generation = (age + len(self) - 1 - place) // len(self)
        found = self._made.get(place)
        if found is None or found[0] != generation:
            plan = training_plan(self._data, generation * len(self) + place)
            found = (generation, _simulated(plan, self._settings))
            self._made[place] = found
        return found[1]

    def digest(self) -> bytes:
        """Return bytes made of what all scans follow from, those of later rounds too."""
        facts = (self._data.model_dump_json(), self._settings.model_dump_json())
        return repr((program_digest(), *facts)).encode()


def training_plan(data: SimulatedData, number: int) -> PlannedScan:
    """Return the plan of a scan to train on, by number; after the last, the first follows."""
    seeds = LAST_SEED + 1 - data.first_seed
    seed, plans = data.first_seed, _plans(data, data.first_seed, "train")
    seed += number // len(plans) % seeds
    return _plans(data, seed, "train")[number * SHUFFLE % len(plans)]


def open_data(
    recipe: DataRecipe, settings: InputSettings, progress: Progress | None = None
) -> tuple[ScanPool, list[TrainingScan]]:
    """Return the scans to train on and those for validation.

    Raises:
        ScanError: If a subject is in both or kept for tests, pixel sizes differ, or a scan
            lacks poses or a channel.
        FormatError: If a file cannot be read.
    """
    if recipe.simulated is not None:
        return _open_simulated(recipe.simulated, settings, progress)
    files = _files(recipe)
    names = {part: [path for p, path in files if p == part] for part in ("train", "validation")}
    for part, paths in names.items():
        if not paths:
            raise ScanError(f"there are no scans for {part}")
    opened = {part: [open_scan(path) for path in paths] for part, paths in names.items()}
    _check_subjects(opened["train"], opened["validation"])
    room = [int(recipe.cache_gb * 1e9)]
    loaded: dict[str, list[TrainingScan]] = {"train": [], "validation": []}
    total = sum(len(scans) for scans in opened.values())
    for part, scans in opened.items():
        for scan in scans:
            loaded[part].append(training_scan(scan, settings, room))
            if progress is not None:
                progress(sum(len(done) for done in loaded.values()), total)
    _check_spacing([*loaded["train"], *loaded["validation"]])
    return FixedScans(loaded["train"]), loaded["validation"]


def training_scan(
    scan: Scan, settings: InputSettings, room: list[int] | None = None
) -> TrainingScan:
    """Return a scan as training reads it.

    Args:
        scan: With poses and a subject.
        settings: What the network reads.
        room: Bytes that are left to keep frames in memory, which goes down; ``None`` keeps
            them in any case.

    Raises:
        ScanError: If it has no poses, pixel size or subject, or lacks a channel.
    """
    sized = network_scan(scan, settings)
    if sized.image_to_reference is None:
        raise ScanError(f"'{scan.name}' has no tracked poses to learn from")
    if not scan.subject:
        raise ScanError(
            f"'{scan.name}' names no subject: without it nobody can tell training and"
            " validation apart"
        )
    frames: Frames = network_frames(scan, settings)
    size = int(np.prod(frames.shape)) * frames.dtype.itemsize
    if room is None or size <= room[0]:
        frames = frames[:]
        if room is not None:
            room[0] -= size
    assert sized.calibration is not None
    poses, center = sized.image_to_reference.double(), center_mm(sized)
    tracked = np.ones(len(poses), bool) if sized.tracked is None else sized.tracked.numpy()
    return TrainingScan(
        name=scan.name,
        subject=scan.subject,
        frames=frames,
        poses=center_poses(poses, center),
        tracked=tracked,
        image_poses=poses,
        spacing_mm=sized.calibration.spacing_mm,
        center=center,
    )


def data_digest(pool: ScanPool, validation: Sequence[TrainingScan]) -> str:
    """Return a text that differs for other data."""
    held_out = b"".join(scan.digest() for scan in validation)
    return hashlib.sha256(pool.digest() + held_out).hexdigest()[:32]


def _files(recipe: DataRecipe) -> list[tuple[str, Path]]:
    if recipe.folder is not None:
        return list(dataset_files(Path(recipe.folder)))
    train = [("train", Path(path)) for path in recipe.train]
    return [*train, *(("validation", Path(path)) for path in recipe.validation)]


def _check_subjects(train: Sequence[Scan], validation: Sequence[Scan]) -> None:
    """Refuse subjects in both parts, and those kept for tests."""
    names = tuple(scan.subject or "" for scan in (*train, *validation))
    refuse_test_subjects(names)
    if all(names):  # who is not named is refused when loaded, with the scan's name
        count = len(train)
        Split(names, tuple(range(count)), tuple(range(count, len(names))), ())


def _check_spacing(scans: Sequence[TrainingScan]) -> None:
    first = scans[0]
    for scan in scans[1:]:
        ratios = np.divide(scan.spacing_mm, first.spacing_mm)
        if np.abs(ratios - 1).max() > SPACING_TOLERANCE:
            raise ScanError(
                f"pixels of '{scan.name}' are {_mm(scan)} as the network reads them, those of"
                f" '{first.name}' {_mm(first)}: train on scans of one field of view"
            )


def _mm(scan: TrainingScan) -> str:
    return f"{scan.spacing_mm[0]:.4g} x {scan.spacing_mm[1]:.4g} mm"


def _open_simulated(
    data: SimulatedData, settings: InputSettings, progress: Progress | None
) -> tuple[ScanPool, list[TrainingScan]]:
    pool = SimulatedScans(data, settings)
    total = len(pool) + data.validation_scans
    for place in range(len(pool)):
        pool.scan(0, place)
        if progress is not None:
            progress(place + 1, total)
    validation = []
    for number in range(data.validation_scans):
        plans = _plans(data, (data.first_seed + number) % (LAST_SEED + 1), "validation")
        validation.append(_simulated(plans[number % len(plans)], settings))
        if progress is not None:
            progress(len(pool) + number + 1, total)
    return pool, validation


def _plans(data: SimulatedData, seed: int, part: str) -> list[PlannedScan]:
    recipe = dataset_recipe(data.dataset, data.size, seed)
    return [plan for plan in recipe.scans if plan.part == part]


def _simulated(plan: PlannedScan, settings: InputSettings) -> TrainingScan:
    plan = replace(plan, modalities=COMPANIONS.get(settings.channels, ())[:1])
    if settings.crop_px is None:
        plan = replace(plan, pixels=(settings.columns, settings.rows))
    return training_scan(simulate_planned(plan, planned_body(plan)), settings)
