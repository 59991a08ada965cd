"""One scan to a folder of results: what ``reconstruct`` and ``demo`` share."""

import json
import math
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from sonosweep import __version__
from sonosweep.cli.info import image_center_mm
from sonosweep.cli.inputs import InputOptions, read
from sonosweep.cli.motion import MotionOptions, find_trajectory
from sonosweep.cli.output import plain
from sonosweep.cli.photoacoustic_options import PhotoacousticOptions, photoacoustic_correction
from sonosweep.cli.progress import progress
from sonosweep.cli.volume_options import VolumeOptions, describe_bytes, volume_settings
from sonosweep.evaluate import compare_trajectories
from sonosweep.evaluate.verdict import verdict
from sonosweep.io import write_slicer_script, write_trajectory, write_volume
from sonosweep.io.open import printable
from sonosweep.io.plus_config import read_plus_config
from sonosweep.reconstruct import (
    B_MODE,
    VolumeSettings,
    correct_photoacoustic,
    engine,
    estimate_bytes,
    image_companions,
    left_out,
    must_compile,
    reconstruct_scan,
    sweep_grid,
)
from sonosweep.scan import FrameView, Scan, Trajectory, Volume, locate_image, select_tracked
from sonosweep.view import Report, ReportRun, write_report, write_vessel_picture

VESSELS = ("power_doppler", "photoacoustic")  # how companions that show vessels begin
UNITS = {"_mm": "mm", "_deg": "°", "_percent": "%", "_db": "dB"}


@dataclass(frozen=True)
class Job:
    """What to do with each scan.

    Attributes:
        motion: Where the motion comes from.
        volume: How volumes are made.
        inputs: How the scan is read.
        photoacoustic: How photoacoustic frames are corrected.
        world: How volumes state coordinates; ``None``: ``"ras"``, but ``"lps"`` where a
            PLUS configuration says how to make a MetaImage, so that it is PLUS's own file.
        volume_format: Format of the volumes.
        maps: Whether to write what a network looks at.
    """

    motion: MotionOptions
    volume: VolumeOptions
    inputs: InputOptions
    photoacoustic: PhotoacousticOptions = field(default_factory=PhotoacousticOptions)
    world: Literal["ras", "lps"] | None = None
    volume_format: Literal["nrrd", "mha", "nii.gz", "dicom"] = "nrrd"
    maps: bool = False


@dataclass(frozen=True)
class JobResult:
    """What came out.

    Attributes:
        line: The summary line, with units.
        summary: The same and more, as in ``summary.json``.
    """

    line: str
    summary: Mapping[str, Any]


def run_job(path: Path, folder: Path, job: Job) -> JobResult:
    """Reconstruct one scan and write everything about it into a folder."""
    recorded = gray(read(path, job.inputs))
    file = job.inputs.plus_config
    config = None if file is None else read_plus_config(file)
    settings = volume_settings(job.volume, config)
    recorded = correct_photoacoustic(recorded, photoacoustic_correction(job.photoacoustic))
    maps: tuple[str, ...] = ()
    if job.maps:
        from sonosweep.cli.maps_job import find_with_maps

        scan, trajectory, maps = find_with_maps(recorded, job.motion, folder)
    else:
        scan, trajectory = find_trajectory(recorded, job.motion)
    if trajectory.method == "tracked" and engine(settings) == "gather":
        scan = locate_image(scan, job.motion.crop)  # to estimate, it was located already
    volumes = make_volumes(scan, trajectory, settings)
    words: tuple[str, ...] = ()
    if trajectory.method == "tracked":
        run = report_run("tracked", trajectory, volumes)
    else:
        run, words = compare_run("sensorless", scan, trajectory, volumes)
    plus_volume = config is not None and config.reconstruction is not None
    world = job.world or ("lps" if plus_volume and job.volume_format == "mha" else "ras")
    files = write_results(folder, scan, trajectory, volumes, world, job.volume_format)
    files += write_vessels(folder, trajectory, volumes)
    report = make_report(scan, (run,), words, (*files, *maps, "report.html", "summary.json"))
    summary = {**summarize(scan, (run,), volumes[B_MODE], report), "world": world}
    write_findings(folder, report, summary)
    size = " x ".join(str(n) for n in volumes[B_MODE].grid.size)
    voxel = " x ".join(
        f"{s:g}" for s in dict.fromkeys(round(s, 6) for s in volumes[B_MODE].grid.spacing_mm)
    )
    line = f"{scan.name}: {len(scan.frames)} frames, {run.name}, {size} voxels of {voxel} mm"
    drift = summary["runs"][0]["metrics"].get("final_drift_rate_path_percent")
    if drift is not None:
        line += f", final drift {drift:.1f} % of the tracked path"
    return JobResult(line, summary)


