"""The six numbers of a step, and the forms in which others write them.

A *motion* is ``(lateral, axial, elevational)`` in mm followed by the turns about the same
three axes in rad, of the step :func:`sonosweep.geometry.steps_from_poses` returns. The
turns are intrinsic Euler angles in the order ``"ZYX"`` unless another is named.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from sonosweep.geometry.pose import pose_from_parts
from sonosweep.geometry.rotation import EulerOrder, euler_from_rotation, rotation_from_euler

MOTION_NAMES = ("lateral", "axial", "elevational", "pitch", "yaw", "roll")
MOTION_ORDER: EulerOrder = "ZYX"
MM_PER_CM = 10.0


def motion_from_step(
    next_to_this: Float[Tensor, "*batch 4 4"], order: EulerOrder = MOTION_ORDER
) -> Float[Tensor, "*batch motion=6"]:
    """Return the motion (mm, rad) of a step: turns about x (pitch), y (yaw), z (roll)."""
    angles = euler_from_rotation(next_to_this[..., :3, :3], order)
    return torch.cat((next_to_this[..., :3, 3], angles), dim=-1)


def step_from_motion(
    motion: Float[Tensor, "*batch motion=6"], order: EulerOrder = MOTION_ORDER
) -> Float[Tensor, "*batch 4 4"]:
    """Return the step of a motion; undoes :func:`motion_from_step`."""
    return pose_from_parts(rotation_from_euler(motion[..., 3:], order), motion[..., :3])


def moglo_from_step(
    next_to_this: Float[Tensor, "*batch 4 4"],
) -> Float[Tensor, "*batch motion=6"]:
    """Return a step as the released MoGLo-Net code stores it (``y_rel``).

    Three translations in cm along (rows, columns, out of plane), then the intrinsic
    ``"YZX"`` angles in degrees about these axes, in the order of the turns. Its third axis
    is row x column, the opposite of ours.

    References:
        The HDF5 layout of pnu-amilab/MoGLo (``y_rel``), as described in docs/formats.md.
    """
    swapped = _swap_rows_and_columns(next_to_this)
    angles = euler_from_rotation(swapped[..., :3, :3], "YZX")[..., [1, 2, 0]]
    return torch.cat((swapped[..., :3, 3] / MM_PER_CM, angles * (180 / math.pi)), dim=-1)


def step_from_moglo(
    cm_and_degrees: Float[Tensor, "*batch motion=6"],
) -> Float[Tensor, "*batch 4 4"]:
    """Return the step of one row of ``y_rel``; undoes :func:`moglo_from_step`."""
    angles = cm_and_degrees[..., 3:][..., [2, 0, 1]] * (math.pi / 180)
    rotation = rotation_from_euler(angles, "YZX")
    return _swap_rows_and_columns(pose_from_parts(rotation, cm_and_degrees[..., :3] * MM_PER_CM))


def ucl_from_step(
    next_to_this: Float[Tensor, "*batch 4 4"],
) -> Float[Tensor, "*batch motion=6"]:
    """Return a step as the TUS-REC baseline's networks predict it.

    Intrinsic ``"ZYX"`` angles in rad in the order of the turns (about z, y, x), then the
    translation in mm, in image coordinates with x along columns and y along rows.
    """
    angles = euler_from_rotation(next_to_this[..., :3, :3], "ZYX").flip(-1)
    return torch.cat((angles, next_to_this[..., :3, 3]), dim=-1)


def step_from_ucl(
    parameters: Float[Tensor, "*batch motion=6"],
) -> Float[Tensor, "*batch 4 4"]:
    """Return the step of the baseline's six parameters; undoes :func:`ucl_from_step`."""
    rotation = rotation_from_euler(parameters[..., :3].flip(-1), "ZYX")
    return pose_from_parts(rotation, parameters[..., 3:])


def _swap_rows_and_columns(a_to_b: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 4 4"]:
    """Exchange x and y of both systems and flip z, so that they stay right-handed."""
    swap = torch.zeros(4, 4, dtype=a_to_b.dtype, device=a_to_b.device)
    swap[0, 1] = swap[1, 0] = swap[3, 3] = 1
    swap[2, 2] = -1
    return swap @ a_to_b @ swap
