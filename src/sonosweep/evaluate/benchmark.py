"""Many scans and many methods: every metric of each, kept so that a run goes on.

Each answer is one small JSON file named by the method's and the scan's digest. Whatever is
there is not computed again; a run that was killed loses the scans it was at.
"""

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

import torch
from torch import Tensor

from sonosweep.errors import FormatError, ScanError
from sonosweep.estimators.estimator import Progress
from sonosweep.estimators.network_input import center_mm
from sonosweep.evaluate.compare import TrajectoryComparison, compare_trajectories
from sonosweep.evaluate.methods import Method, file_digest
from sonosweep.evaluate.summary import comparison_row
from sonosweep.evaluate.tables import Cell
from sonosweep.geometry import motion_from_step, steps_from_poses
from sonosweep.io import open_scan
from sonosweep.io.atomic import write_beside
from sonosweep.metrics import step_correlation
from sonosweep.scan import Scan, Trajectory, locate_image
from sonosweep.simulate.worker_pool import Report, run_jobs

Row = dict[str, Cell]

FORMAT = "sonosweep benchmark 1"
MOST_WORKERS = 256
DIGITS = 9  # of a motion that is kept


@dataclass(frozen=True)
class _Job:
    """One method on one scan.

    Attributes:
        method: What is tried.
        scan: The file of the scan.
        frames: In it.
        answer: The file to be.
    """

    method: Method
    scan: Path
    frames: int
    answer: Path


def run_benchmark(
    scans: Sequence[Path],
    methods: Sequence[Method],
    folder: Path,
    *,
    simulated: bool,
    workers: int = 1,
    again: bool = False,
    progress: Progress | None = None,
) -> list[Row]:
    """Return a row for each method and scan: who, what, and every metric.

    Args:
        scans: Files of tracked scans.
        methods: What to compare.
        folder: Where answers are kept.
        simulated: Whether the scans are; each row says so, and no table mixes the two.
        workers: Processes, one thread each; a scan's frames are read as they are needed.
        again: Whether to compute again what is there.
        progress: Called with the frames done and in all.

    Raises:
        ScanError: If there is nothing to do, two methods have one name and run, or a method
            cannot use a scan.
        FormatError: If a scan cannot be read or the folder not written to.
    """
    _check(scans, methods, workers)
    jobs = _jobs(scans, methods, folder)
    todo = [job for job in jobs if again or _read_row(job.answer) is None]
    total = sum(job.frames for job in jobs)
    done = total - sum(job.frames for job in todo)

    def report(frames: int) -> None:
        nonlocal done
        done += frames
        if progress is not None:
            progress(done, total)

    report(0)
    run_jobs(_work, todo, workers, report)
    return [_named_row(job, simulated) for job in jobs]


def measure(method: Method, scan: Scan, progress: Progress | None = None) -> tuple[Row, Trajectory]:
    """Return every metric of a method on a tracked scan, and the trajectory it gave.

    The method gets the scan without its poses, unless it is an oracle.

    Raises:
        ScanError: If the method cannot use the scan, or the scan has no poses.
    """
    started = time.process_time()
    blind = (
        scan if method.kind == "oracle" else replace(scan, image_to_reference=None, tracked=None)
    )
    trajectory = method.trajectory(blind, progress)
    seconds = time.process_time() - started
    found = compare_trajectories(trajectory, scan, match="count")
    return _row(method, scan, trajectory, found, seconds), trajectory


def _check(scans: Sequence[Path], methods: Sequence[Method], workers: int) -> None:
    if not scans or not methods:
        raise ScanError("a benchmark needs a scan and a method")
    if not 1 <= workers <= MOST_WORKERS:
        raise ScanError(f"workers must be from 1 to {MOST_WORKERS}, got {workers}")
    names = [(method.name, method.run) for method in methods]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise ScanError(f"two methods are called '{' '.join(twice).strip()}'")


def _jobs(scans: Sequence[Path], methods: Sequence[Method], folder: Path) -> list[_Job]:
    """Return all jobs, those of one method together."""
    digests = [file_digest(path) for path in scans]
    frames = [len(open_scan(path).frames) for path in scans]
    jobs = []
    for method in methods:
        of_method = method.digest()
        for path, digest, count in zip(scans, digests, frames, strict=True):
            jobs.append(_Job(method, path, count, folder / f"{of_method[:16]}_{digest[:16]}.json"))
    return jobs


def _work(job: _Job, report: Report) -> None:
    """Find one answer; runs in a worker."""
    scan = locate_image(open_scan(job.scan))
    reporter = _Reporter(report, job.frames)
    try:
        row, trajectory = measure(job.method, scan, reporter)
    except ScanError as error:
        raise ScanError(f"'{job.method.name}' on '{scan.name}': {error}") from error
    _write(job.answer, row, motion_from_step(steps_from_poses(trajectory.image_to_reference)))
    reporter.finish()


class _Reporter:
    """Turns (done, total) of an estimator into frames since the last call."""

    def __init__(self, report: Report, frames: int) -> None:
        self._report, self._frames, self._said = report, frames, 0

    def __call__(self, done: int, total: int) -> None:
        now = self._frames * done // max(total, 1)
        if now > self._said:
            self._report(now - self._said)
            self._said = now

    def finish(self) -> None:
        """Report what is left."""
        self(1, 1)


def _row(
    method: Method,
    scan: Scan,
    trajectory: Trajectory,
    found: TrajectoryComparison,
    seconds: float,
) -> Row:
    true = scan.image_to_reference
    assert true is not None
    steps = step_correlation(
        trajectory.image_to_reference,
        true,
        torch.tensor((*center_mm(scan), 0.0), dtype=torch.float64),
        scan.tracked,
    )
    return {
        "scan": scan.name,
        "subject": scan.subject,
        **{f"correlation_{name}": value for name, value in steps.items()},
        **{k: v for k, v in comparison_row(found).items() if k not in ("scan", "subject")},
        "cpu_s": seconds,
        "program": f"sonosweep {version('sonosweep')}",
        "date": datetime.now(UTC).date().isoformat(),
    }


def _write(path: Path, row: Row, motion: Tensor) -> None:
    numbers = [[float(f"{value:.{DIGITS}g}") for value in step] for step in motion.tolist()]
    content = {"format": FORMAT, "row": row, "motion": numbers}
    with write_beside(path) as temporary:
        temporary.write_text(json.dumps(content, allow_nan=False) + "\n", encoding="utf-8")


def _read_row(path: Path) -> Row | None:
    """Return an answer that is there; ``None`` if there is none that can be used."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, RecursionError):
        return None
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        return None
    row = content.get("row")
    return row if isinstance(row, dict) and "relative_error_mm" in row else None


def _named_row(job: _Job, simulated: bool) -> Row:
    """Return an answer with what may change from table to table."""
    row = _read_row(job.answer)
    if row is None:
        raise FormatError(f"the answer in '{job.answer}' is gone: run again")
    method = job.method
    who: Row = {"method": method.name, "kind": method.kind, "run": method.run, **method.origin}
    return {**who, "simulated": simulated, **{k: v for k, v in row.items() if k != "method"}}
