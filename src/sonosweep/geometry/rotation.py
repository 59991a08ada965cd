"""Rotation matrices and the three ways to write them down: Euler, vector, quaternion.

Matrices act on column vectors from the left. Angles are radians. Euler angles are
*intrinsic* (each turn is about the axis as the turns before it left it), and the order of
the turns is always named: ``"ZYX"`` is ``Rz @ Ry @ Rx``, as SciPy's upper-case ``"ZYX"``.
A triple of angles is stored by axis, ``(about x, about y, about z)``, whatever the order.
Quaternions are ``(x, y, z, w)``, as in SciPy and in TUM files.
"""

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

EulerOrder = Literal["XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX"]

# Below this angle (rad) the exact formulas lose digits to 0 / 0; the series used instead
# is then exact to 1e-18 relative.
SMALL_ANGLE_RAD = 1e-4


def rotation_about_axis(axis: Literal["X", "Y", "Z"], angle_rad: Tensor) -> Tensor:
    """Return the matrix (``*batch 3 3``) that turns by ``angle_rad`` (``*batch``)."""
    cos, sin = torch.cos(angle_rad), torch.sin(angle_rad)
    one, zero = torch.ones_like(cos), torch.zeros_like(cos)
    rows = {
        "X": (one, zero, zero, zero, cos, -sin, zero, sin, cos),
        "Y": (cos, zero, sin, zero, one, zero, -sin, zero, cos),
        "Z": (cos, -sin, zero, sin, cos, zero, zero, zero, one),
    }[axis]
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def rotation_from_euler(
    angles_rad: Float[Tensor, "*batch xyz=3"], order: EulerOrder
) -> Float[Tensor, "*batch 3 3"]:
    """Return the rotation whose intrinsic turns, in ``order``, are ``angles_rad``."""
    first, second, third = (
        rotation_about_axis(axis, angles_rad[..., "XYZ".index(axis)])  # type: ignore[arg-type]
        for axis in order
    )
    return first @ second @ third


def euler_from_rotation(
    rotation: Float[Tensor, "*batch 3 3"], order: EulerOrder
) -> Float[Tensor, "*batch xyz=3"]:
    """Return the intrinsic angles of a rotation; undoes :func:`rotation_from_euler`.

    The second turn lies within a quarter turn. At exactly a quarter turn (gimbal lock) the
    other two turns are about one axis and only their sum is known: the third is then 0.
    """
    i, j, k = ("XYZ".index(axis) for axis in order)
    sign = 1.0 if order in ("XYZ", "YZX", "ZXY") else -1.0
    sin_second = (sign * rotation[..., i, k]).clamp(-1, 1)
    cos_second = torch.hypot(rotation[..., i, i], rotation[..., i, j])
    second = torch.atan2(sin_second, cos_second)
    locked = cos_second < 1e-9
    first = torch.where(
        locked,
        torch.atan2(sign * rotation[..., k, j], rotation[..., j, j]),
        torch.atan2(-sign * rotation[..., j, k], rotation[..., k, k]),
    )
    third = torch.where(
        locked,
        torch.zeros_like(first),
        torch.atan2(-sign * rotation[..., i, j], rotation[..., i, i]),
    )
    by_turn = {i: first, j: second, k: third}
    return torch.stack([by_turn[axis] for axis in range(3)], dim=-1)


