"""The four errors of the TUS-REC challenges, and the displacement fields it asks for.

*Global* is the displacement of a pixel from frame 0 to frame i, *local* that from frame
i - 1 to frame i; both are seen from the earlier frame, in image mm. Frame 0 has none, so N
frames give N - 1 fields. Landmarks are rows of (frame, column, row), all counted from 0 as
:func:`sonosweep.io.tusrec.read_tusrec_landmarks` gives them; the challenge's files count
columns and rows from 1.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from sonosweep.errors import ScanError
from sonosweep.geometry import invert_pose, pixel_grid, steps_from_poses, transform_points
from sonosweep.metrics.frame_points import frame_quadrature
from sonosweep.metrics.trajectory import point_distance

Scope = Literal["global", "local"]

# A mean that changes by less between two rules is taken as that over all pixels.
SETTLED_RELATIVE = 1e-6
SETTLED_MM = 1e-9
POINTS_AT_ONCE = 500_000


@dataclass(frozen=True)
class TusrecErrors:
    """The challenge's errors of one scan, in mm.

    Attributes:
        global_pixel_error_mm: GPE, over all pixels of all frames.
        global_landmark_error_mm: GLE, over the landmarks; ``None`` without landmarks.
        local_pixel_error_mm: LPE.
        local_landmark_error_mm: LLE.
    """

    global_pixel_error_mm: float
    global_landmark_error_mm: float | None
    local_pixel_error_mm: float
    local_landmark_error_mm: float | None


def tusrec_errors(
    estimated: Float[Tensor, "estimated_frames 4 4"],
    true: Float[Tensor, "frames 4 4"],
    rows: int,
    columns: int,
    spacing_mm: tuple[float, float],
    landmarks: Int[Tensor, "landmarks frame_column_row=3"] | None = None,
) -> TusrecErrors:
    """Return GPE, GLE, LPE and LLE of one scan.

    Args:
        estimated: ``image_to_reference`` of each frame.
        true: The same from the tracker.
        rows: Height of a frame; 480 in the challenge.
        columns: Width of a frame; 640 in the challenge.
        spacing_mm: Distance between neighbouring columns and rows.
        landmarks: Frame (not 0, which does not move), column and row, counted from 0.

    Raises:
        ScanError: If the counts differ, there is one frame only, or a landmark lies in no
            frame after the first or outside the image.

    References:
        Li et al., "TUS-REC2024: A challenge to reconstruct 3D freehand ultrasound without
        external tracker", 2025, section "Evaluation metrics".
    """
    if len(estimated) != len(true):
        raise ScanError(f"{len(estimated)} estimated poses but {len(true)} true ones")
    if len(true) < 2:
        raise ScanError(f"the errors need two frames or more, got {len(true)}")
    pixel_errors: dict[str, float] = {}
    landmark_errors: dict[str, float | None] = {"global": None, "local": None}
    for scope in get_args(Scope):
        a, b = _motions(estimated, scope), _motions(true, scope)
        pixel_errors[scope] = float(mean_pixel_distance(a, b, rows, columns, spacing_mm).mean())
        if landmarks is not None:
            frame, place = _landmark_points(landmarks, len(true), rows, columns, spacing_mm)
            error = transform_points(a[frame - 1] - b[frame - 1], place[:, None])
            landmark_errors[scope] = float(torch.linalg.vector_norm(error, dim=-1).mean())
    return TusrecErrors(
        pixel_errors["global"],
        landmark_errors["global"],
        pixel_errors["local"],
        landmark_errors["local"],
    )


def mean_pixel_distance(
    estimated: Float[Tensor, "frames 4 4"],
    true: Float[Tensor, "frames 4 4"],
    rows: int,
    columns: int,
    spacing_mm: tuple[float, float],
) -> Float[Tensor, " frames"]:
    """Return the mean over all pixels of the distance between their two places, mm.

    For nearly every frame 8 x 8 Gauss points settle it, with 16 x 16 to confirm, in place
    of 307,200 pixels. Where the error vanishes somewhere in the frame the distance has a
    kink there; such frames get finer rules, at most one point per pixel, until the mean
    changes by less than a millionth.
    """
    order = 8
    mean = _gauss_mean(estimated, true, rows, columns, spacing_mm, order)
    unsettled = torch.arange(len(true))
    while len(unsettled) and order < max(rows, columns):
        order *= 2
        finer = _gauss_mean(estimated[unsettled], true[unsettled], rows, columns, spacing_mm, order)
        change = (finer - mean[unsettled]).abs()
        mean[unsettled] = finer
        unsettled = unsettled[change > (SETTLED_RELATIVE * finer).clamp_min(SETTLED_MM)]
    return mean


def _gauss_mean(
    estimated: Tensor,
    true: Tensor,
    rows: int,
    columns: int,
    spacing_mm: tuple[float, float],
    order: int,
) -> Tensor:
    points, weights = frame_quadrature(rows, columns, spacing_mm, order)
    chunk = max(POINTS_AT_ONCE // len(points), 1)
    parts = zip(estimated.split(chunk), true.split(chunk), strict=True)
    return torch.cat([point_distance(a, b, points, weights) for a, b in parts])


def tusrec_score(errors: TusrecErrors, without_motion: TusrecErrors) -> float:
    """Return the score of the 2025 challenge: 1 for the truth, 0 for no motion at all.

    Args:
        errors: Of the estimate.
        without_motion: Of an estimate that says the probe never moved.

    Raises:
        ScanError: If landmark errors are missing, or the true probe did not move.
    """
    parts = []
    for name in vars(errors):
        error, reference = getattr(errors, name), getattr(without_motion, name)
        if error is None or reference is None:
            raise ScanError("the score needs landmark errors: give the landmarks of the scan")
        if not reference > 0:
            raise ScanError("the score has no meaning for a probe that does not move")
        parts.append(1 - error / reference)
    return sum(parts) / len(parts)


def displacement_fields(
    image_to_reference: Float[Tensor, "frames 4 4"],
    rows: int,
    columns: int,
    spacing_mm: tuple[float, float],
    scope: Scope,
    chunk: int = 16,
) -> Iterator[Float[np.ndarray, "chunk xyz=3 pixels"]]:
    """Give the displacement (mm, float32) of every pixel, some frames at a time.

    Joined along the first axis the parts are the challenge's GP or LP array of N - 1
    frames. Pixels go row by row. A whole array takes 3.7 MB per frame of 480 x 640, so
    write each part before asking for the next.

    Args:
        image_to_reference: Pose of each frame.
        rows: Height of a frame.
        columns: Width of a frame.
        spacing_mm: Distance between neighbouring columns and rows.
        scope: Seen from frame 0, or from the frame before.
        chunk: Frames per part.
    """
    points = pixel_grid(rows, columns, spacing_mm)
    displacement = _motions(image_to_reference, scope) - torch.eye(4, dtype=torch.float64)
    for part in displacement.split(chunk):
        # x and y only: z of a pixel is 0.
        field = part[:, :3, :2] @ points[:, :2].mT + part[:, :3, 3:]
        yield field.to(torch.float32).numpy()


def landmark_displacements(
    image_to_reference: Float[Tensor, "frames 4 4"],
    landmarks: Int[Tensor, "landmarks frame_column_row=3"],
    rows: int,
    columns: int,
    spacing_mm: tuple[float, float],
    scope: Scope,
) -> Float[np.ndarray, "xyz=3 landmarks"]:
    """Return the displacement (mm, float32) of each landmark: the challenge's GL or LL.

    Raises:
        ScanError: If a landmark lies in no frame after the first, or outside the image.
    """
    frame, place = _landmark_points(landmarks, len(image_to_reference), rows, columns, spacing_mm)
    motion = _motions(image_to_reference, scope)[frame - 1]
    displacement = transform_points(motion, place[:, None])[:, 0] - place
    return displacement.mT.to(torch.float32).numpy()


def _motions(image_to_reference: Tensor, scope: Scope) -> Tensor:
    """Return the pose of frames 1, 2, ... seen from frame 0, or from the frame before."""
    poses = image_to_reference.double()
    if scope == "local":
        return steps_from_poses(poses)
    return invert_pose(poses[0]) @ poses[1:]


def _landmark_points(
    landmarks: Tensor, frames: int, rows: int, columns: int, spacing_mm: tuple[float, float]
) -> tuple[Tensor, Tensor]:
    """Return the frame of each landmark and its place in image mm."""
    lowest = torch.tensor([1, 0, 0])
    highest = torch.tensor([frames - 1, columns - 1, rows - 1])
    wrong = ((landmarks < lowest) | (landmarks > highest)).any(-1)
    if bool(wrong.any()):
        row = int(wrong.nonzero()[0])
        raise ScanError(
            f"landmark {row} is (frame, column, row) = {tuple(landmarks[row].tolist())}; expected"
            f" a frame from 1 to {frames - 1}, a column from 0 to {columns - 1} and a row from 0"
            f" to {rows - 1}"
        )
    place = torch.zeros(len(landmarks), 3, dtype=torch.float64)
    place[:, :2] = landmarks[:, 1:] * torch.tensor(spacing_mm, dtype=torch.float64)
    return landmarks[:, 0], place