def gray(scan: Scan) -> Scan:
    """Return the scan in brightness alone; B-mode in colour is gray or has gray meaning."""
    if len(scan.frames.shape) == 3:
        return scan
    return replace(scan, frames=FrameView(scan.frames, gray=True))


def make_volumes(scan: Scan, trajectory: Trajectory, settings: VolumeSettings) -> dict[str, Volume]:
    """Return the volumes, having said on standard error how large they will be."""
    settings = replace(settings, grid=settings.grid or sweep_grid(scan, trajectory, settings))
    assert settings.grid is not None
    for name, reason in left_out(scan).items():
        print(f"no volume of companion '{printable(name)}': {reason}", file=sys.stderr)
    stacks = [scan.frames, *(one.frames for one in image_companions(scan).values())]
    size = " x ".join(str(n) for n in settings.grid.size)
    needed = sum(estimate_bytes(settings.grid, stack.dtype.itemsize) for stack in stacks)
    print(
        f"compounding into {len(stacks)} volume(s) of {size} voxels, {describe_bytes(needed)}",
        file=sys.stderr,
    )
    if must_compile(engine(settings)):
        print("compiling the kernels, once on this machine", file=sys.stderr)
    with progress("compounding") as show:
        return reconstruct_scan(scan, trajectory, settings, show)


def report_run(name: str, trajectory: Trajectory, volumes: Mapping[str, Volume]) -> ReportRun:
    """Return a run for the report, without numbers."""
    companions = {key: volume for key, volume in volumes.items() if key != B_MODE}
    return ReportRun(name, trajectory, volumes.get(B_MODE), companions)


def compare_run(
    name: str, scan: Scan, trajectory: Trajectory, volumes: Mapping[str, Volume]
) -> tuple[ReportRun, tuple[str, ...]]:
    """Return a run for the report, and how far it is from the tracker if there is one."""
    run = report_run(name, trajectory, volumes)
    tracked = len(scan.frames) if scan.tracked is None else int(scan.tracked.sum())
    if scan.image_to_reference is None or tracked < 2:
        return run, ()
    found = compare_trajectories(trajectory, scan)
    metrics = {key: (value, unit_of(key)) for key, value in found.metrics.as_dict().items()}
    measured = replace(run, metrics=metrics, drift_mm=found.drift_mm.numpy())
    return measured, verdict(found.metrics)


def unit_of(name: str) -> str:
    """Return the unit that a number's name ends with."""
    return next((unit for ending, unit in UNITS.items() if name.endswith(ending)), "")


def make_report(
    scan: Scan,
    runs: tuple[ReportRun, ...],
    words: tuple[str, ...],
    files: tuple[str, ...],
    title: str | None = None,
) -> Report:
    """Return the report's content."""
    import numba
    import numpy
    import torch

    assumptions = dict.fromkeys(a for run in runs for a in run.trajectory.assumptions)
    return Report(
        title=title or f"Reconstruction of {scan.name}",
        facts=_facts(scan, runs),
        runs=runs,
        verdict=words,
        assumptions=tuple(assumptions),
        outputs=files,
        command=printable(" ".join(["sonosweep", *sys.argv[1:]])),
        versions={
            "sonosweep": __version__,
            "Python": ".".join(str(part) for part in sys.version_info[:3]),
            "torch": torch.__version__,
            "numpy": numpy.__version__,
            "numba": numba.__version__,
        },
        frames=scan.frames,
        spacing_mm=None if scan.calibration is None else scan.calibration.spacing_mm,
    )


