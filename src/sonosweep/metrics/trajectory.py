"""How far an estimated trajectory is from the true one, in the paper's numbers.

Every function takes ``image_to_reference`` of each frame, estimated and true. Both are
first expressed in their own frame 0 (``inv(T[0]) @ T[i]``), so that neither reference
matters. Distances are of points of the frame, given in image coordinates, and averaged over
them; ``weights`` (summing to 1) make it a weighted mean.
"""

import math
from dataclasses import asdict, dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sonosweep.errors import ScanError
from sonosweep.geometry import (
    EulerOrder,
    angle_between_rotations,
    euler_from_rotation,
    invert_pose,
    transform_points,
)

# The released code turns about 'YZX' of its axes (rows, columns, out of plane), which are
# our y, x and -z: the same turns in our axes are 'XZY'.
PAPER_EULER_ORDER: EulerOrder = "XZY"
# A path shorter than this is a probe at rest; a rate per length would be noise over noise.
SHORTEST_PATH_MM = 1e-6


@dataclass(frozen=True)
class TrajectoryMetrics:
    """The errors of one estimated trajectory; a number that is not defined is ``None``.

    Attributes:
        frames: How many frames were compared.
        relative_error_mm: Mean absolute error of the three translations of a step (rAE).
        relative_error_deg: Mean absolute error of the three Euler angles of a step (rAE).
        relative_error_mixed: Mean of these two, mm and degrees in one: the rAE of the
            paper's tables.
        relative_angle_deg: Mean angle between the estimated and the true turn of a step.
        accumulated_error_mm: As above, of the pose seen from frame 0 (aAE).
        accumulated_error_deg: As above, differences wrapped to a half turn (aAE).
        accumulated_error_mixed: Mean of these two: the aAE of the paper's tables.
        accumulated_angle_deg: Mean angle between the estimated and the true turn.
        relative_frame_error_mm: Mean distance of a frame's points after one step (rFE).
        accumulated_frame_error_mm: Mean distance of a frame's points (aFE).
        correlation_cosine: Mean cosine similarity of point coordinates over time: Corr as
            the paper defines and its code computes it. It depends on where the points lie.
        correlation_pearson: Correlation of the displacement of points about its mean.
        final_drift_mm: Mean distance of the last frame's points (FD).
        final_drift_rate_path_percent: FD per length of the true path: FDR as the paper
            words it.
        final_drift_rate_chord_percent: FD per straight line from the first to the last true
            frame: FDR as the released code divides.
        median_drift_mm: Median over the frames of the mean distance of points.
        maximum_drift_mm: Largest of these.
        path_length_mm: Length of the true path of the centre of the points.
        chord_length_mm: Straight line between its ends.
        estimated_path_length_mm: Length of the estimated path of the same point.
    """

    frames: int
    relative_error_mm: float | None
    relative_error_deg: float | None
    relative_error_mixed: float | None
    relative_angle_deg: float | None
    accumulated_error_mm: float
    accumulated_error_deg: float
    accumulated_error_mixed: float
    accumulated_angle_deg: float
    relative_frame_error_mm: float | None
    accumulated_frame_error_mm: float
    correlation_cosine: float | None
    correlation_pearson: float | None
    final_drift_mm: float
    final_drift_rate_path_percent: float | None
    final_drift_rate_chord_percent: float | None
    median_drift_mm: float
    maximum_drift_mm: float
    path_length_mm: float
    chord_length_mm: float
    estimated_path_length_mm: float

    def as_dict(self) -> dict[str, float | int | None]:
        """Return the numbers by name, in the order above."""
        return asdict(self)


