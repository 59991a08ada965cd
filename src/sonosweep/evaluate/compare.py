"""Compare an estimated trajectory with the tracked one of the same sweep."""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sonosweep.errors import ScanError
from sonosweep.geometry import steps_from_poses, transform_points
from sonosweep.metrics import (
    TrajectoryMetrics,
    TusrecErrors,
    drift_per_frame,
    evaluate_trajectory,
    frame_grid,
    tusrec_errors,
)
from sonosweep.scan import Scan, Trajectory, pixel_to_image
from sonosweep.scan.clock import match_poses

Match = Literal["count", "time"]
# Tracked frames may be missing, but a gap of more of them than this is not interpolated.
LARGEST_GAP_FRAMES = 2.5


@dataclass(frozen=True, eq=False)
class TrajectoryComparison:
    """How far one estimated trajectory is from the tracked one.

    Attributes:
        name: Of the scan.
        subject: Of the scan, if it names one.
        method: What made the estimate.
        metrics: The paper's numbers.
        tusrec: Those of the TUS-REC challenges, over all pixels; ``None`` if a frame has
            no tracked pose, or the size of the frames is not known.
        drift_mm: Of each estimated frame; NaN where there is no tracked pose.
        frames_without_pose: How many estimated frames have no tracked pose and do not
            count.
        matched_by: Whether frames were matched by number or by time.
        direction_agrees: Whether the estimate sweeps the way the tracker says, front or
            back; ``None`` if it does not move out of its plane. Speckle alone cannot tell.
        points: Which points the distances are averaged over, in words.
        assumptions: Of the estimate.
    """

    name: str
    subject: str | None
    method: str
    metrics: TrajectoryMetrics
    tusrec: TusrecErrors | None
    drift_mm: Float[Tensor, " frames"]
    frames_without_pose: int
    matched_by: Match
    direction_agrees: bool | None
    points: str
    assumptions: tuple[str, ...] = ()

    def __str__(self) -> str:
        """Return one sentence for people."""
        numbers = self.metrics
        rate = numbers.final_drift_rate_path_percent
        of_path = (
            "" if rate is None else f" ({rate:.3g} % of a path of {numbers.path_length_mm:.4g} mm)"
        )
        text = (
            f"{self.name}: final drift {numbers.final_drift_mm:.3g} mm{of_path}, median"
            f" {numbers.median_drift_mm:.3g} mm, over {numbers.frames} frames"
        )
        if self.direction_agrees is False:
            text += "; the estimate sweeps the other way: set the direction and run again"
        return text


def compare_trajectories(
    estimated: Trajectory,
    true: Scan | Trajectory,
    points_mm: Float[Tensor, "points xyz=3"] | None = None,
    match: Match | None = None,
    max_gap_s: float | None = None,
    landmarks: Int[Tensor, "landmarks frame_column_row=3"] | None = None,
) -> TrajectoryComparison:
    """Return how far an estimated trajectory is from a tracked one.

    Args:
        estimated: Poses of the frames.
        true: The scan with its tracked poses, or a trajectory.
        points_mm: Points in image coordinates to average distances over; when ``None``, 16
            x 16 of the scan's region, or of the whole frame if no region is known.
        match: By number of the frame, or by time with the tracked poses interpolated; when
            ``None``, by number if there are as many, else by time.
        max_gap_s: Longest time between two tracked poses to interpolate over; 2.5 times
            their usual distance when ``None``.
        landmarks: For the challenge's landmark errors: (frame, column, row), from 0.

    Raises:
        ScanError: If the scan has no poses or no pixel spacing, the two cannot be matched,
            or landmarks, which name frames, come with a match by time.
    """
    name = true.name if isinstance(true, Scan) else true.method
    points, described = _points(true, points_mm)
    matched_by = match or _choose_match(estimated, true, name)
    if landmarks is not None and matched_by == "time":
        raise ScanError(f"landmarks name frames of '{name}': match by number, not by time")
    if matched_by == "count":
        poses, tracked = _poses_by_count(estimated, true, name)
    else:
        poses, tracked = _poses_by_time(estimated, true, name, max_gap_s)
    mine = estimated.image_to_reference
    return TrajectoryComparison(
        name=name,
        subject=true.subject if isinstance(true, Scan) else None,
        method=estimated.method,
        metrics=evaluate_trajectory(mine, poses, points, tracked=tracked),
        tusrec=_tusrec(mine, poses, tracked, true, landmarks),
        drift_mm=drift_per_frame(mine, poses, points, tracked=tracked),
        frames_without_pose=int((~tracked).sum()),
        matched_by=matched_by,
        direction_agrees=_direction_agrees(mine, poses, tracked),
        points=described,
        assumptions=estimated.assumptions,
    )


