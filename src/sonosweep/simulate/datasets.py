"""Data sets by recipe: which scans of whom, how the probe moves in each, and what for.

========== ======================================================================== =========
name       as in the paper                                                          split
========== ======================================================================== =========
dataset1   9 subjects, 3 S-shaped scans of each forearm, 900 to 1000 frames         5 : 1 : 3
dataset2   10 subjects, 3 S-shaped scans of each forearm, 400 to 550 frames, each   5 : 1 : 4
           with power Doppler and photoacoustic frames
dataset3   19 subjects; C, L and S over both forearms, across the arm and along     10 : 4 : 5
           it; convex probe, 36 to 430 frames
========== ======================================================================== =========

As the paper's, data sets 1 and 2 are of a research scanner, and data set 3 of one machine with
speckle reduction of medium strength, unless another kind is asked for.

Subjects of the test part have numbers from 900000 on, so that training can refuse them.

A network learns by heart how fast the hand was in each of few scans, and then reads others
badly. Therefore the size ``"varied"`` has two or three times as many frames to learn from as
``"small"``, but from thousands of sweeps over many people: each of its training scans is a
stretch of ten frames.

References:
    Lee et al., "Enhancing Free-hand 3D Photoacoustic and Ultrasound Reconstruction using
    Deep Learning", section "Data Collection". The paper does not say how the 60 scans of
    data set 2 are spread over subjects; 10 with 6 scans each give its split 5 : 1 : 4.
"""

import hashlib
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from itertools import product
from typing import Literal

import numpy as np

from sonosweep.errors import ScanError
from sonosweep.io.source_digest import source_digest
from sonosweep.scan.split import PARTS, Split
from sonosweep.simulate.bodies import BodyName, Side
from sonosweep.simulate.motion import MotionSettings, Orientation
from sonosweep.simulate.random_sweep import ScannerKind
from sonosweep.simulate.seeds import FIRST_TEST_SUBJECT, generator, subject_name
from sonosweep.simulate.sweep_path import SweepShape

Part = Literal["train", "validation", "test"]
Parts = tuple[int, int, int]
"""Subjects for training, validation and tests."""

SIZES = ("full", "small", "varied")
STRETCH_FRAMES = 10
MOST_SEEDS = 100
SUBJECTS_PER_SEED = 100
STEP_MM = 0.21  # mean of data set 1: 199.3 mm in 950 frames
ARM_MM = 250.0  # length of a simulated forearm
END_MM = 6.0  # of it that a sweep leaves free
CONVEX_CONTACT_MM = 25.0  # of its face that rests on an arm


def program_digest() -> str:
    """Return a text that differs for different versions of the code that makes scans."""
    return source_digest("geometry", "imaging", "simulate")


@dataclass(frozen=True)
class PlannedScan:
    """One scan of a data set, before it is made.

    Attributes:
        name: Unique within its subject.
        subject: Number of the subject.
        scan: Number of the scan, unique within its subject.
        part: What it is for.
        side: Which forearm.
        motion: Of the probe.
        probe: ``"linear"`` or ``"convex"``.
        pixels: Columns and rows of a frame.
        modalities: Companions beside B-mode.
        body: What is scanned.
        scanner: Kind of it, as :func:`~sonosweep.simulate.draw_sweep` takes it.
        stretch: First frame and number of those of the sweep that are recorded; ``None`` for
            all.
    """

    name: str
    subject: int
    scan: int
    part: Part
    side: Side
    motion: MotionSettings
    probe: str = "linear"
    pixels: tuple[int, int] = (256, 256)
    modalities: tuple[str, ...] = ()
    body: BodyName = "forearm"
    scanner: ScannerKind = "clinical"
    stretch: tuple[int, int] | None = None

    @property
    def frames(self) -> int:
        """How many are recorded."""
        return self.motion.frames if self.stretch is None else self.stretch[1]

    def digest(self) -> str:
        """Return a text that differs for different scans and versions of the program."""
        facts = repr((program_digest(), sorted(asdict(self).items())))
        return hashlib.sha256(facts.encode()).hexdigest()[:32]


@dataclass(frozen=True)
class DatasetRecipe:
    """A data set, before it is made.

    Attributes:
        name: Which one.
        size: ``"full"`` as in the paper, ``"small"`` for a laptop, or ``"varied"``: as small,
            with many subjects to learn from.
        seed: Another number gives other subjects.
        scans: All of them, ordered by subject.
    """

    name: str
    size: str
    seed: int
    scans: tuple[PlannedScan, ...]

    def split(self) -> Split:
        """Return which scans are for what."""
        parts = {
            part: tuple(i for i, scan in enumerate(self.scans) if scan.part == part)
            for part in PARTS
        }
        return Split(tuple(subject_name(scan.subject) for scan in self.scans), **parts)

    def digest(self) -> str:
        """Return a text that differs for different data sets and versions of the program."""
        facts = "".join(scan.digest() for scan in self.scans)
        return hashlib.sha256(facts.encode()).hexdigest()[:32]


