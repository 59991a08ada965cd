"""One sweep, reconstructed with its tracker and without, side by side."""

import sys
from dataclasses import replace
from pathlib import Path

import torch

from sonosweep.cli.job import (
    JobResult,
    compare_run,
    gray,
    make_report,
    make_volumes,
    report_run,
    summarize,
    unit_of,
    write_findings,
    write_results,
)
from sonosweep.cli.motion import MotionOptions, find_trajectory
from sonosweep.io.demo_sweep import read_demo_sweep
from sonosweep.metrics import align_first_frame, compare_volumes
from sonosweep.reconstruct import B_MODE, VolumeSettings, sweep_grid, tracked_trajectory
from sonosweep.scan import Trajectory, Volume, locate_image
from sonosweep.view.content import Metric

RECORDING = "ImFusion GmbH, CC BY 4.0"  # which asks to be named wherever it is shown
TOLD = "The tracker told that the probe swept backward, and where the first frame lies."
VOXEL_MM = 0.8  # two and a half pixels: the report is quick to load


def run_demo(folder: Path) -> JobResult:
    """Reconstruct the packaged sweep twice and write everything into a folder."""
    print("reading the packaged sweep (liver, curved probe, 140 frames)", file=sys.stderr)
    scan = locate_image(gray(read_demo_sweep()))
    tracked = tracked_trajectory(scan)
    _, estimated = find_trajectory(scan, MotionOptions(direction="backward"))
    sensorless = replace(
        estimated,
        image_to_reference=align_first_frame(
            estimated.image_to_reference, tracked.image_to_reference
        ),
        assumptions=(*estimated.assumptions, TOLD),
    )
    both = Trajectory(torch.cat((tracked.image_to_reference, sensorless.image_to_reference)))
    settings = VolumeSettings(voxel_mm=VOXEL_MM)
    settings = replace(settings, grid=sweep_grid(scan, both, settings))
    volumes, files = {}, []
    for name, trajectory in (("tracked", tracked), ("sensorless", sensorless)):
        volumes[name] = make_volumes(scan, trajectory, settings)
        (folder / name).mkdir()
        written = write_results(folder / name, scan, trajectory, volumes[name])
        files += [f"{name}/{file}" for file in written]
    compared, words = compare_run("sensorless", scan, sensorless, volumes["sensorless"])
    alike = _likeness(volumes["sensorless"][B_MODE], volumes["tracked"][B_MODE])
    compared = replace(compared, metrics={**(compared.metrics or {}), **alike})
    runs = (report_run("tracked", tracked, volumes["tracked"]), compared)
    report = make_report(
        scan,
        runs,
        words,
        (*files, "report.html", "summary.json"),
        "A liver sweep, with and without its tracker",
    )
    report = replace(report, facts=(*report.facts, ("Recording", RECORDING)))
    summary = summarize(scan, runs, volumes["tracked"][B_MODE], report)
    write_findings(folder, report, summary)
    return JobResult("\n".join([f"{scan.name}: {len(scan.frames)} frames.", *words]), summary)


def _likeness(sensorless: Volume, tracked: Volume) -> dict[str, Metric]:
    """Return how alike the two volumes are, with units."""
    found = compare_volumes(sensorless, tracked).as_dict()
    return {name: (value, unit_of(name)) for name, value in found.items()}
