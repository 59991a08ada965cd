"""Rotations and their three ways of being written, against SciPy."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from torch.testing import assert_close

from sonosweep.geometry import (
    angle_between_rotations,
    euler_from_rotation,
    nearest_rotation,
    quaternion_from_rotation,
    quaternion_from_vector,
    rotation_from_euler,
    rotation_from_quaternion,
    rotation_from_vector,
    vector_from_quaternion,
    vector_from_rotation,
)

from ..strategies import poses

ROUND_OFF = 1e-12  # float64 on entries of about 1, a few dozen operations
SINGLE_ROUND_OFF = 1e-6  # float32 on entries of about 1
HALF_TURN_ROUND_OFF = 1e-7  # near half a turn the vector's sign and digits are ill-posed
ORDERS = ("XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX")


@pytest.mark.parametrize("order", ORDERS)
@given(pose=poses(20))
def test_euler_angles_agree_with_scipy(order, pose):
    """Our angles by axis are SciPy's intrinsic (upper-case) angles by turn."""
    rotation = pose[:, :3, :3]
    by_turn = Rotation.from_matrix(rotation.numpy()).as_euler(order)

    ours = euler_from_rotation(rotation, order)

    assert np.abs(ours[:, ["XYZ".index(a) for a in order]].numpy() - by_turn).max() < 1e-9
    assert_close(rotation_from_euler(ours, order), rotation, atol=ROUND_OFF, rtol=0)


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("quarter", [-1, 1])
def test_gimbal_lock_keeps_the_rotation(order, quarter):
    """At a quarter turn of the second axis the angles are not unique, the rotation is."""
    angles = torch.full((3,), 0.3, dtype=torch.float64)
    angles["XYZ".index(order[1])] = quarter * math.pi / 2
    rotation = rotation_from_euler(angles, order)

    again = rotation_from_euler(euler_from_rotation(rotation, order), order)

    assert_close(again, rotation, atol=1e-8, rtol=0)  # sqrt of round-off at the lock


def test_euler_worked_example():
    """ZYX turns first about z: x goes to y, and y's turn then acts on the turned axes."""
    angles = torch.tensor([0.0, math.pi / 2, math.pi / 2], dtype=torch.float64)

    rotation = rotation_from_euler(angles, "ZYX")

    expected = torch.tensor([[0.0, -1, 0], [0, 0, 1], [-1, 0, 0]], dtype=torch.float64)
    assert_close(rotation, expected, atol=ROUND_OFF, rtol=0)


@given(poses(20))
def test_vectors_and_quaternions_agree_with_scipy(pose):
    """Rotation vector and quaternion are SciPy's, up to the quaternion's sign."""
    rotation = pose[:, :3, :3]
    oracle = Rotation.from_matrix(rotation.numpy())

    quaternion = quaternion_from_rotation(rotation)

    assert np.abs(vector_from_rotation(rotation).numpy() - oracle.as_rotvec()).max() < 1e-7
    assert np.abs(quaternion.numpy() - oracle.as_quat(canonical=True)).max() < ROUND_OFF
    assert_close(rotation_from_quaternion(quaternion), rotation, atol=ROUND_OFF, rtol=0)


@given(st.integers(0, 2**31 - 1), st.sampled_from([1e-12, 1e-8, 1e-5, 1e-4, 2e-4, 0.1, 3.0]))
def test_vector_round_trip_at_any_size(seed, length):
    """Vector to matrix to vector and vector to quaternion to vector lose only round-off."""
    direction = torch.randn(3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    vector = direction / direction.norm() * length

    assert_close(vector_from_rotation(rotation_from_vector(vector)), vector, atol=1e-12, rtol=1e-9)
    assert_close(
        vector_from_quaternion(quaternion_from_vector(vector)), vector, atol=1e-12, rtol=1e-9
    )


def test_half_turns_about_each_axis():
    """Half a turn, where three of the four quaternion formulas divide by zero."""
    vectors = math.pi * torch.eye(3, dtype=torch.float64)

    again = vector_from_rotation(rotation_from_vector(vectors))

    assert_close(again.abs(), vectors, atol=HALF_TURN_ROUND_OFF, rtol=0)


@pytest.mark.parametrize("convert", [rotation_from_vector, quaternion_from_vector])
def test_gradient_at_the_identity(convert):
    """The gradient of a turn by nothing is finite and right to first order."""
    vector = torch.zeros(3, dtype=torch.float64, requires_grad=True)

    assert torch.autograd.gradcheck(convert, (vector,))


@pytest.mark.parametrize("length", [1e-6, 2e-4, 1e-3, 1e-2])
def test_gradient_of_small_turns_in_single_precision(length):
    """Training runs in float32: the derivative of a turn of a millirad keeps its digits."""
    direction = torch.tensor([0.6, -0.48, 0.64], dtype=torch.float64)
    exact, single = (
        torch.autograd.functional.jacobian(rotation_from_vector, (length * direction).to(dtype))
        for dtype in (torch.float64, torch.float32)
    )

    assert_close(single.double(), exact, atol=SINGLE_ROUND_OFF, rtol=0)


def test_gradient_of_the_way_back_at_the_identity():
    """Vector to matrix to vector is the identity map, and so is its derivative at zero."""
    vector = torch.zeros(3, dtype=torch.float64, requires_grad=True)

    jacobian = torch.autograd.functional.jacobian(
        lambda v: vector_from_rotation(rotation_from_vector(v)), vector
    )
    euler = torch.autograd.functional.jacobian(
        lambda v: euler_from_rotation(rotation_from_vector(v), "ZYX"), vector
    )

    assert_close(jacobian, torch.eye(3, dtype=torch.float64), atol=ROUND_OFF, rtol=0)
    assert_close(euler, torch.eye(3, dtype=torch.float64), atol=ROUND_OFF, rtol=0)


@given(poses(2))
def test_angle_between_is_symmetric_and_invariant(pose):
    """The angle is the same both ways and does not see a common turn."""
    first, second = pose[:, :3, :3]

    angle = angle_between_rotations(first, second)

    assert_close(angle, angle_between_rotations(second, first), atol=1e-7, rtol=0)
    assert_close(angle, angle_between_rotations(first @ first, first @ second), atol=1e-7, rtol=0)


@given(poses(5))
def test_nearest_rotation_of_a_scaled_rotation_is_that_rotation(pose):
    """Scaling does not turn; a reflection is answered with a proper rotation."""
    rotation = pose[:, :3, :3]
    mirrored = rotation * torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64)

    assert_close(nearest_rotation(2.5 * rotation), rotation, atol=ROUND_OFF, rtol=0)
    assert_close(
        torch.linalg.det(nearest_rotation(mirrored)),
        torch.ones(5, dtype=torch.float64),
        atol=ROUND_OFF,
        rtol=0,
    )


def test_any_leading_axes():
    """Batches of batches come out with their axes, and empty ones empty."""
    vectors = torch.zeros(2, 0, 5, 3)

    assert rotation_from_vector(vectors).shape == (2, 0, 5, 3, 3)
    assert euler_from_rotation(rotation_from_vector(vectors), "XYZ").shape == vectors.shape
