"""Poses of ultrasound frames as 4 x 4 rigid matrices.

``a_to_b`` maps coordinates in system a (mm) to coordinates in system b (mm), so a
chain reads right to left: ``a_to_c = b_to_c @ a_to_b``. A sweep is one
``image_to_reference`` per frame. A *step*, ``next_to_this``, is the pose of frame
i + 1 seen from frame i: the only motion that two neighbouring images can tell us.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sonosweep.geometry.rotation import nearest_rotation


def pose_from_parts(
    rotation: Float[Tensor, "*batch 3 3"], translation_mm: Float[Tensor, "*batch xyz=3"]
) -> Float[Tensor, "*batch 4 4"]:
    """Return the pose that turns by ``rotation`` and then moves by ``translation_mm``."""
    top = torch.cat((rotation, translation_mm[..., None]), dim=-1)
    bottom = torch.tensor([0, 0, 0, 1], dtype=top.dtype, device=top.device)
    return torch.cat((top, bottom.expand(*top.shape[:-2], 1, 4)), dim=-2)


def invert_pose(a_to_b: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 4 4"]:
    """Return ``b_to_a``; the inverse of a rotation is its transpose."""
    inverse = a_to_b[..., :3, :3].mT
    return pose_from_parts(inverse, -(inverse @ a_to_b[..., :3, 3:])[..., 0])


def steps_from_poses(
    image_to_reference: Float[Tensor, "*batch frames 4 4"],
) -> Float[Tensor, "*batch frames-1 4 4"]:
    """Return the step from each frame of a sweep to the one after it."""
    this, following = image_to_reference[..., :-1, :, :], image_to_reference[..., 1:, :, :]
    return invert_pose(this) @ following


def poses_from_steps(
    next_to_this: Float[Tensor, "*batch steps 4 4"], first: Float[Tensor, "*batch 4 4"]
) -> Float[Tensor, "*batch steps+1 4 4"]:
    """Chain steps into the poses of a sweep; undoes :func:`steps_from_poses`.

    Errors add up along the chain: a bias of 0.1 degree per step turns a sweep of
    900 steps by 90 degrees.

    Args:
        next_to_this: Steps in frame order.
        first: ``image_to_reference`` of frame 0.

    Returns:
        ``image_to_reference`` of every frame, frame 0 included.
    """
    poses = [first]
    for step in next_to_this.unbind(dim=-3):
        poses.append(poses[-1] @ step)
    return torch.stack(poses, dim=-3)


def left_steps_from_poses(
    image_to_reference: Float[Tensor, "*batch frames 4 4"],
) -> Float[Tensor, "*batch frames-1 4 4"]:
    """Return the steps as the paper prints them, ``T[i+1] @ inv(T[i])``.

    This is the step seen from the *reference*. It changes when the reference is turned,
    so the two images alone cannot tell it: use :func:`steps_from_poses` to estimate or to
    compare motion, and this only to read numbers that were written in this form. Chain
    them with the newest on the left: ``T[n] = S[n-1] @ ... @ S[0] @ T[0]``.

    References:
        Lee et al., "Enhancing Free-hand 3D Photoacoustic and Ultrasound Reconstruction
        using Deep Learning", section "Problem Definition".
    """
    this, following = image_to_reference[..., :-1, :, :], image_to_reference[..., 1:, :, :]
    return following @ invert_pose(this)


def poses_from_left_steps(
    left_steps: Float[Tensor, "*batch steps 4 4"], first: Float[Tensor, "*batch 4 4"]
) -> Float[Tensor, "*batch steps+1 4 4"]:
    """Chain steps of the paper's form into poses; undoes :func:`left_steps_from_poses`."""
    poses = [first]
    for step in left_steps.unbind(dim=-3):
        poses.append(step @ poses[-1])
    return torch.stack(poses, dim=-3)


def transform_points(
    a_to_b: Float[Tensor, "*batch 4 4"], points_mm: Float[Tensor, "*#batch points xyz=3"]
) -> Float[Tensor, "*batch points xyz=3"]:
    """Return points of system a in system b; one set of points, or one per pose."""
    return points_mm @ a_to_b[..., :3, :3].mT + a_to_b[..., None, :3, 3]


def is_rigid(
    matrix: Float[Tensor, "*batch 4 4"], tolerance: float = 1e-3
) -> Bool[Tensor, "*batch"]:
    """Say of each matrix whether it only turns and moves.

    Args:
        matrix: Candidates for poses. NaN and infinity are not rigid.
        tolerance: Largest entry by which ``R.T @ R`` may differ from the identity; the
            default allows the six printed digits of tracker files.
    """
    rotation = matrix[..., :3, :3]
    identity = torch.eye(3, dtype=matrix.dtype, device=matrix.device)
    finite = torch.isfinite(matrix).flatten(-2).all(-1)
    orthogonal = (rotation.mT @ rotation - identity).abs().flatten(-2).amax(-1) <= tolerance
    right_handed = torch.linalg.det(torch.where(finite[..., None, None], rotation, identity)) > 0
    last = torch.tensor([0, 0, 0, 1], dtype=matrix.dtype, device=matrix.device)
    affine = (matrix[..., 3, :] - last).abs().amax(-1) <= tolerance
    return finite & orthogonal & right_handed & affine


def nearest_pose(matrix: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 4 4"]:
    """Return the rigid matrix nearest to one that was rounded when it was written."""
    return pose_from_parts(nearest_rotation(matrix[..., :3, :3]), matrix[..., :3, 3])
