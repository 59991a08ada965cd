"""A data set on disk: made by several processes, continued where it was left.

The same recipe gives the same bytes, whatever the number of workers. ``dataset.json`` beside
the scans says what they are and how they are split by subject.
"""

import json
import shutil
import time
from collections.abc import Callable, Hashable, Iterator
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from sonosweep.errors import FormatError, ScanError, SonosweepError
from sonosweep.io.atomic import write_beside
from sonosweep.io.hdf5 import read_scan, write_scan
from sonosweep.io.tusrec import read_tusrec, write_tusrec
from sonosweep.scan import Companion, Frames, LazyFrames, Scan
from sonosweep.scan.split import PARTS
from sonosweep.simulate.body import Body
from sonosweep.simulate.datasets import DatasetRecipe, PlannedScan
from sonosweep.simulate.planned_sweep import planned_body, simulate_planned
from sonosweep.simulate.seeds import subject_name
from sonosweep.simulate.tracker import TrackerSettings
from sonosweep.simulate.worker_pool import Report, run_jobs

Layout = Literal["hdf5", "tusrec"]

DATASET_NAME = "dataset.json"
FORMAT_NAME = "sonosweep dataset"
FORMAT_VERSION = 1
MOST_WORKERS = 256
DIGEST_NOTE = "dataset_scan"
ABANDONED_S = 600.0  # a temporary file this old belongs to a run that was killed
RESERVE_BYTES = 64 * 2**20

_last_body: dict[tuple[Hashable, ...], Body] = {}
"""In a worker: the body it scanned last."""


@dataclass(frozen=True)
class MadeDataset:
    """What a run has left in a folder.

    Attributes:
        folder: Where.
        scans: How many there are.
        frames: How many they have together.
        kept: How many scans were there already.
    """

    folder: Path
    scans: int
    frames: int
    kept: int


@dataclass(frozen=True)
class _Job:
    """One scan to make.

    Attributes:
        scan: Its plan.
        folder: Of the data set.
        layout: Of the files.
        tracker: What sees the poses.
    """

    scan: PlannedScan
    folder: Path
    layout: Layout
    tracker: TrackerSettings | None

    @property
    def subject(self) -> str:
        """Name of the subject."""
        return subject_name(self.scan.subject)

    @property
    def name(self) -> str:
        """Name of the scan."""
        return self.scan.name if self.layout == "tusrec" else f"{self.subject}_{self.scan.name}"

    @property
    def path(self) -> Path:
        """The file that it will be."""
        if self.layout == "tusrec":
            return self.folder / "frames_transfs" / self.subject / f"{self.name}.h5"
        return self.folder / self.scan.part / f"{self.name}.h5"

    @property
    def amount(self) -> int:
        """Frames to write, those of companions included."""
        stacks = 1 if self.layout == "tusrec" else 1 + len(self.scan.modalities)
        return self.scan.frames * stacks


