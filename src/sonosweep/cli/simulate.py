"""``sonosweep simulate``: a sweep with exact truth, or a whole data set."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

from cyclopts import Group, Parameter

from sonosweep.cli.inputs import OUTPUT, Force, Json
from sonosweep.cli.whole_number import WHOLE

SWEEP = Group("A single sweep", sort_key=2)
DATASET = Group("A data set", sort_key=2)

ScannerChoice = Literal["research", "speckle_reduced", "clinical"]


@Parameter(name="*", group=SWEEP)
@dataclass(frozen=True)
class SweepOptions:
    """What is scanned, and how.

    Attributes:
        body: What is scanned.
        subject: Number of the subject; each has an arm of its own. Those from 900000 on are
            for tests alone.
        side: Which arm.
        shape: Of the line that the probe draws on the skin.
        length_mm: Of this line.
        excursion_mm: How far C, L and S leave the straight line.
        frames: How many, at 20 per second; as fast as the paper's hands otherwise.
        orientation: Image plane across the arm, or along it.
        backward: Traverse the line from its end.
        probe: Linear as the paper's, or convex with sector images.
        pixels: Columns and rows over the same field of view.
    """

    body: Literal["forearm", "uniform", "wires", "cysts", "vessels"] = "forearm"
    subject: Annotated[int, WHOLE] = 0
    side: Literal["left", "right"] = "right"
    shape: Literal["straight", "C", "L", "S"] = "S"
    length_mm: float = 60.0
    excursion_mm: float | None = None
    frames: Annotated[int | None, WHOLE] = None
    orientation: Literal["perpendicular", "parallel"] = "perpendicular"
    backward: Annotated[bool, Parameter(negative="")] = False
    probe: Literal["linear", "convex"] = "linear"
    pixels: Annotated[tuple[int, int] | None, Parameter(negative="")] = None


class Recording(NamedTuple):
    """What a sweep and a data set have in common.

    Attributes:
        seed: Of the sweep or the data set.
        tracker: Name of what sees the poses, or ``"none"``.
        scanner: Kind of it, if one is asked for.
        modalities: Companions.
    """

    seed: int
    tracker: str
    scanner: ScannerChoice | None
    modalities: tuple[str, ...]


@Parameter(name="*", group=DATASET)
@dataclass(frozen=True)
class DatasetOptions:
    """Which data set, and how it is made.

    Attributes:
        dataset: As in the paper: forearms in B-mode; with power Doppler and photoacoustics;
            with a convex probe.
        size: As large as the paper's, small enough for a laptop, or as small with many subjects
            in short stretches to learn from.
        subjects: Only so many of those for training, with the same scans; those for validation
            and tests stay.
        layout: Of the files: ours, or that of the TUS-REC challenges.
        workers: Processes; as many as there are cores otherwise. The files are the same.
    """

    dataset: Literal["dataset1", "dataset2", "dataset3"] | None = None
    size: Literal["full", "small", "varied"] | None = None
    subjects: Annotated[int | None, WHOLE] = None
    layout: Literal["hdf5", "tusrec"] | None = None
    workers: Annotated[int | None, WHOLE] = None


def simulate(
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"], group=OUTPUT)],
    seed: Annotated[int, WHOLE] = 0,
    tracker: Literal["none", "electromagnetic", "optical"] = "none",
    scanner: ScannerChoice | None = None,
    modalities: Annotated[
        tuple[Literal["power_doppler", "photoacoustic", "iq", "amplitude"], ...],
        Parameter(negative="", consume_multiple=True, show_default=False),
    ] = (),
    sweep: SweepOptions | None = None,
    dataset: DatasetOptions | None = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """Make a sweep with exact truth, or with --dataset a whole data set.

    A data set that is there in part is continued; the same command makes the same bytes.

    Args:
        output: File of the sweep, as for convert; or folder of the data set.
        seed: Another number gives another sweep of the subject, or other subjects.
        tracker: Whose poses are written: the exact ones, or those that a tracker reports.
        scanner: A clinical one has a preset of its own in every scan (gray map, persistence,
            speckle reduction), a research one shows what it hears, a speckle_reduced one the
            same with smoothed speckle; that of the data set, or clinical.
        modalities: What is recorded beside B-mode, and beside what the data set has.
    """
    from sonosweep.cli.output import say
    from sonosweep.cli.simulate_job import run_dataset, run_sweep

    _refuse_idle(sweep, dataset)
    recording = Recording(seed, tracker, scanner, modalities)
    if dataset is not None:
        line, facts = run_dataset(dataset, output, recording, force)
    else:
        line, facts = run_sweep(sweep or SweepOptions(), output, recording, force)
    say(line, facts, json)


def _refuse_idle(sweep: SweepOptions | None, dataset: DatasetOptions | None) -> None:
    """Refuse options that would do nothing: nobody shall think that they did."""
    from sonosweep.errors import ScanError

    if dataset is not None and dataset.dataset is None:
        raise ScanError(
            "--size, --subjects, --layout and --workers are about a data set: give --dataset too"
        )
    if dataset is not None and sweep is not None:
        raise ScanError(
            "a recipe says how the sweeps of a data set are: leave out the options of a single"
            " sweep, or --dataset"
        )
