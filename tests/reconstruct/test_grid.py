"""The box around a sweep, and what it costs."""

import numpy as np
import pytest
import torch
from hypothesis import given

from sonosweep.errors import ScanError
from sonosweep.geometry import pose_from_parts, rotation_from_euler, transform_points
from sonosweep.reconstruct.grid import check_memory, estimate_bytes, grid_of_sweep
from sonosweep.scan import VolumeGrid, voxel_to_reference

from ..strategies import sweeps
from .sweeps import PIXEL_TO_IMAGE

HALF_VOXEL = 0.5 + 1e-6  # the size is rounded to whole voxels


@pytest.mark.parametrize("oriented", [False, True])
@given(image_to_reference=sweeps())
def test_the_grid_holds_every_frame(oriented, image_to_reference):
    """No corner of a frame lies more than half a voxel outside the grid."""
    grid = grid_of_sweep(image_to_reference, PIXEL_TO_IMAGE, 30, 40, 0.3, oriented=oriented)

    corners = torch.tensor([[0, 0, 0], [39, 0, 0], [0, 29, 0], [39, 29, 0.0]]).double()
    points = transform_points(image_to_reference @ PIXEL_TO_IMAGE, corners).reshape(-1, 3)
    voxels = transform_points(torch.linalg.inv(voxel_to_reference(grid)), points)
    assert float(voxels.min()) > -HALF_VOXEL
    assert bool((voxels <= torch.tensor(grid.size) - 1 + HALF_VOXEL).all())


def test_worked_example():
    """Two frames of 11 x 6 pixels of 0.2 mm, 1 mm apart: 2 x 1 x 1 mm, in voxels of 0.5."""
    poses = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    poses[:, 2, 3] = torch.tensor([3.0, 4.0])

    grid = grid_of_sweep(poses, PIXEL_TO_IMAGE, rows=6, columns=11, voxel_mm=0.5)

    assert grid.size == (5, 3, 3)
    assert grid.origin_mm == (0.0, 0.0, 3.0)


def test_the_clip_rectangle_reaches_to_the_pixel_after_it():
    """A rectangle of 4 x 2 pixels spans 4 x 2 pixels, as PLUS measures it."""
    poses = torch.eye(4, dtype=torch.float64)[None]

    grid = grid_of_sweep(poses, PIXEL_TO_IMAGE, 20, 20, 0.2, rectangle_px=(3, 5, 4, 2))

    assert grid.size == (5, 3, 1)
    assert grid.origin_mm == pytest.approx((0.6, 1.0, 0.0))


def test_an_oriented_box_is_smaller():
    """A sweep at 45 degrees to the reference fills a box along its own axes."""
    angles = torch.tensor([[0.0, np.pi / 4, 0.0]], dtype=torch.float64).repeat(20, 1)
    turn = rotation_from_euler(angles, "XYZ")
    place = turn[:, :, 2] * torch.linspace(0, 20, 20, dtype=torch.float64)[:, None]
    poses = pose_from_parts(turn, place)

    upright = grid_of_sweep(poses, PIXEL_TO_IMAGE, 50, 50, 0.5)
    oriented = grid_of_sweep(poses, PIXEL_TO_IMAGE, 50, 50, 0.5, oriented=True)

    assert np.prod(oriented.size) < 0.7 * np.prod(upright.size)
    assert np.linalg.det(oriented.direction) == pytest.approx(1)


def test_memory_is_refused_before_it_is_taken():
    """A grid of 10^12 voxels is refused with the voxel size that would fit."""
    grid = VolumeGrid(size=(10_000, 10_000, 10_000), spacing_mm=(0.1, 0.1, 0.1))

    with pytest.raises(ScanError, match=r"2,000\.0 GB.*voxels of \S+ mm or larger"):
        check_memory(grid, limit_bytes=10**9)

    assert estimate_bytes(grid) == 2 * 10**12


def test_the_suggested_voxel_fits():
    """The size that the refusal suggests is accepted."""
    grid = VolumeGrid(size=(1000, 1000, 1000), spacing_mm=(0.1, 0.1, 0.1))

    with pytest.raises(ScanError) as refusal:
        check_memory(grid, limit_bytes=10**8)

    voxel = float(str(refusal.value).split("voxels of ")[-1].split(" mm")[0])
    coarser = VolumeGrid(size=(int(100 / voxel) + 1,) * 3, spacing_mm=(voxel,) * 3)
    assert check_memory(coarser, limit_bytes=10**8) <= 10**8


def test_bad_sweeps_are_refused():
    """No frames, a pose that is not a number, metres for millimetres, a clip beside the frame."""
    good = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    missing = good.clone()
    missing[1, 0, 3] = torch.nan
    far = good.clone()
    far[2, 2, 3] = 1e9

    with pytest.raises(ScanError, match="no frames"):
        grid_of_sweep(good[:0], PIXEL_TO_IMAGE, 9, 9, 1.0)
    with pytest.raises(ScanError, match="frame 1 "):
        grid_of_sweep(missing, PIXEL_TO_IMAGE, 9, 9, 1.0)
    with pytest.raises(ScanError, match="must be mm"):
        grid_of_sweep(far, PIXEL_TO_IMAGE, 9, 9, 1.0)
    with pytest.raises(ScanError, match="does not meet the frame"):
        grid_of_sweep(good, PIXEL_TO_IMAGE, 9, 9, 1.0, rectangle_px=(20, 0, 5, 5))
    with pytest.raises(ScanError, match="larger than 0 mm"):
        grid_of_sweep(good, PIXEL_TO_IMAGE, 9, 9, 0.0)
