"""Options that say where the motion comes from, and the step that finds it."""

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from cyclopts import Group, Parameter

if TYPE_CHECKING:
    from sonosweep.estimators import MotionEstimator
    from sonosweep.scan import Scan, Trajectory

MOTION = Group("Motion", sort_key=1)


@Parameter(name="*", group=MOTION)
@dataclass(frozen=True)
class MotionOptions:
    """Where the motion comes from.

    Attributes:
        estimator: What reads the motion off the frames.
        poses: Whether to estimate the motion or to take the tracker's.
        direction: Which way the probe swept; images of speckle cannot tell.
        calibration: Decorrelation curve of the probe and preset, from `calibrate`.
        crop: Part of the frame to look at, as column, row, width, height in pixels;
            found by itself otherwise.
    """

    estimator: Literal["decorrelation"] = "decorrelation"
    poses: Literal["estimated", "tracked"] = "estimated"
    direction: Literal["forward", "backward"] = "forward"
    calibration: Path | None = None
    crop: tuple[int, int, int, int] | None = None


def find_trajectory(scan: "Scan", options: MotionOptions) -> tuple["Scan", "Trajectory"]:
    """Return the frames that have a pose, and these poses, as the options ask.

    The scan comes back because frames that the tracker missed are left out of it.
    """
    from sonosweep.cli.progress import progress
    from sonosweep.errors import ScanError
    from sonosweep.reconstruct import estimate_trajectory, tracked_trajectory
    from sonosweep.scan import locate_image, select_tracked

    if options.poses == "tracked":
        if options.calibration is not None:
            raise ScanError("--calibration is for estimating, and --poses tracked does not")
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
    located = locate_image(scan, options.crop)
    with progress("estimating motion") as show:
        trajectory = estimate_trajectory(
            located,
            make_estimator(options),
            direction=1 if options.direction == "forward" else -1,
            progress=show,
        )
    return located, trajectory


def make_estimator(options: MotionOptions) -> "MotionEstimator":
    """Return the estimator that the options name."""
    from sonosweep.estimators import DecorrelationEstimator, read_curve

    curve = None if options.calibration is None else read_curve(options.calibration)
    return DecorrelationEstimator(curve=curve)