def dataset_recipe(
    name: str,
    size: str = "full",
    seed: int = 0,
    *,
    scanner: ScannerKind | None = None,
    modalities: tuple[str, ...] = (),
    subjects: int | None = None,
) -> DatasetRecipe:
    """Return the recipe of a data set.

    Args:
        name: ``"dataset1"``, ``"dataset2"`` or ``"dataset3"``.
        size: ``"full"``, ``"small"`` or ``"varied"``. A small one has shorter scans and, in
            data set 3, frames of 320 x 240 pixels; the scans of data set 1 for tests are as
            long as in the full set. A varied one is a small one with 90 subjects for
            training, in stretches of 10 frames, and 6 for validation.
        seed: From 0 to 99.
        scanner: The kind of all scans; ``None`` leaves that of the data set.
        modalities: Companions beside those that the data set has.
        subjects: Only the first so many of the subjects for training, with the same scans;
            those for validation and tests stay. ``None`` leaves all.

    Raises:
        ScanError: If there is no such recipe.
    """
    if name not in RECIPES:
        raise ScanError(f"there is no data set '{name}'; known are {', '.join(RECIPES)}")
    if size not in SIZES:
        raise ScanError(f"a data set is {', '.join(SIZES[:-1])} or {SIZES[-1]}, got '{size}'")
    if not 0 <= seed < MOST_SEEDS:
        raise ScanError(f"the seed of a data set is from 0 to {MOST_SEEDS - 1}, got {seed}")
    plan, sizes = RECIPES[name]
    scans = plan(size, seed, sizes[SIZES.index(size)])
    if size == "varied":
        scans = [_cut(scan) for scan in _one_for_validation(scans)]
    if scanner is not None:
        scans = [replace(scan, scanner=scanner) for scan in scans]
    if subjects is not None:
        scans = _first_subjects(scans, subjects)
    wanted = [replace(s, modalities=_both(s.modalities, modalities)) for s in scans]
    return DatasetRecipe(name, size, seed, tuple(wanted))


def _subjects(seed: int, sizes: Parts) -> list[tuple[int, Part]]:
    """Return the numbers of the subjects and what they are for."""
    subjects: list[tuple[int, Part]] = []
    parts: tuple[Part, Part, Part] = ("train", "validation", "test")
    for part, count in zip(parts, sizes, strict=True):
        first = seed * SUBJECTS_PER_SEED + (FIRST_TEST_SUBJECT if part == "test" else 0)
        subjects += [(first + len(subjects) + k, part) for k in range(count)]
    return subjects


def _first_subjects(scans: list[PlannedScan], count: int) -> list[PlannedScan]:
    """Return the scans without those of further subjects for training."""
    found = list(dict.fromkeys(scan.subject for scan in scans if scan.part == "train"))
    if not 1 <= count <= len(found):
        raise ScanError(
            f"the data set has {len(found)} subjects for training: choose from 1 to {len(found)}"
            f" of them, got {count}"
        )
    return [s for s in scans if s.part != "train" or s.subject in found[:count]]


def _both(modalities: tuple[str, ...], more: tuple[str, ...]) -> tuple[str, ...]:
    """Return each modality once."""
    return tuple(dict.fromkeys((*modalities, *more)))


def _one_for_validation(scans: list[PlannedScan]) -> list[PlannedScan]:
    """Return the scans with one alone of each subject for validation, of another kind each."""
    held_out = [scan for scan in scans if scan.part == "validation"]
    subjects = list(dict.fromkeys(scan.subject for scan in held_out))
    kinds = len({(scan.motion.orientation, scan.motion.shape) for scan in held_out})
    number = {subject: place % kinds for place, subject in enumerate(subjects)}
    return [s for s in scans if s.part != "validation" or s.scan == number[s.subject]]


def _cut(scan: PlannedScan) -> PlannedScan:
    """Return a scan for training as a stretch of its sweep, others as they are."""
    if scan.part != "train" or scan.motion.frames <= STRETCH_FRAMES:
        return scan
    draw = generator(scan.subject, scan.scan, "stretch")
    first = int(draw.integers(scan.motion.frames - STRETCH_FRAMES + 1))
    return replace(scan, stretch=(first, STRETCH_FRAMES))


def _dataset1(size: str, seed: int, parts: Parts) -> list[PlannedScan]:
    scans: list[PlannedScan] = []
    for subject, part in _subjects(seed, parts):
        repeats = 15 if size == "varied" and part == "train" else 3
        for number, (side, repeat) in enumerate(_each_arm(repeats)):
            short = size != "full" and part != "test"
            draw = generator(subject, number, "plan")
            frames = 300 if short else int(draw.integers(900, 1001))
            length_mm = 65.0 if short else float(draw.uniform(185, 215))
            scans.append(
                PlannedScan(
                    name=f"{_hand(side)}_Per_S_{repeat + 1}",
                    subject=subject,
                    scan=number,
                    part=part,
                    side=side,
                    motion=_s_shape(draw, length_mm, frames),
                    scanner="research",
                )
            )
    return scans


