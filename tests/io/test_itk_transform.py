"""ITK transforms: the resampling direction, in LPS by the world rule."""

from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
import torch
from hypothesis import given
from hypothesis import strategies as st

from sonosweep.errors import FormatError
from sonosweep.geometry import invert_pose, transform_points
from sonosweep.io.itk_transform import read_itk_transforms, write_itk_transforms
from sonosweep.io.world import World
from sonosweep.scan import Trajectory
from tests.io.damage import assert_reads_or_explains, damaged
from tests.strategies import sweeps

ROUND_OFF_MM = 1e-9  # float64 at a few hundred mm, after two inversions
WORLDS: tuple[World, World] = ("ras", "lps")


@pytest.mark.parametrize("world", WORLDS)
@given(poses=sweeps(frames=4))
def test_trajectories_survive(tmp_path_factory, world: World, poses):
    """Poses and times come back, and the file tells its own world."""
    path = tmp_path_factory.mktemp("t") / "t.tfm"
    times = torch.arange(4, dtype=torch.float64) / 3

    write_itk_transforms(Trajectory(poses, times), path, world)
    back = read_itk_transforms(path, "ras")

    assert float((back.image_to_reference - poses).abs().max()) < ROUND_OFF_MM
    assert back.timestamps_s is not None
    assert back.timestamps_s.tolist() == times.tolist()


@pytest.mark.parametrize("world", WORLDS)
@given(poses=sweeps(frames=3))
def test_itk_maps_reference_to_image(tmp_path_factory, world: World, poses):
    """What ITK does to a point of the reference is the inverse of the first frame's pose."""
    path = tmp_path_factory.mktemp("t") / "t.tfm"
    sign = np.array([-1, -1, 1] if world == "ras" else [1, 1, 1])
    point_mm = np.array([12.0, -7.0, 30.0])

    write_itk_transforms(Trajectory(poses), path, world)
    seen = sitk.ReadTransform(str(path)).TransformPoint((point_mm * sign).tolist())

    inverse = invert_pose(poses[0])
    expected = transform_points(inverse, torch.from_numpy(point_mm)[None])[0].numpy()
    np.testing.assert_allclose(np.array(seen) * sign, expected, atol=ROUND_OFF_MM)


def test_a_shift_by_pencil_and_paper(tmp_path: Path):
    """An image at (1, 2, 3): the reference's origin is at (-1, -2, -3) of it, so (1, 2, -3)."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor([1.0, 2.0, 3.0])

    write_itk_transforms(Trajectory(pose[None]), tmp_path / "t.tfm", "ras")

    assert sitk.ReadTransform(str(tmp_path / "t.tfm")).TransformPoint((0, 0, 0)) == (1, 2, -3)


def test_transforms_of_others_turn_about_their_center(tmp_path: Path):
    """ITK's center is folded into the pose."""
    affine = sitk.AffineTransform(3)
    affine.SetMatrix((0, -1, 0, 1, 0, 0, 0, 0, 1))
    affine.SetCenter((10, 20, 30))
    affine.SetTranslation((1, 2, 3))
    sitk.WriteTransform(affine, str(tmp_path / "t.tfm"))

    pose = read_itk_transforms(tmp_path / "t.tfm", "lps").image_to_reference[0]

    expected = affine.GetInverse().TransformPoint((5, 6, 7))
    seen = transform_points(pose, torch.tensor([[5.0, 6.0, 7.0]], dtype=torch.float64))[0]
    assert seen.tolist() == pytest.approx(list(expected))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("#Insight", "#Outsight"), "no ITK transform file"),
        (("AffineTransform_double_3_3", "BSplineTransform_double_3_3"), "BSplineTransform"),
        (("AffineTransform_double_3_3", "AffineTransform_double_2_2"), "expected Affine"),
        (("Parameters: 1.0", "Parameters: 2.0"), "not rigid"),
        (("Parameters: 1.0", "Parameters: nan"), "not rigid"),
        (("Parameters: 1.0", "Parameters: one"), "cannot read"),
        (("Parameters: 1.0", "Parameters:"), "11 parameters"),
        (("FixedParameters: 0 0 0", ""), "cut short"),
    ],
)
def test_what_is_no_list_of_poses_is_explained(tmp_path: Path, change, message: str):
    """Each kind of nonsense is named."""
    path = tmp_path / "t.tfm"
    write_itk_transforms(Trajectory(torch.eye(4, dtype=torch.float64)[None]), path)
    path.write_text(path.read_text().replace(*change))

    with pytest.raises(FormatError, match=message):
        read_itk_transforms(path)


@given(data=st.data())
def test_damaged_files_are_explained(tmp_path_factory, data):
    """Cut, flipped or random bytes give a trajectory or one sentence."""
    folder = tmp_path_factory.mktemp("damaged")
    poses = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    write_itk_transforms(Trajectory(poses), folder / "whole.tfm")
    (folder / "t.tfm").write_bytes(data.draw(damaged((folder / "whole.tfm").read_bytes())))

    assert_reads_or_explains(lambda: read_itk_transforms(folder / "t.tfm"))
