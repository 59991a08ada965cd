"""Options that say where the motion comes from, and the step that finds it."""

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from cyclopts import Group, Parameter

if TYPE_CHECKING:
    from sonosweep.estimators import MotionEstimator
    from sonosweep.estimators.learned import OnMaps
    from sonosweep.scan import Scan, Trajectory

MOTION = Group("Motion", sort_key=1)
DECORRELATION = "decorrelation"  # the one estimator that needs no weights


@Parameter(name="*", group=MOTION)
@dataclass(frozen=True)
class MotionOptions:
    """Where the motion comes from.

    Attributes:
        estimator: What reads the motion off the frames: decorrelation, or a network by the
            name of weights that come with the package (any other word lists them), a
            .safetensors file or the folder of a training run.
        poses: Whether to estimate the motion or to take the tracker's.
        direction: Which way the probe swept; images of speckle cannot tell.
        calibration: Decorrelation curve of the probe and preset, from `calibrate`.
        crop: Part of the frame to look at, as column, row, width, height in pixels;
            found by itself otherwise.
        precision: Of a network's arithmetic; auto is bf16 where the processor has it.
        device: Where a network runs; auto is the GPU if there is one.
    """

    estimator: str = DECORRELATION
    poses: Literal["estimated", "tracked"] = "estimated"
    direction: Literal["forward", "backward"] = "forward"
    calibration: Path | None = None
    crop: tuple[int, int, int, int] | None = None
    precision: Literal["auto", "bf16", "fp32"] = "auto"
    device: Literal["auto", "cpu", "cuda"] = "auto"


def find_trajectory(
    scan: "Scan", options: MotionOptions, estimator: "MotionEstimator | None" = None
) -> tuple["Scan", "Trajectory"]:
    """Return the frames that have a pose, and these poses, as the options ask.

    The scan comes back because frames that the tracker missed are left out of it.

    Args:
        scan: What was recorded.
        options: Where the motion comes from.
        estimator: That of the options; made here if ``None``.
    """
    from sonosweep.cli.progress import progress
    from sonosweep.reconstruct import estimate_trajectory, tracked_trajectory
    from sonosweep.scan import locate_image, select_tracked

    refuse_idle(options)
    if options.poses == "tracked":
        seen = select_tracked(scan)
        trajectory = tracked_trajectory(seen)
        if scan.tracked is not None:  # the numbers that these frames have in the file
            trajectory = replace(trajectory, frames=scan.tracked.nonzero()[:, 0])
            missed = len(scan.frames) - len(seen.frames)
            if missed:
                print(
                    f"{missed} of {len(scan.frames)} frames have no pose and are left out",
                    file=sys.stderr,
                )
        return seen, trajectory
    estimator = estimator or make_estimator(options)
    located = locate_image(scan, options.crop)
    with progress("estimating motion") as show:
        trajectory = estimate_trajectory(
            located,
            estimator,
            direction=1 if options.direction == "forward" else -1,
            progress=show,
        )
    return located, trajectory


def make_estimator(options: MotionOptions, on_maps: "OnMaps | None" = None) -> "MotionEstimator":
    """Return the estimator that the options name."""
    from sonosweep.estimators import DecorrelationEstimator, LearnedEstimator, read_curve

    if options.estimator != DECORRELATION:
        return LearnedEstimator(options.estimator, options.precision, options.device, on_maps)
    curve = None if options.calibration is None else read_curve(options.calibration)
    return DecorrelationEstimator(curve=curve)


def is_learned(options: MotionOptions) -> bool:
    """Say whether a network will read the motion."""
    return options.poses == "estimated" and options.estimator != DECORRELATION


def refuse_idle(options: MotionOptions) -> None:
    """Refuse options that have nothing to act on: nobody shall think that they did.

    Raises:
        ScanError: If there is one.
    """
    from sonosweep.errors import ScanError

    usual = MotionOptions()
    tracked = options.poses == "tracked"
    if tracked and options.calibration is not None:
        raise ScanError("--calibration is for estimating, and --poses tracked does not")
    if tracked and options.estimator != usual.estimator:
        raise ScanError("--estimator is for estimating, and --poses tracked does not")
    if is_learned(options):
        if options.calibration is not None:
            raise ScanError(
                "--calibration is a curve for the decorrelation estimator: a network has learned"
                " its own"
            )
        return
    for name in ("precision", "device"):
        if getattr(options, name) != getattr(usual, name):
            raise ScanError(f"--{name} is about a network: name one with --estimator")