def _dataset2(size: str, seed: int, parts: Parts) -> list[PlannedScan]:
    scans: list[PlannedScan] = []
    for subject, part in _subjects(seed, parts):
        repeats = {"full": 3, "small": 1, "varied": 10 if part == "train" else 1}[size]
        for number, (side, repeat) in enumerate(_each_arm(repeats)):
            draw = generator(subject, number, "plan")
            frames = int(draw.integers(400, 549))
            if size != "full":
                frames //= 4
            scans.append(
                PlannedScan(
                    name=f"{_hand(side)}_Per_S_{repeat + 1}",
                    subject=subject,
                    scan=number,
                    part=part,
                    side=side,
                    motion=_s_shape(draw, STEP_MM * frames, frames),
                    modalities=("power_doppler", "photoacoustic"),
                    scanner="research",
                )
            )
    return scans


def _dataset3(size: str, seed: int, parts: Parts) -> list[PlannedScan]:
    scans: list[PlannedScan] = []
    sides: tuple[Side, ...] = ("left", "right")
    orientations: tuple[Orientation, ...] = ("parallel", "perpendicular")
    shapes: tuple[SweepShape, ...] = ("C", "L", "S")
    for subject, part in _subjects(seed, parts):
        for number, (side, orientation, shape) in enumerate(product(sides, orientations, shapes)):
            draw = generator(subject, number, "plan")
            # 30,552 frames in 228 scans: 134 on average.
            frames = int(np.clip(np.rint(np.exp(draw.normal(4.75, 0.5))), 36, 430))
            length_mm = float(draw.uniform(100, 190))
            excursion_mm = float(draw.uniform(8, 14) * draw.choice((-1, 1)))
            contact_mm = CONVEX_CONTACT_MM
            free_mm = contact_mm / 2 if orientation == "parallel" else 0.0
            motion = MotionSettings(
                shape=shape,
                length_mm=length_mm,
                frames=frames,
                orientation=orientation,
                excursion_mm=excursion_mm,
                turning=float(draw.uniform(0, 0.4)),
                offset_mm=_offset(draw, length_mm + 2 * free_mm),
                speed_variation=float(draw.uniform(0.2, 0.5)),
                pauses=0,
                largest_step_mm=max(1.0, 4 * length_mm / frames),
                contact_width_mm=contact_mm,
            )
            scans.append(
                PlannedScan(
                    name=f"{_hand(side)}_{orientation[:3].title()}_{shape}_DtP",
                    subject=subject,
                    scan=number,
                    part=part,
                    side=side,
                    motion=motion,
                    probe="convex",
                    pixels=(640, 480) if size == "full" else (320, 240),
                    scanner="speckle_reduced",
                )
            )
    return scans


RECIPES: dict[str, tuple[Callable[[str, int, Parts], list[PlannedScan]], tuple[Parts, ...]]] = {
    "dataset1": (_dataset1, ((5, 1, 3), (5, 1, 3), (90, 6, 3))),
    "dataset2": (_dataset2, ((5, 1, 4), (5, 1, 4), (90, 6, 4))),
    "dataset3": (_dataset3, ((10, 4, 5), (3, 1, 2), (90, 6, 2))),
}
"""How each is planned, and its subjects in the order of :data:`SIZES`."""


def _each_arm(repeats: int) -> list[tuple[Side, int]]:
    """Return so many scans of each forearm."""
    sides: tuple[Side, ...] = ("left", "right")
    return list(product(sides, range(repeats)))


def _hand(side: Side) -> str:
    """Return the side as the public data sets write it."""
    return {"left": "LH", "right": "RH"}[side]


def _s_shape(draw: np.random.Generator, length_mm: float, frames: int) -> MotionSettings:
    """Return an arbitrary S across the arm, within what fits on a forearm."""
    widest = min(9.0, length_mm / 8)
    excursion_mm = float(draw.uniform(0.4, 1.0) * widest * draw.choice((-1, 1)))
    return MotionSettings(
        shape="S",
        length_mm=length_mm,
        frames=frames,
        excursion_mm=excursion_mm,
        turning=float(draw.uniform(0, 0.6)),
        offset_mm=_offset(draw, length_mm),
        speed_variation=float(draw.uniform(0.5, 0.9)),
        pauses=int(draw.integers(0, 1 + frames // 200)),
        pause_s=float(draw.uniform(0.3, 1.0)),
        hand_unsteadiness=float(draw.uniform(0.6, 1.1)),
        tremor_mm=float(draw.uniform(0.005, 0.025)),
        gel_mm=float(draw.uniform(0.2, 1.2)),
    )


def _offset(draw: np.random.Generator, length_mm: float) -> tuple[float, float]:
    """Return where on the arm a sweep of at most this extent has its middle."""
    free = max(ARM_MM / 2 - END_MM - length_mm / 2, 0.0)
    return float(draw.uniform(-3, 3)), float(draw.uniform(-free, free))