def _points(true: Scan | Trajectory, points_mm: Tensor | None) -> tuple[Tensor, str]:
    """Return the points to average over, and what they are."""
    if points_mm is not None:
        return points_mm, f"{len(points_mm)} given points"
    if not isinstance(true, Scan):
        raise ScanError("give the scan, or points of the image: a trajectory has no image size")
    if true.calibration is None:
        raise ScanError(
            f"comparing trajectories needs the pixel spacing of '{true.name}', which is not known"
        )
    rows, columns = true.frames.shape[1:3]
    column, row, width, height = (0, 0, columns, rows)
    if true.region is not None:
        column, row, width, height = true.region.rectangle_px
    pixels = frame_grid(height, width, (1.0, 1.0))
    pixels = pixels + torch.tensor([column, row, 0], dtype=torch.float64)
    described = (
        f"{len(pixels)} pixels of columns {column} to {column + width - 1} and rows {row} to"
        f" {row + height - 1}"
    )
    return transform_points(pixel_to_image(true.calibration), pixels), described


def _true_poses(true: Scan | Trajectory, name: str) -> tuple[Tensor, Tensor]:
    """Return the tracked poses and which of them are valid."""
    poses = true.image_to_reference
    if poses is None:
        raise ScanError(f"'{name}' holds no tracked poses to compare with")
    flags = true.tracked if isinstance(true, Scan) else None
    return poses, torch.ones(len(poses), dtype=torch.bool) if flags is None else flags


def _choose_match(estimated: Trajectory, true: Scan | Trajectory, name: str) -> Match:
    poses, _ = _true_poses(true, name)
    if len(poses) == len(estimated.image_to_reference):
        return "count"
    if estimated.timestamps_s is None or true.timestamps_s is None:
        raise ScanError(
            f"{len(estimated.image_to_reference)} estimated poses but {len(poses)} tracked ones in"
            f" '{name}', and no times to match them by"
        )
    return "time"


def _poses_by_count(
    estimated: Trajectory, true: Scan | Trajectory, name: str
) -> tuple[Tensor, Tensor]:
    poses, tracked = _true_poses(true, name)
    if len(poses) != len(estimated.image_to_reference):
        raise ScanError(
            f"{len(estimated.image_to_reference)} estimated poses but {len(poses)} tracked ones in"
            f" '{name}'; match them by time"
        )
    return poses, tracked


def _poses_by_time(
    estimated: Trajectory, true: Scan | Trajectory, name: str, max_gap_s: float | None
) -> tuple[Tensor, Tensor]:
    poses, tracked = _true_poses(true, name)
    if estimated.timestamps_s is None or true.timestamps_s is None:
        which = "the estimate" if estimated.timestamps_s is None else f"'{name}'"
        raise ScanError(f"matching by time needs times, and {which} has none")
    times = true.timestamps_s
    if max_gap_s is None:
        usual = float(times.double().diff().median()) if len(times) > 1 else 0.1
        max_gap_s = LARGEST_GAP_FRAMES * usual
    matched, found, _ = match_poses(
        times, poses, estimated.timestamps_s, max_gap_s=max_gap_s, valid=tracked
    )
    return matched, found


def _tusrec(
    estimated: Tensor,
    poses: Tensor,
    tracked: Tensor,
    true: Scan | Trajectory,
    landmarks: Tensor | None,
) -> TusrecErrors | None:
    if not (isinstance(true, Scan) and true.calibration is not None and bool(tracked.all())):
        return None
    rows, columns = true.frames.shape[1:3]
    spacing = true.calibration.spacing_mm
    return tusrec_errors(estimated, poses, rows, columns, spacing, landmarks)


def _direction_agrees(estimated: Tensor, true: Tensor, tracked: Tensor) -> bool | None:
    """Say whether elevational steps have the same sign, over all."""
    both = tracked[1:] & tracked[:-1]
    a, b = (steps_from_poses(poses.double())[both, 2, 3] for poses in (estimated, true))
    agreement = float(a @ b)
    return None if agreement == 0 else agreement > 0