def skew(vector: Float[Tensor, "*batch xyz=3"]) -> Float[Tensor, "*batch 3 3"]:
    """Return the matrix that takes the cross product with ``vector``."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), dim=-1).unflatten(-1, (3, 3))


def rotation_from_vector(
    vector_rad: Float[Tensor, "*batch xyz=3"],
) -> Float[Tensor, "*batch 3 3"]:
    """Return the turn about ``vector_rad`` by its length (Rodrigues' formula).

    The gradient at the zero vector is exact, not NaN.
    """
    squared = (vector_rad * vector_rad).sum(-1)
    small = squared < SMALL_ANGLE_RAD**2
    safe = torch.where(small, torch.ones_like(squared), squared)
    angle = torch.sqrt(safe)
    sin_over = torch.where(small, 1 - squared / 6, torch.sin(angle) / angle)
    # 1 - cos as the square of a sine: of small angles cos leaves no digits in float32.
    versine_over = torch.where(
        small, 0.5 - squared / 24, 0.5 * (torch.sin(angle / 2) / (angle / 2)) ** 2
    )
    cross = skew(vector_rad)
    identity = torch.eye(3, dtype=vector_rad.dtype, device=vector_rad.device)
    return (
        identity + sin_over[..., None, None] * cross + versine_over[..., None, None] * cross @ cross
    )


def vector_from_rotation(
    rotation: Float[Tensor, "*batch 3 3"],
) -> Float[Tensor, "*batch xyz=3"]:
    """Return the rotation vector, of length 0 to pi; undoes :func:`rotation_from_vector`."""
    return vector_from_quaternion(quaternion_from_rotation(rotation))


def quaternion_from_rotation(
    rotation: Float[Tensor, "*batch 3 3"],
) -> Float[Tensor, "*batch xyzw=4"]:
    """Return the unit quaternion ``(x, y, z, w)`` with ``w >= 0``.

    Of the four ways to compute it, each entry takes the one with the largest divisor, so
    that no digits are lost near half a turn and gradients stay finite.
    """
    m = rotation
    m00, m11, m22 = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    x_minus, y_minus, z_minus = (
        m[..., 2, 1] - m[..., 1, 2],
        m[..., 0, 2] - m[..., 2, 0],
        m[..., 1, 0] - m[..., 0, 1],
    )
    xy, xz, yz = (
        m[..., 0, 1] + m[..., 1, 0],
        m[..., 0, 2] + m[..., 2, 0],
        m[..., 1, 2] + m[..., 2, 1],
    )
    candidates = torch.stack(  # four times the quaternion's largest entry, times itself
        (
            torch.stack((1 + m00 - m11 - m22, xy, xz, x_minus), -1),
            torch.stack((xy, 1 - m00 + m11 - m22, yz, y_minus), -1),
            torch.stack((xz, yz, 1 - m00 - m11 + m22, z_minus), -1),
            torch.stack((x_minus, y_minus, z_minus, 1 + m00 + m11 + m22), -1),
        ),
        dim=-2,
    )
    best = torch.diagonal(candidates, dim1=-2, dim2=-1).argmax(-1)
    index = best[..., None, None].expand(*best.shape, 1, 4)
    chosen = candidates.gather(-2, index).squeeze(-2)
    chosen = chosen / torch.linalg.vector_norm(chosen, dim=-1, keepdim=True)
    return torch.where(chosen[..., 3:] < 0, -chosen, chosen)


def rotation_from_quaternion(
    quaternion: Float[Tensor, "*batch xyzw=4"],
) -> Float[Tensor, "*batch 3 3"]:
    """Return the rotation of a quaternion ``(x, y, z, w)`` of any length but zero."""
    unit = quaternion / torch.linalg.vector_norm(quaternion, dim=-1, keepdim=True)
    cross = skew(unit[..., :3])
    identity = torch.eye(3, dtype=quaternion.dtype, device=quaternion.device)
    return identity + 2 * unit[..., 3, None, None] * cross + 2 * cross @ cross


def vector_from_quaternion(
    quaternion: Float[Tensor, "*batch xyzw=4"],
) -> Float[Tensor, "*batch xyz=3"]:
    """Return the rotation vector, of length 0 to pi, of a unit quaternion."""
    q = torch.where(quaternion[..., 3:] < 0, -quaternion, quaternion)
    imaginary, real = q[..., :3], q[..., 3]
    squared = (imaginary * imaginary).sum(-1)
    small = squared < SMALL_ANGLE_RAD**2
    sine = torch.sqrt(torch.where(small, torch.ones_like(squared), squared))
    scale = torch.where(
        small,
        2 / torch.where(small, real, torch.ones_like(real)) * (1 - squared / 3),
        2 * torch.atan2(sine, real) / sine,
    )
    return scale[..., None] * imaginary


def quaternion_from_vector(
    vector_rad: Float[Tensor, "*batch xyz=3"],
) -> Float[Tensor, "*batch xyzw=4"]:
    """Return the unit quaternion of a rotation vector."""
    squared = (vector_rad * vector_rad).sum(-1)
    small = squared < SMALL_ANGLE_RAD**2
    angle = torch.sqrt(torch.where(small, torch.ones_like(squared), squared))
    scale = torch.where(small, 0.5 - squared / 48, torch.sin(angle / 2) / angle)
    real = torch.where(small, 1 - squared / 8, torch.cos(angle / 2))
    return torch.cat((scale[..., None] * vector_rad, real[..., None]), dim=-1)


def angle_between_rotations(
    first: Float[Tensor, "*batch 3 3"], second: Float[Tensor, "*batch 3 3"]
) -> Float[Tensor, "*batch"]:
    """Return the angle, 0 to pi, of the turn that takes one rotation to the other."""
    return torch.linalg.vector_norm(vector_from_rotation(first.mT @ second), dim=-1)


def nearest_rotation(matrix: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Return the rotation nearest to a matrix in the least-squares sense (polar factor)."""
    u, _, v_transposed = torch.linalg.svd(matrix)
    flip = torch.ones_like(matrix[..., 0])
    flip[..., 2] = torch.sign(torch.linalg.det(u @ v_transposed))
    return u @ (flip[..., None] * v_transposed)
