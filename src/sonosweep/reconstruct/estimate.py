"""From a scan to its trajectory, tracked or estimated."""

import torch

from sonosweep.errors import ScanError
from sonosweep.estimators.estimator import MotionEstimator, Progress
from sonosweep.geometry import poses_from_steps, step_from_motion
from sonosweep.scan import Scan, Trajectory

# Elevational translation, pitch and yaw: what two images of speckle leave in doubt together.
MIRRORED = (2, 3, 4)


def estimate_trajectory(
    scan: Scan,
    estimator: MotionEstimator,
    direction: int = 1,
    progress: Progress | None = None,
) -> Trajectory:
    """Return the trajectory an estimator reads off the frames of a scan.

    Args:
        scan: What was recorded; its tracked poses are not looked at.
        estimator: What reads the motion.
        direction: 1 if the probe swept towards its +z axis (x cross y), -1 if the other
            way. Speckle cannot tell, so somebody must.
        progress: Called with (done, total).

    Raises:
        ScanError: If the direction is neither, or the estimator cannot use the scan.
    """
    if direction not in (1, -1):
        raise ScanError(f"direction must be 1 (forward) or -1 (backward), got {direction}")
    estimate = estimator.estimate(scan, progress)
    motion = estimate.motion.to(torch.float64).clone()
    motion[:, MIRRORED] *= direction
    word = "forward (+z)" if direction == 1 else "backward (-z)"
    return Trajectory(
        image_to_reference=poses_from_steps(
            step_from_motion(motion), first=torch.eye(4, dtype=torch.float64)
        ),
        timestamps_s=scan.timestamps_s,
        step_std=None if estimate.std is None else estimate.std.to(torch.float64),
        method=estimator.name,
        assumptions=(
            f"The probe swept {word}: images of speckle cannot tell, this is a prior.",
            *estimate.assumptions,
        ),
    )


def tracked_trajectory(scan: Scan) -> Trajectory:
    """Return the tracker's trajectory of a scan whose every frame has a pose.

    Raises:
        ScanError: If there are no poses, or some are missing
            (:func:`sonosweep.scan.select_tracked` leaves those frames out).
    """
    if scan.image_to_reference is None:
        reason = scan.notes.get("poses", "the file holds none")
        raise ScanError(f"'{scan.name}' has no tracked poses: {reason}")
    return Trajectory(
        image_to_reference=scan.image_to_reference,
        timestamps_s=scan.timestamps_s,
        method="tracked",
    )