def evaluate_trajectory(
    estimated: Float[Tensor, "estimated_frames 4 4"],
    true: Float[Tensor, "frames 4 4"],
    points_mm: Float[Tensor, "points xyz=3"],
    weights: Float[Tensor, " points"] | None = None,
    tracked: Bool[Tensor, " flags"] | None = None,
    length_point_mm: Float[Tensor, "xyz=3"] | None = None,
    euler_order: EulerOrder = PAPER_EULER_ORDER,
) -> TrajectoryMetrics:
    """Return every metric of one trajectory.

    Args:
        estimated: ``image_to_reference`` of each frame, any reference.
        true: The same from the tracker; may hold NaN where ``tracked`` says no.
        points_mm: Points in image coordinates, usually
            :func:`sonosweep.metrics.frame_grid`.
        weights: Of the points, summing to 1; all the same when ``None``.
        tracked: Which frames have a true pose. The others are left out, and so are the
            steps into and out of them; the path goes straight across.
        length_point_mm: Whose path is the length of the sweep; the centre of the points
            when ``None``. The released code takes point 128 of its grid of 256, which is
            in the first column and halfway down.
        euler_order: Of the angles whose differences are averaged.

    Raises:
        ScanError: If the counts differ, fewer than two frames are tracked, or a tracked
            pose holds NaN.

    References:
        Lee et al., "Enhancing Free-hand 3D Photoacoustic and Ultrasound Reconstruction
        using Deep Learning", section "Evaluation Metrics".

    Differs:
        Frame 0, whose error is 0 by construction, is in no mean. Differences of angles are
        wrapped, which the released code does not do. The paper prints mm as the unit of
        FDR; its values are per cent.
    """
    keep = _check(estimated, true, tracked)
    if weights is None:
        weights = torch.full((len(points_mm),), 1 / len(points_mm), dtype=torch.float64)
    points, share = points_mm.double(), weights.double()
    center = (share[:, None] * points).sum(0) if length_point_mm is None else length_point_mm
    frames = keep.nonzero()[:, 0]
    a, b = _from_first_frame(estimated[frames]), _from_first_frame(true[frames])
    step_a, step_b = _steps_between_neighbors(a, frames), _steps_between_neighbors(b, frames)
    drift = point_distance(a, b, points, share)
    step_mm, step_deg = motion_error(step_a, step_b, euler_order)
    pose_mm, pose_deg = motion_error(a[1:], b[1:], euler_order)
    length, chord = path_length(b, center.double()), chord_length(b, center.double())
    return TrajectoryMetrics(
        frames=len(frames),
        relative_error_mm=_mean(step_mm),
        relative_error_deg=_mean(step_deg),
        relative_error_mixed=_mean(torch.cat((step_mm, step_deg), dim=-1)),
        relative_angle_deg=_mean(_angle_deg(step_a, step_b)),
        accumulated_error_mm=float(pose_mm.mean()),
        accumulated_error_deg=float(pose_deg.mean()),
        accumulated_error_mixed=float(torch.cat((pose_mm, pose_deg), dim=-1).mean()),
        accumulated_angle_deg=float(_angle_deg(a[1:], b[1:]).mean()),
        relative_frame_error_mm=_mean(point_distance(step_a, step_b, points, share)),
        accumulated_frame_error_mm=float(drift[1:].mean()),
        correlation_cosine=correlation_cosine(a, b, points, share),
        correlation_pearson=correlation_pearson(a, b, points, share),
        final_drift_mm=float(drift[-1]),
        final_drift_rate_path_percent=_rate(drift[-1], length),
        final_drift_rate_chord_percent=_rate(drift[-1], chord),
        median_drift_mm=float(drift[1:].quantile(0.5)),
        maximum_drift_mm=float(drift.max()),
        path_length_mm=float(length),
        chord_length_mm=float(chord),
        estimated_path_length_mm=float(path_length(a, center.double())),
    )


def drift_per_frame(
    estimated: Float[Tensor, "estimated_frames 4 4"],
    true: Float[Tensor, "frames 4 4"],
    points_mm: Float[Tensor, "points xyz=3"],
    weights: Float[Tensor, " points"] | None = None,
    tracked: Bool[Tensor, " flags"] | None = None,
) -> Float[Tensor, " frames"]:
    """Return the mean distance (mm) of each frame's points from where they truly are.

    Both trajectories start at the first tracked frame, whose drift is 0; frames that are
    not tracked get NaN. The mean over the frames after the first is the aFE, the last
    value the FD.

    Raises:
        ScanError: As :func:`evaluate_trajectory`.
    """
    keep = _check(estimated, true, tracked)
    if weights is None:
        weights = torch.full((len(points_mm),), 1 / len(points_mm), dtype=torch.float64)
    drift = torch.full((len(true),), math.nan, dtype=torch.float64)
    a, b = _from_first_frame(estimated[keep]), _from_first_frame(true[keep])
    drift[keep] = point_distance(a, b, points_mm.double(), weights.double())
    return drift


def align_first_frame(
    estimated: Float[Tensor, "estimated_frames 4 4"],
    true: Float[Tensor, "frames 4 4"],
    tracked: Bool[Tensor, " flags"] | None = None,
) -> Float[Tensor, "frames 4 4"]:
    """Return the estimated poses in the true reference, equal at the first tracked frame.

    Raises:
        ScanError: As :func:`evaluate_trajectory`.
    """
    first = int(_check(estimated, true, tracked).nonzero()[0])
    start = true[first].double() @ invert_pose(estimated[first].double())
    return start @ estimated.double()


def motion_error(
    estimated: Float[Tensor, "frames 4 4"],
    true: Float[Tensor, "frames 4 4"],
    euler_order: EulerOrder = PAPER_EULER_ORDER,
) -> tuple[Float[Tensor, "frames xyz=3"], Float[Tensor, "frames xyz=3"]]:
    """Return the absolute errors of the three translations (mm) and Euler angles (deg)."""
    translation = (estimated[:, :3, 3] - true[:, :3, 3]).abs()
    angles = torch.rad2deg(
        euler_from_rotation(estimated[:, :3, :3], euler_order)
        - euler_from_rotation(true[:, :3, :3], euler_order)
    )
    return translation, (torch.remainder(angles + 180, 360) - 180).abs()


def point_distance(
    estimated: Float[Tensor, "frames 4 4"],
    true: Float[Tensor, "frames 4 4"],
    points_mm: Float[Tensor, "points xyz=3"],
    weights: Float[Tensor, " points"],
) -> Float[Tensor, " frames"]:
    """Return the weighted mean over points of the distance between their two places, mm."""
    # The difference of the matrices, not of the points: the same number with fewer digits
    # lost when both poses are far from the origin.
    difference = transform_points(estimated - true, points_mm)
    return torch.linalg.vector_norm(difference, dim=-1) @ weights


