"""Methods without a network, fitted to the training scans of a data set where they are fitted."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from sonosweep.errors import ScanError
from sonosweep.estimators import DecorrelationCurve, calibrate, read_curve, write_curve
from sonosweep.evaluate.methods import (
    Decorrelation,
    MeanMotion,
    Method,
    NoMotion,
    TrueMean,
    file_digest,
    tracked_motion,
)
from sonosweep.geometry import MOTION_NAMES
from sonosweep.io import open_scan
from sonosweep.scan import Scan, locate_image
from sonosweep.simulate import refuse_test_subjects

CALIBRATION_SCANS = 3
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
    training: Sequence[Path],
    folder: Path,
    progress: Callable[[int, int], None] | None = None,
) -> list[Method]:
    """Return the decorrelation estimator, its scale guessed and its scale calibrated.

    The curve comes from the first scan of each of the first few training subjects; the
    direction, which speckle cannot tell, is that of the training scans.

    Args:
        training: Files of tracked scans, none of a test subject.
        folder: Where curves are kept, so that each is measured once.
        progress: Called with the scans done and in all.

    Raises:
        ScanError: As :func:`quick_baselines`, or if a scan does not decorrelate.
        FormatError: If the folder cannot be written to.
    """
    direction = -1 if float(mean_motion(training)[ELEVATIONAL]) < 0 else 1
    chosen = list(_one_of_each_subject(training).values())[:CALIBRATION_SCANS]
    curves = []
    for done, path in enumerate(chosen):
        curves.append(_curve(path, folder))
        if progress is not None:
            progress(done + 1, len(chosen))
    name = f"decorrelation, calibrated on {len(chosen)} training scans"
    return [
        Decorrelation(direction=direction),
        Decorrelation(name, mean_curve(curves), direction),
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
    kept = folder / f"curve_{version('sonosweep')}_{file_digest(path)[:16]}.toml"
    if not kept.is_file():
        write_curve(calibrate(locate_image(open_scan(path))), kept)
    return read_curve(kept)


def _comparable(curve: DecorrelationCurve, other: DecorrelationCurve) -> bool:
    return (
        len(curve.depth_mm) == len(other.depth_mm)
        and np.allclose(curve.depth_mm, other.depth_mm, atol=0.1)
        and len(curve.fineness_per_mm2) == len(other.fineness_per_mm2)
        and curve.dynamic_range_db == other.dynamic_range_db
    )


def _geometric_mean(values: Sequence[Sequence[float]]) -> tuple[float, ...]:
    return tuple(np.exp(np.log(np.asarray(values, dtype=np.float64)).mean(axis=0)).tolist())


def _one_of_each_subject(training: Sequence[Path]) -> dict[str, Path]:
    """Return the first scan of each subject."""
    found: dict[str, Path] = {}
    for path in training:
        scan = _allowed(open_scan(path))
        found.setdefault(scan.subject or scan.name, path)
    return found


def _allowed(scan: Scan) -> Scan:
    """Return the scan if methods may learn from it."""
    refuse_test_subjects([scan.subject])
    return scan
