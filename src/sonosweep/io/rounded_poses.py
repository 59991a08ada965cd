"""Poses that lost digits when they were stored."""

import torch
from jaxtyping import Float
from torch import Tensor

from sonosweep.geometry import is_rigid, nearest_pose

STORED_ERROR = 1e-12  # beyond the round-off of float64: digits were lost in storing


def unround_poses(poses: Float[Tensor, "frames 4 4"]) -> Float[Tensor, "frames 4 4"]:
    """Return poses stored as float32 or with few printed digits as rigid ones again.

    Those that are rigid to float64 already stay bit by bit, and so do those that are not
    rigid at all (or NaN): a scan refuses them with a message of its own.
    """
    rotation = poses[:, :3, :3]
    error = (rotation.mT @ rotation - torch.eye(3, dtype=poses.dtype)).abs().flatten(-2).amax(-1)
    rounded = (error > STORED_ERROR) & is_rigid(poses)
    result = poses.clone()
    if bool(rounded.any()):
        result[rounded] = nearest_pose(poses[rounded])
    return result