def path_length(
    image_to_reference: Float[Tensor, "frames 4 4"], point_mm: Float[Tensor, "xyz=3"]
) -> Float[Tensor, ""]:
    """Return the length (mm) of the path of one point of the image.

    The jitter of a tracker lengthens it: 0.2 mm of noise on 900 frames at rest adds up to
    more than 200 mm.
    """
    path = transform_points(image_to_reference, point_mm[None])[:, 0]
    return torch.linalg.vector_norm(path.diff(dim=0), dim=-1).sum()


def chord_length(
    image_to_reference: Float[Tensor, "frames 4 4"], point_mm: Float[Tensor, "xyz=3"]
) -> Float[Tensor, ""]:
    """Return the straight distance (mm) of one point between the first and last frame."""
    ends = transform_points(image_to_reference[[0, -1]], point_mm[None])[:, 0]
    return torch.linalg.vector_norm(ends[1] - ends[0])


def correlation_cosine(
    estimated: Float[Tensor, "frames 4 4"],
    true: Float[Tensor, "frames 4 4"],
    points_mm: Float[Tensor, "points xyz=3"],
    weights: Float[Tensor, " points"],
) -> float | None:
    """Return Corr as the paper's code has it: the mean cosine of coordinates over time.

    Each coordinate of each point, seen from frame 0, is one vector over time; means are not
    removed, so a point far from the origin scores near 1 however wrong its motion is.
    Coordinates that stay at 0 in both are left out; ``None`` if all do.
    """
    a, b = transform_points(estimated, points_mm), transform_points(true, points_mm)
    norm_a, norm_b = torch.linalg.vector_norm(a, dim=0), torch.linalg.vector_norm(b, dim=0)
    share = weights[:, None] * ((norm_a > SHORTEST_PATH_MM) | (norm_b > SHORTEST_PATH_MM))
    if not bool((share > 0).any()):
        return None
    cosine = (a * b).sum(0) / (norm_a * norm_b).clamp_min(SHORTEST_PATH_MM**2)
    return float((share * cosine).sum() / share.sum())


def correlation_pearson(
    estimated: Float[Tensor, "frames 4 4"],
    true: Float[Tensor, "frames 4 4"],
    points_mm: Float[Tensor, "points xyz=3"],
    weights: Float[Tensor, " points"],
) -> float | None:
    """Return the correlation, -1 to 1, of the points' displacement about its mean in time.

    Covariance and variances are summed over x, y and z and over the points before they are
    divided: directions in which nothing moves do not count, and turning the reference
    changes nothing. ``None`` if the points of either trajectory stay where they are.

    Differs:
        Not the paper's Corr, which keeps the mean: see :func:`correlation_cosine`.
    """
    a, b = transform_points(estimated, points_mm), transform_points(true, points_mm)
    a, b = a - a.mean(0), b - b.mean(0)
    share = weights[:, None]
    spread_a, spread_b = (torch.sqrt((share * c * c).sum()) for c in (a, b))
    if float(torch.minimum(spread_a, spread_b)) <= SHORTEST_PATH_MM:
        return None
    return float((share * a * b).sum() / (spread_a * spread_b))


def _check(estimated: Tensor, true: Tensor, tracked: Tensor | None) -> Tensor:
    """Return which frames count."""
    if len(estimated) != len(true):
        raise ScanError(f"{len(estimated)} estimated poses but {len(true)} true ones")
    keep = torch.ones(len(true), dtype=torch.bool) if tracked is None else tracked
    if len(keep) != len(true):
        raise ScanError(f"{len(true)} true poses but {len(keep)} tracking flags")
    if int(keep.sum()) < 2:
        raise ScanError(
            f"comparing trajectories needs two tracked frames or more, got {int(keep.sum())}"
        )
    for what, poses in (("estimated", estimated), ("true", true)):
        wrong = keep & ~torch.isfinite(poses).flatten(-2).all(-1)
        if bool(wrong.any()):
            raise ScanError(
                f"the {what} pose of frame {int(wrong.nonzero()[0])} holds values that are not"
                " numbers: mark frames without pose as not tracked"
            )
    return keep


def _from_first_frame(image_to_reference: Tensor) -> Tensor:
    poses = image_to_reference.double()
    return invert_pose(poses[0]) @ poses


def _steps_between_neighbors(poses: Tensor, frames: Tensor) -> Tensor:
    """Return the steps between frames that follow one another, none across a gap."""
    together = frames.diff() == 1
    return invert_pose(poses[:-1][together]) @ poses[1:][together]


def _angle_deg(estimated: Tensor, true: Tensor) -> Tensor:
    return torch.rad2deg(angle_between_rotations(estimated[:, :3, :3], true[:, :3, :3]))


def _mean(values: Tensor) -> float | None:
    return float(values.mean()) if values.numel() else None


def _rate(drift: Tensor, length: Tensor) -> float | None:
    return float(100 * drift / length) if float(length) > SHORTEST_PATH_MM else None
