"""Steps, poses and their inverses."""

import torch
from hypothesis import given
from torch.testing import assert_close

from sonosweep.geometry import (
    invert_pose,
    is_rigid,
    left_steps_from_poses,
    nearest_pose,
    pose_from_parts,
    poses_from_left_steps,
    poses_from_steps,
    steps_from_poses,
    transform_points,
)

from ..strategies import poses, sweeps

ROUND_OFF_MM = 1e-9  # float64 on coordinates below 1 m


@given(poses(3))
def test_inverse_undoes_the_pose(a_to_b):
    """Going to system b and back is the identity."""
    identity = torch.eye(4, dtype=torch.float64).expand(3, 4, 4)

    assert_close(invert_pose(a_to_b) @ a_to_b, identity, atol=ROUND_OFF_MM, rtol=0)


@given(poses(20))
def test_chaining_undoes_splitting(image_to_reference):
    """Splitting a sweep into steps and chaining them again changes nothing."""
    steps = steps_from_poses(image_to_reference)

    chained = poses_from_steps(steps, first=image_to_reference[0])

    assert_close(chained, image_to_reference, atol=ROUND_OFF_MM, rtol=0)


@given(poses(20))
def test_chaining_undoes_splitting_in_the_papers_form(image_to_reference):
    """The paper's steps chain back too, with the newest on the left."""
    steps = left_steps_from_poses(image_to_reference)

    chained = poses_from_left_steps(steps, first=image_to_reference[0])

    assert_close(chained, image_to_reference, atol=ROUND_OFF_MM, rtol=0)


@given(poses(20), poses())
def test_steps_do_not_see_the_reference(image_to_reference, reference_to_world):
    """Moving the tracker moves every pose and no step."""
    expected = steps_from_poses(image_to_reference)

    moved = steps_from_poses(reference_to_world @ image_to_reference)

    assert_close(moved, expected, atol=ROUND_OFF_MM, rtol=0)


@given(sweeps(5), poses())
def test_the_papers_steps_are_turned_with_the_reference(image_to_reference, reference_to_world):
    """The paper's form is conjugated by the reference: not a function of two images."""
    before = left_steps_from_poses(image_to_reference)

    after = left_steps_from_poses(reference_to_world @ image_to_reference)

    conjugated = reference_to_world @ before @ invert_pose(reference_to_world)
    assert_close(after, conjugated, atol=ROUND_OFF_MM, rtol=0)


def test_worked_example():
    """A quarter turn about z, then 2 mm along the probe's own y: -2 mm along x."""
    quarter_turn = torch.tensor([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    slide = torch.eye(4)
    slide[1, 3] = 2.0

    sweep = poses_from_steps(torch.stack([quarter_turn, slide]), first=torch.eye(4))

    assert sweep[2, :3, 3].tolist() == [-2.0, 0.0, 0.0]


def test_worked_example_of_the_papers_form():
    """The same two frames: the probe slides along its y, the paper's step says along -x."""
    first = torch.tensor([[0.0, -1, 0, 5], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    slide = torch.eye(4)
    slide[1, 3] = 2.0
    sweep = torch.stack([first, first @ slide])

    assert steps_from_poses(sweep)[0, :3, 3].tolist() == [0.0, 2.0, 0.0]
    assert left_steps_from_poses(sweep)[0, :3, 3].tolist() == [-2.0, 0.0, 0.0]


@given(poses(4))
def test_points_go_there_and_back(a_to_b):
    """Points carried to b and back are where they were; distances stay."""
    points = torch.tensor([[0.0, 0, 0], [10, 0, 0], [0, 20, -5]], dtype=torch.float64)

    there = transform_points(a_to_b, points.expand(4, 3, 3))
    back = transform_points(invert_pose(a_to_b), there)

    assert_close(back, points.expand(4, 3, 3), atol=ROUND_OFF_MM, rtol=0)
    assert_close(torch.cdist(there[0], there[0]), torch.cdist(points, points), atol=1e-6, rtol=0)


def test_what_is_not_rigid():
    """Scale, mirror, NaN, a wrong last row and zeros are told from a pose."""
    good = pose_from_parts(torch.eye(3), torch.ones(3)).double()
    scaled, mirrored, broken, projective = (good.clone() for _ in range(4))
    scaled[:3, :3] *= 1.01
    mirrored[0, 0] = -1
    broken[0, 3] = float("nan")
    projective[3, 0] = 0.1
    candidates = torch.stack([good, scaled, mirrored, broken, projective, torch.zeros(4, 4)])

    assert is_rigid(candidates).tolist() == [True, False, False, False, False, False]


@given(poses(4))
def test_nearest_pose_mends_printed_digits(a_to_b):
    """A matrix rounded to six digits is put right to within these digits."""
    printed = torch.round(a_to_b, decimals=5)

    mended = nearest_pose(printed)

    assert bool(is_rigid(mended, tolerance=1e-12).all())
    assert_close(mended, a_to_b, atol=1e-5, rtol=0)
