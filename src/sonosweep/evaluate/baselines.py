"""Methods without a network, fitted to the training scans of a data set where they are fitted."""

import json
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from sonosweep.errors import ScanError
from sonosweep.estimators import DecorrelationCurve, calibrate, read_curve, write_curve
from sonosweep.estimators.calibrate import LEAST_OUT_OF_PLANE, out_of_plane_share
from sonosweep.estimators.network_input import center_mm, center_poses
from sonosweep.evaluate.methods import (
    Decorrelation,
    MeanMotion,
    Method,
    NoMotion,
    TrueMean,
    code_digest,
    file_digest,
    tracked_motion,
)
from sonosweep.geometry import MOTION_NAMES, steps_from_poses
from sonosweep.io import open_scan
from sonosweep.io.atomic import write_beside
from sonosweep.scan import Scan, Trajectory, locate_image
from sonosweep.simulate import refuse_test_subjects

CALIBRATION_SCANS = 3
SHORTEST_MM = 0.1  # of a movement that a scale is taken from
ELEVATIONAL = MOTION_NAMES.index("elevational")


def quick_baselines(training: Sequence[Path]) -> list[Method]:
    """Return the methods that look at no frame: no motion, and two steady ones.

    Args:
        training: Files of tracked scans, none of a test subject.

    Raises:
        ScanError: If there are none, or one is of a subject that is kept for tests.
    """
    motion = mean_motion(training)
    lateral, axial, elevational, pitch, yaw, roll = motion.tolist()
    learned = MeanMotion(motion=(lateral, axial, elevational, pitch, yaw, roll))
    return [NoMotion(), learned, TrueMean()]


def decorrelation_baselines(
    teaching: Sequence[Path],
    folder: Path,
    progress: Callable[[int, int], None] | None = None,
) -> list[Method]:
    """Return the decorrelation estimator as it is, and with what tracked scans teach it.

    It is taught in two ways, on the longest scans of different subjects: by how much its guess
    of the elevational scale is off, and with a whole curve. The direction, which speckle
    cannot tell, is that of these scans.

    Args:
        teaching: Files of tracked scans, none of a test subject.
        folder: Where what was learned is kept, so that it is learned once.
        progress: Called with the scans done and in all.

    Raises:
        ScanError: As :func:`quick_baselines`, or if a scan does not decorrelate.
        FormatError: If the folder cannot be written to.
    """
    direction = -1 if float(mean_motion(teaching)[ELEVATIONAL]) < 0 else 1
    chosen = longest_of_subjects(teaching)[:CALIBRATION_SCANS]
    if not chosen:
        raise ScanError(
            "no scan to learn from moves out of its plane, so decorrelation learns nothing: take"
            " --baselines quick"
        )
    lessons = []
    for done, path in enumerate(chosen):
        lessons.append((_stretch(path, folder), _curve(path, folder)))
        if progress is not None:
            progress(done + 1, len(chosen))
    stretch = float(np.exp(np.mean([np.log(factor) for factor, _ in lessons])))
    curve = mean_curve([curve for _, curve in lessons])
    frames = sum(len(open_scan(path).frames) for path in chosen)
    of = f"of {frames} tracked frames"
    return [
        Decorrelation(direction=direction),
        Decorrelation(f"decorrelation, scale {of}", None, direction, stretch),
        Decorrelation(f"decorrelation, curve {of}", curve, direction),
    ]


def mean_motion(training: Sequence[Path]) -> Tensor:
    """Return the mean motion (mm, rad) over all tracked steps of the training scans.

    Raises:
        ScanError: If there are none, or one is of a subject that is kept for tests.
    """
    if not training:
        raise ScanError("the mean motion needs a training scan")
    scans = [_allowed(open_scan(path)) for path in training]
    return torch.cat([tracked_motion(scan) for scan in scans]).mean(0)