def write_results(
    folder: Path,
    scan: Scan,
    trajectory: Trajectory,
    volumes: Mapping[str, Volume],
    world: Literal["ras", "lps"] = "ras",
    volume_format: str = "nrrd",
) -> tuple[str, ...]:
    """Write volumes, coverage and trajectory, and return their names."""
    names = []
    ending = "" if volume_format == "dicom" else f".{volume_format}"
    for modality, volume in volumes.items():
        stem = "volume" if modality == B_MODE else f"volume_{modality}"
        write_volume(volume, folder / f"{stem}{ending}", world)
        names.append(f"{stem}{ending}")
    b_mode = volumes[B_MODE]
    if b_mode.coverage is not None:
        coverage = Volume(b_mode.coverage, b_mode.grid, settings={"of": "coverage"})
        write_volume(coverage, folder / f"coverage{ending}", world)
        names.append(f"coverage{ending}")
    for name in ("trajectory.csv", "trajectory.mrk.json"):
        write_trajectory(trajectory, folder / name, world, image_center_mm(scan))
        names.append(name)
    if volume_format != "dicom":  # 3D Slicer imports those through its DICOM module
        names.append(write_slicer_script(folder).name)
    return tuple(names)


def write_vessels(
    folder: Path, trajectory: Trajectory, volumes: Mapping[str, Volume]
) -> tuple[str, ...]:
    """Write a picture of each volume of vessels over the B-mode, and return their names."""
    names = []
    for modality, volume in volumes.items():
        if modality.startswith(VESSELS):
            names.append(f"vessels_{modality}.png")
            write_vessel_picture(folder / names[-1], volume, volumes[B_MODE], trajectory, modality)
    return tuple(names)


def write_findings(folder: Path, report: Report, summary: Mapping[str, Any]) -> None:
    """Write the report and the same for machines."""
    write_report(folder / "report.html", report)
    (folder / "summary.json").write_text(json.dumps(plain(summary), indent=2) + "\n")


def summarize(
    scan: Scan, runs: tuple[ReportRun, ...], volume: Volume, report: Report
) -> dict[str, Any]:  # Any: the values of a JSON object
    """Return what ``summary.json`` holds."""
    return {
        "scan": scan.name,
        "frames": len(scan.frames),
        "spacing_mm": None if scan.calibration is None else list(scan.calibration.spacing_mm),
        "volume": {
            "size": list(volume.grid.size),
            "spacing_mm": list(volume.grid.spacing_mm),
            "origin_mm": list(volume.grid.origin_mm),
            "settings": dict(volume.settings),
        },
        "runs": [
            {
                "name": run.name,
                "method": run.trajectory.method,
                "metrics": {name: value for name, (value, _) in (run.metrics or {}).items()},
            }
            for run in runs
        ],
        "verdict": list(report.verdict),
        "assumptions": list(report.assumptions),
        "files": list(report.outputs),
        "command": report.command,
        "versions": dict(report.versions),
        "not_a_medical_device": True,
    }


def _facts(scan: Scan, runs: tuple[ReportRun, ...]) -> tuple[tuple[str, str], ...]:
    from sonosweep.cli.info import describe

    found = describe(scan)
    columns, rows = found["size_px"]
    facts = [
        ("Scan", scan.name),
        ("Frames", f"{found['frames']} of {columns} x {rows} pixels"),
    ]
    if found["spacing_mm"] is not None:
        x, y = found["spacing_mm"]
        facts.append(("Pixel size", f"{x:.4g} x {y:.4g} mm"))
        width, height = found["field_of_view_mm"]
        facts.append(("Field of view", f"{width:.1f} x {height:.1f} mm"))
    if found["duration_s"] is not None:
        rate = found.get("frame_rate_hz")
        shown = "" if rate is None or not math.isfinite(rate) else f" at {rate:.1f} Hz"
        facts.append(("Duration", f"{found['duration_s']:.2f} s{shown}"))
    if "poses" in found:
        facts.append(("Tracked frames", f"{found['poses']} of {found['frames']}"))
    if scan.image_to_reference is not None and found["poses"]:
        # That of the compared points where there are such, or the page would hold two lengths.
        measured = [run.metrics["path_length_mm"][0] for run in runs if run.metrics]
        length = (*measured, found["path_length_mm"])[0]
        facts.append(("Tracked path", f"{length:.1f} mm"))
        facts.append(("Tracked turn", f"{_turn_deg(select_tracked(scan)):.1f}°"))
    return tuple(facts)


def _turn_deg(scan: Scan) -> float:
    from sonosweep.geometry import angle_between_rotations

    poses = scan.image_to_reference
    assert poses is not None
    return math.degrees(float(angle_between_rotations(poses[0, :3, :3], poses[-1, :3, :3])))