def make_dataset(
    recipe: DatasetRecipe,
    folder: Path,
    *,
    layout: Layout = "hdf5",
    tracker: TrackerSettings | None = None,
    workers: int = 1,
    again: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> MadeDataset:
    """Make all scans of a data set that are not there yet, and say what is there.

    Args:
        recipe: What to make.
        folder: Where; new, empty, or with a part of the same data set.
        layout: ``"hdf5"``: our files in ``train``, ``validation`` and ``test``.
            ``"tusrec"``: the training layout of the TUS-REC challenges, without companions.
        tracker: What sees the poses; ``None`` gives the truth.
        workers: Processes that make scans; each needs up to 500 MB.
        again: Whether to make scans again that are there.
        progress: Called with the frames done and in all.

    Raises:
        ScanError: If the recipe cannot be made, or a number makes no sense.
        FormatError: If the folder holds something else or cannot be written to.
    """
    _check(recipe, layout, tracker, workers)
    jobs = [_Job(scan, folder, layout, tracker) for scan in recipe.scans]
    facts = _facts(recipe, jobs)
    _prepare(folder, facts)
    todo = [job for job in jobs if again or not _is_finished(job)]
    _check_space(folder, todo)
    total = sum(job.amount for job in jobs)
    done = total - sum(job.amount for job in todo)

    def report(amount: int) -> None:
        nonlocal done
        done += amount
        if progress is not None:
            progress(done, total)

    report(0)
    run_jobs(_make, todo, workers, report)
    _write_facts(folder, {**facts, "complete": True})
    frames = sum(job.scan.frames for job in jobs)
    return MadeDataset(folder, len(jobs), frames, len(jobs) - len(todo))


def _check(
    recipe: DatasetRecipe, layout: Layout, tracker: TrackerSettings | None, workers: int
) -> None:
    if not recipe.scans:
        raise ScanError(f"data set '{recipe.name}' has no scans")
    if layout not in get_args(Layout):
        raise ScanError(f"a data set is laid out as 'hdf5' or 'tusrec', not as '{layout}'")
    if not 1 <= workers <= MOST_WORKERS:
        raise ScanError(f"workers must be from 1 to {MOST_WORKERS}, got {workers}")
    if layout == "tusrec" and tracker is not None and tracker.dropouts_per_minute > 0:
        raise ScanError(
            "the layout of TUS-REC has a pose for each frame, but this tracker loses some:"
            " choose another tracker or layout 'hdf5'"
        )


def _facts(recipe: DatasetRecipe, jobs: list[_Job]) -> dict[str, Any]:
    """Return what ``dataset.json`` says."""
    return {
        "format": FORMAT_NAME,
        "format_version": FORMAT_VERSION,
        "written_by": f"sonosweep {version('sonosweep')}",
        "recipe": recipe.name,
        "size": recipe.size,
        "seed": recipe.seed,
        "layout": jobs[0].layout,
        "tracker": None if jobs[0].tracker is None else vars(jobs[0].tracker),
        "digest": recipe.digest(),
        "complete": False,
        "split": {
            part: sorted({job.subject for job in jobs if job.scan.part == part}) for part in PARTS
        },
        "scans": [
            {
                "file": job.path.relative_to(job.folder).as_posix(),
                "subject": job.subject,
                "part": job.scan.part,
                "side": job.scan.side,
                "shape": job.scan.motion.shape,
                "orientation": job.scan.motion.orientation,
                "frames": job.scan.frames,
                "length_mm": job.scan.motion.length_mm,
                "companions": [] if job.layout == "tusrec" else list(job.scan.modalities),
            }
            for job in jobs
        ],
    }


def _prepare(folder: Path, facts: dict[str, Any]) -> None:
    """Make the folder, or see that it holds a part of this very data set."""
    if folder.exists() and not folder.is_dir():
        raise FormatError(f"'{folder}' is a file, an output folder is needed")
    if (folder / DATASET_NAME).exists():
        found = _read_facts(folder / DATASET_NAME)
        same = ("written_by", "layout", "tracker", "digest")
        if any(found.get(name) != facts[name] for name in same):
            raise FormatError(
                f"'{folder}' holds another data set ({found.get('recipe')},"
                f" {found.get('size')}, seed {found.get('seed')}, {found.get('written_by')}, in"
                f" layout {found.get('layout')}), or this one as begun before the program changed:"
                " choose another folder"
            )
        _remove_abandoned(folder)
    elif folder.is_dir() and any(folder.iterdir()):
        raise FormatError(f"'{folder}' holds other files: choose another folder")
    _write_facts(folder, facts)


def _read_facts(path: Path) -> dict[str, Any]:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise FormatError(f"'{path}' cannot be read: choose another folder") from error
    if not isinstance(found, dict) or found.get("format") != FORMAT_NAME:
        raise FormatError(f"'{path}' is not of a data set of ours: choose another folder")
    return found


def _write_facts(folder: Path, facts: dict[str, Any]) -> None:
    with write_beside(folder / DATASET_NAME) as temporary:
        temporary.write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")


def _remove_abandoned(folder: Path) -> None:
    """Remove what a run that was killed left half-written."""
    for path in folder.rglob(".writing-*"):
        if path.is_file() and time.time() - path.stat().st_mtime > ABANDONED_S:
            path.unlink(missing_ok=True)


def _is_finished(job: _Job) -> bool:
    """Say whether the file of a job is there, whole, and made by this recipe."""
    if not job.path.exists():
        return False
    try:
        scan = read_tusrec(job.path) if job.layout == "tusrec" else read_scan(job.path)
        scan.frames[-1]
    except SonosweepError:
        return False
    if scan.image_to_reference is None or len(scan.frames) != job.scan.frames:
        return False
    return job.layout == "tusrec" or scan.notes.get(DIGEST_NOTE) == job.scan.digest()


def _check_space(folder: Path, jobs: list[_Job]) -> None:
    needed = sum(job.amount * job.scan.pixels[0] * job.scan.pixels[1] for job in jobs)
    free = shutil.disk_usage(folder).free
    if needed + RESERVE_BYTES > free:
        raise FormatError(
            f"the data set needs {needed / 1e9:.1f} GB more, but the disk of '{folder}' has"
            f" {free / 1e9:.1f} GB free: free some or choose another folder"
        )


def _make(job: _Job, report: Report) -> None:
    """Make one scan; runs in a worker."""
    made = simulate_planned(job.scan, _body_of(job.scan), job.tracker)
    notes = {**made.notes, DIGEST_NOTE: job.scan.digest(), "part": job.scan.part}
    scan = replace(with_reports(made, report), name=job.name, notes=notes)
    if job.layout == "tusrec":
        write_tusrec(scan, job.folder)
    else:
        write_scan(scan, job.path)


def _body_of(plan: PlannedScan) -> Body:
    """Return the body of a scan; the last one is kept, as one subject's scans come together."""
    length_mm = None if plan.body == "forearm" else plan.motion.length_mm
    key = (plan.body, plan.subject, plan.side, length_mm)
    if key not in _last_body:
        _last_body.clear()  # first, so that there is one in memory at a time
        _last_body[key] = planned_body(plan)
    return _last_body[key]


class _ReportingFrames(LazyFrames):
    """Frames that say when one was read."""

    def __init__(self, frames: Frames, report: Report) -> None:
        super().__init__(tuple(frames.shape), frames.dtype)
        self._frames, self._report = frames, report

    def _read(self, frame: int) -> np.ndarray:
        pixels = self._frames[frame]
        self._report(1)
        return pixels


def with_reports(scan: Scan, report: Report) -> Scan:
    """Return the scan with frames that call ``report(1)`` when one is read."""
    companions = {
        name: Companion(
            _ReportingFrames(companion.frames, report), companion.spacing_mm, companion.origin_mm
        )
        for name, companion in scan.companions.items()
    }
    return replace(scan, frames=_ReportingFrames(scan.frames, report), companions=companions)


def dataset_files(folder: Path) -> Iterator[tuple[str, Path]]:
    """Give part (``"train"`` ...) and file of each scan of a data set that we made.

    Raises:
        FormatError: If there is none, or it is not complete.
    """
    path = folder / DATASET_NAME
    found = _read_facts(path)
    if not found.get("complete"):
        raise FormatError(f"the data set in '{folder}' is not complete: make it again to go on")
    try:
        yield from ((str(scan["part"]), folder / scan["file"]) for scan in found["scans"])
    except (KeyError, TypeError) as error:
        raise FormatError(f"'{path}' does not name its scans") from error