def mean_curve(curves: Sequence[DecorrelationCurve]) -> DecorrelationCurve:
    """Return the mean of curves of one probe and preset, measured at the same depths.

    Widths and finenesses are averaged as logarithms, since they are scales.

    Raises:
        ScanError: If there are none, or their depths differ.
    """
    if not curves:
        raise ScanError("a mean curve needs a curve")
    first = curves[0]
    if any(not _comparable(curve, first) for curve in curves):
        raise ScanError("decorrelation curves of different depths have no mean")
    return replace(
        first,
        width_mm=_geometric_mean([curve.width_mm for curve in curves]),
        fineness_per_mm2=_geometric_mean([curve.fineness_per_mm2 for curve in curves]),
        exponent=float(np.mean([curve.exponent for curve in curves])),
        peak=float(np.mean([curve.peak for curve in curves])),
        coherence=float(np.mean([curve.coherence for curve in curves])),
        preset=", ".join(curve.preset for curve in curves),
        quality={},
    )


def _curve(path: Path, folder: Path) -> DecorrelationCurve:
    """Return the curve of a tracked scan, measured if it is not there yet."""
    kept = folder / f"curve_{code_digest()}_{file_digest(path)[:16]}.toml"
    if not kept.is_file():
        write_curve(calibrate(locate_image(open_scan(path))), kept)
    return read_curve(kept)


def _stretch(path: Path, folder: Path) -> float:
    """Return how much farther a scan truly went than guessed, measured if not there yet."""
    kept = folder / f"stretch_{code_digest()}_{file_digest(path)[:16]}.json"
    with suppress(OSError, ValueError, TypeError, KeyError):
        return float(json.loads(kept.read_text(encoding="utf-8"))["stretch"])
    scan = locate_image(open_scan(path))
    guess = Decorrelation().trajectory(replace(scan, image_to_reference=None, tracked=None))
    true_mm, guessed_mm = abs(_elevation_mm(scan, scan)), abs(_elevation_mm(guess, scan))
    if min(true_mm, guessed_mm) < SHORTEST_MM:
        raise ScanError(f"'{scan.name}' teaches no scale: its probe did not move out of its plane")
    with write_beside(kept) as temporary:
        content = json.dumps({"stretch": true_mm / guessed_mm})
        temporary.write_text(content + "\n", encoding="utf-8")
    return true_mm / guessed_mm


def _elevation_mm(poses: Scan | Trajectory, scan: Scan) -> float:
    """Return how far the centre of the frame went out of its plane, over all steps."""
    assert poses.image_to_reference is not None
    steps = steps_from_poses(center_poses(poses.image_to_reference.double(), center_mm(scan)))
    return float(steps[:, ELEVATIONAL, 3].nansum())


def _comparable(curve: DecorrelationCurve, other: DecorrelationCurve) -> bool:
    return (
        len(curve.depth_mm) == len(other.depth_mm)
        and np.allclose(curve.depth_mm, other.depth_mm, atol=0.1)
        and len(curve.fineness_per_mm2) == len(other.fineness_per_mm2)
        and curve.dynamic_range_db == other.dynamic_range_db
    )


def _geometric_mean(values: Sequence[Sequence[float]]) -> tuple[float, ...]:
    return tuple(np.exp(np.log(np.asarray(values, dtype=np.float64)).mean(axis=0)).tolist())


def longest_of_subjects(teaching: Sequence[Path]) -> list[Path]:
    """Return the longest scan of each subject, longest first, otherwise in their order.

    Scans whose probe moves in its plane are left out: they teach nothing about what is out of it.
    """
    found: dict[str, tuple[int, Path]] = {}
    for path in teaching:
        scan = _allowed(open_scan(path))
        if not _teaches(scan):
            continue
        who, frames = scan.subject or scan.name, len(scan.frames)
        if who not in found or frames > found[who][0]:
            found[who] = (frames, path)
    return [path for _, path in sorted(found.values(), key=lambda longest: -longest[0])]


def _teaches(scan: Scan) -> bool:
    """Say whether the probe moves out of its plane; what has no poses is refused elsewhere."""
    if scan.image_to_reference is None or scan.calibration is None:
        return True
    share = out_of_plane_share(scan.image_to_reference, np.array(center_mm(scan)))
    return not share < LEAST_OUT_OF_PLANE


def _allowed(scan: Scan) -> Scan:
    """Return the scan if methods may learn from it."""
    refuse_test_subjects([scan.subject])
    return scan
