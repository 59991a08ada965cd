"""Alignment, interpolation and the points of a frame."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp
from torch.testing import assert_close

from sonosweep.errors import ScanError
from sonosweep.geometry import (
    align_points,
    frame_corners,
    interpolate_poses,
    pixel_grid,
    pose_from_parts,
    rotation_from_vector,
    scale_pixels,
    transform_points,
)

from ..strategies import poses

ROUND_OFF_MM = 1e-9  # float64 on coordinates below 1 m
SQRT_ROUND_OFF_MM = 1e-6  # turns come through an inverse sine of float64 entries


@given(poses(), st.integers(0, 2**31 - 1))
def test_alignment_finds_the_pose(a_to_b, seed):
    """Points that were moved rigidly are laid back on each other."""
    generator = torch.Generator().manual_seed(seed)
    points = 50 * torch.randn(8, 3, generator=generator, dtype=torch.float64)

    found = align_points(points, transform_points(a_to_b, points))

    assert_close(found, a_to_b, atol=ROUND_OFF_MM, rtol=0)


@given(poses())
def test_alignment_of_a_flat_set_is_not_a_reflection(a_to_b):
    """The corners of a frame lie in a plane and still fix its pose."""
    corners = frame_corners(100, 200, (0.2, 0.3))

    found = align_points(corners, transform_points(a_to_b, corners))

    assert_close(found, a_to_b, atol=ROUND_OFF_MM, rtol=0)


@given(poses(), st.integers(0, 2**31 - 1))
def test_alignment_of_noisy_points_agrees_with_scipy(a_to_b, seed):
    """With weights and noise the rotation is SciPy's, and the weighted means meet."""
    generator = torch.Generator().manual_seed(seed)
    points = 50 * torch.randn(9, 3, generator=generator, dtype=torch.float64)
    noise = torch.randn(9, 3, generator=generator, dtype=torch.float64)
    weights = torch.rand(9, generator=generator, dtype=torch.float64) + 0.1
    moved = transform_points(a_to_b, points) + noise

    found = align_points(points, moved, weights)

    mean, moved_mean = ((weights @ part) / weights.sum() for part in (points, moved))
    oracle, _ = Rotation.align_vectors(
        (moved - moved_mean).numpy(), (points - mean).numpy(), weights.numpy()
    )
    expected = torch.tensor(oracle.as_matrix())
    assert_close(found[:3, :3], expected, atol=SQRT_ROUND_OFF_MM, rtol=0)
    assert_close(transform_points(found, mean[None])[0], moved_mean, atol=ROUND_OFF_MM, rtol=0)


def test_weights_leave_points_out():
    """An outlier of weight 0 does not count; no weight at all is an error."""
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=torch.float64)
    moved = points + torch.tensor([1.0, 2.0, 3.0])
    moved[3] += 100
    weights = torch.tensor([1.0, 1, 1, 0], dtype=torch.float64)

    found = align_points(points, moved, weights)

    assert_close(found[:3, 3], torch.tensor([1.0, 2, 3], dtype=torch.float64))
    with pytest.raises(ScanError, match="no points to align"):
        align_points(points, moved, torch.zeros(4, dtype=torch.float64))


@given(poses(6), st.floats(0, 1))
def test_interpolation_agrees_with_scipy(samples, fraction):
    """Turns follow the great circle, positions the straight line."""
    times = torch.tensor([0.0, 0.1, 0.25, 0.3, 0.7, 1.0], dtype=torch.float64)
    oracle = Slerp(times.numpy(), Rotation.from_matrix(samples[:, :3, :3].numpy()))

    found = interpolate_poses(times, samples, torch.tensor([fraction], dtype=torch.float64))

    expected = torch.tensor(oracle([fraction]).as_matrix())
    assert_close(found[:, :3, :3], expected, atol=SQRT_ROUND_OFF_MM, rtol=0)


@given(poses(4))
def test_interpolation_keeps_the_samples(samples):
    """At a sample's time the pose is the sample; beyond the ends it is the nearest one."""
    times = torch.tensor([0.0, 1.0, 2.0, 4.0], dtype=torch.float64)
    asked = torch.tensor([-5.0, 0.0, 1.0, 2.0, 4.0, 9.0], dtype=torch.float64)

    found = interpolate_poses(times, samples, asked)

    expected = samples[[0, 0, 1, 2, 3, 3]]
    assert_close(found, expected, atol=SQRT_ROUND_OFF_MM, rtol=0)


@given(poses(6))
def test_interpolation_takes_several_tools_at_once(samples):
    """Poses of two tools seen at the same times come out as each would alone."""
    times = torch.tensor([0.0, 1.0, 3.0], dtype=torch.float64)
    asked = torch.tensor([0.3, 2.0], dtype=torch.float64)
    tools = samples.reshape(2, 3, 4, 4)

    found = interpolate_poses(times, tools, asked)

    alone = torch.stack([interpolate_poses(times, tool, asked) for tool in tools])
    assert torch.equal(found, alone)
    assert interpolate_poses(times[:1], tools[:, :1], asked).shape == (2, 2, 4, 4)


def test_interpolation_worked_example():
    """Half-way between rest and a quarter turn 2 mm further is an eighth turn at 1 mm."""
    axis = torch.tensor([0.0, 0.0, math.pi / 2], dtype=torch.float64)
    end = pose_from_parts(rotation_from_vector(axis), torch.tensor([2.0, 0, 0]).double())
    samples = torch.stack([torch.eye(4, dtype=torch.float64), end])

    found = interpolate_poses(torch.tensor([0.0, 1.0]), samples, torch.tensor([0.5]))[0]

    assert_close(found[:3, :3], rotation_from_vector(axis / 2), atol=ROUND_OFF_MM, rtol=0)
    assert found[:3, 3].tolist() == [1.0, 0.0, 0.0]


def test_interpolation_refuses_times_that_do_not_increase():
    """Two samples at one time, or none at all, cannot be interpolated between."""
    with pytest.raises(ScanError, match="must increase"):
        interpolate_poses(torch.zeros(2), torch.eye(4).expand(2, 4, 4), torch.zeros(1))
    with pytest.raises(ScanError, match="no poses"):
        interpolate_poses(torch.zeros(0), torch.zeros(0, 4, 4), torch.zeros(1))


def test_grid_and_corners_worked_example():
    """Three columns 0.2 mm apart and two rows 0.3 mm apart."""
    grid = pixel_grid(2, 3, (0.2, 0.3))

    assert_close(grid[5], torch.tensor([0.4, 0.3, 0.0], dtype=torch.float64))
    assert_close(grid[[0, 2, 5, 3]], frame_corners(2, 3, (0.2, 0.3)))
    assert len(pixel_grid(256, 256, (0.1, 0.1), step=16)) == 256


def test_pixels_scale_and_lean():
    """Pixel (10, 20) at 0.1 x 0.2 mm, leaning 0.05 mm per mm of depth."""
    pixel = torch.tensor([10.0, 20.0, 0.0, 1.0], dtype=torch.float64)

    image = scale_pixels((0.1, 0.2), shear=0.05) @ pixel

    assert_close(image, torch.tensor([1.2, 4.0, 0.0, 1.0], dtype=torch.float64))
