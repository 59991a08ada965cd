"""The work of ``sonosweep simulate``."""

import os
from pathlib import Path
from typing import Any

from sonosweep.cli.info import path_length_mm
from sonosweep.cli.output import check_free
from sonosweep.cli.progress import progress
from sonosweep.cli.simulate import DatasetOptions, Recording, SweepOptions
from sonosweep.errors import ScanError
from sonosweep.io import write_scan_as
from sonosweep.io.open import HDF5
from sonosweep.io.write_scan import check_suffix, poses_beside
from sonosweep.scan import Scan, select_tracked
from sonosweep.simulate.bodies import LONGEST_MM, named_body
from sonosweep.simulate.body import Body
from sonosweep.simulate.datasets import dataset_recipe
from sonosweep.simulate.make import make_dataset, with_reports
from sonosweep.simulate.motion import MotionSettings
from sonosweep.simulate.random_sweep import draw_sweep
from sonosweep.simulate.sweep import simulate_sweep
from sonosweep.simulate.tracker import TRACKERS, TrackerSettings

LINEAR_STEP_MM, CONVEX_STEP_MM = 0.21, 1.1  # means of the paper's data sets 1 and 3
PHANTOM_MARGIN_MM = 50.0
MOST_PIXELS = 4096


def run_dataset(
    options: DatasetOptions, folder: Path, recording: Recording, force: bool
) -> tuple[str, dict[str, Any]]:
    """Make a data set, or what is missing of it; return what to say, and as facts.

    Raises:
        ScanError: If it cannot be made.
        FormatError: If the folder holds something else or cannot be written to.
    """
    assert options.dataset is not None
    recipe = dataset_recipe(
        options.dataset,
        options.size or "full",
        recording.seed,
        scanner=recording.scanner,
        modalities=recording.modalities,
        subjects=options.subjects,
    )
    with progress(f"{recipe.name}, frames") as show:
        made = make_dataset(
            recipe,
            folder,
            layout=options.layout or "hdf5",
            tracker=_tracker(recording.tracker),
            workers=options.workers if options.workers is not None else os.cpu_count() or 1,
            again=force,
            progress=show,
        )
    kept = f" ({made.kept} were there)" if made.kept else ""
    lost = options.layout == "tusrec" and any(scan.modalities for scan in recipe.scans)
    without = "; without companions, which this layout does not hold" if lost else ""
    line = (
        f"{recipe.name}, {recipe.size}: {made.scans} scans{kept} with {made.frames} frames ->"
        f" {folder}{without}"
    )
    facts = {
        "dataset": recipe.name,
        "size": recipe.size,
        "seed": recording.seed,
        "scans": made.scans,
        "kept": made.kept,
        "frames": made.frames,
        "output": folder,
    }
    return line, facts


def run_sweep(
    options: SweepOptions, output: Path, recording: Recording, force: bool
) -> tuple[str, dict[str, Any]]:
    """Make one sweep and write it; return what to say, and as facts.

    Raises:
        ScanError: If it cannot be made.
        FormatError: If it cannot be written so.
    """
    check_suffix(output)
    _check(options)
    check_free(output, force)
    beside = poses_beside(output)
    if beside is not None:
        check_free(beside, force)
    scan = _simulate(options, recording)
    kept = scan.companions if output.suffix.lower() in HDF5 else {}
    total = len(scan.frames) * (1 + len(kept))
    done = 0
    with progress(f"{scan.name}, frames") as show:

        def report(amount: int) -> None:
            nonlocal done
            done += amount
            show(min(done, total), total)

        show(0, total)
        files = write_scan_as(with_reports(scan, report), output, keep_subject=True)
    seen = select_tracked(scan)
    assert seen.image_to_reference is not None
    length = path_length_mm(seen, seen.image_to_reference)
    left_out = sorted(set(scan.companions) - set(kept))
    lost = f"; {', '.join(left_out)} left out: only .h5 holds companions" if left_out else ""
    frames, rows, columns = scan.frames.shape[:3]
    line = (
        f"{scan.name}: {frames} frames of {columns} x {rows} pixels, {length:.1f} mm ->"
        f" {', '.join(str(file) for file in files)}{lost}"
    )
    facts = {
        "scan": scan.name,
        "frames": frames,
        "path_length_mm": length,
        "outputs": [str(file) for file in files],
        "left_out": left_out,
    }
    return line, facts


def _check(options: SweepOptions) -> None:
    """Check what would take long to find out, and options that have nothing to act on."""
    longest_mm = LONGEST_MM - PHANTOM_MARGIN_MM
    if not 0 < options.length_mm <= longest_mm:
        raise ScanError(
            f"--length-mm must be above 0 and at most {longest_mm:g}, got {options.length_mm:g}"
        )
    columns, rows = options.pixels or (1, 1)
    if max(columns, rows) > MOST_PIXELS:
        raise ScanError(f"--pixels are at most {MOST_PIXELS} a side, got {columns} x {rows}")
    if options.shape == "straight" and options.excursion_mm:
        raise ScanError("a straight sweep has no --excursion-mm: leave it out or give a --shape")
    if options.body != "forearm" and options.side == "left":
        raise ScanError(f"the phantom '{options.body}' has no left --side: leave it out")


def _simulate(options: SweepOptions, recording: Recording) -> Scan:
    """Return the sweep that the options describe."""
    settings = draw_sweep(
        options.subject,
        recording.seed,
        _motion(options),
        probe=options.probe,
        pixels=options.pixels,
        modalities=recording.modalities,
        tracker=_tracker(recording.tracker),
        scanner=recording.scanner or "clinical",
    )
    return simulate_sweep(settings, _body(options))


def _body(options: SweepOptions) -> Body:

    length_mm = options.length_mm + PHANTOM_MARGIN_MM
    return named_body(options.body, options.subject, options.side, length_mm)


def _motion(options: SweepOptions) -> MotionSettings:
    """Return the movement: as fast as the hands that recorded the paper's data sets."""
    convex = options.probe == "convex"
    step_mm = CONVEX_STEP_MM if convex else LINEAR_STEP_MM
    frames = options.frames
    if frames is None:
        frames = max(round(options.length_mm / step_mm), 1) + 1
    usual_mm = min(8.0, options.length_mm / 8)
    return MotionSettings(
        shape=options.shape,
        length_mm=options.length_mm,
        frames=frames,
        orientation=options.orientation,
        backward=options.backward,
        excursion_mm=usual_mm if options.excursion_mm is None else options.excursion_mm,
        pauses=0 if convex else min(2, frames // 200),
        largest_step_mm=max(1.0, 4 * options.length_mm / max(frames, 1)),
        contact_width_mm=25.0 if convex else 38.0,
    )


def _tracker(name: str) -> TrackerSettings | None:

    return TRACKERS.get(name)
