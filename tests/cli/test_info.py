"""What ``info`` says of files that are no scans: recordings of a tracker and our results."""

import json

import pytest
import torch

from sonosweep.geometry import pose_from_parts
from sonosweep.io import write_trajectory
from sonosweep.scan import Trajectory


@pytest.mark.parametrize("name", ["t.csv", "t.txt", "t.igs.mha", "t.tfm"])
def test_a_trajectory_is_described(run, tmp_path, name):
    """3 mm forward and 4 mm aside: a path of 7 mm, 5 mm from end to end, in 2 s."""
    shift = torch.tensor([[0.0, 0, 0], [0, 0, 3], [4, 0, 3]], dtype=torch.float64)
    poses = pose_from_parts(torch.eye(3, dtype=torch.float64).expand(3, 3, 3), shift)
    write_trajectory(Trajectory(poses, torch.arange(3).double()), tmp_path / name)

    ran = run("info", name, "--json")

    assert ran.code == 0, ran.error
    found = json.loads(ran.out)
    assert found["poses"] == 3
    assert found["duration_s"] == 2
    assert found["path_length_mm"] == pytest.approx(7)
    assert found["chord_length_mm"] == pytest.approx(5)
    assert "7.0 mm long, 5.0 mm from end to end" in run("info", name).out


@pytest.mark.parametrize("ending", ["nrrd", "mha", "nii.gz"])
def test_a_volume_is_described(run, sweep, ending):
    """Every volume that reconstruct writes says how large its voxels are."""
    made = run(
        "reconstruct", sweep, "--poses", "tracked", "--volume-format", ending, "-o", "out",
        "--voxel-mm", 0.4, "--json",
    )  # fmt: skip
    assert made.code == 0, made.error

    ran = run("info", f"out/volume.{ending}", "--json")

    assert ran.code == 0, ran.error
    found = json.loads(ran.out)
    assert found["size"] == json.loads(made.out)["volume"]["size"]
    assert found["spacing_mm"] == pytest.approx([0.4] * 3)


def test_a_tracker_recording_is_described(run, recordings):
    """PLUS's buffer of a tracker holds poses of the probe and no images."""
    (path,) = (recordings / "plus_watertank_temporal").glob("*TrackerBuffer.igs.mha")

    ran = run("info", path, "--json")

    assert ran.code == 0, ran.error
    assert json.loads(ran.out)["pose_of"] == "Probe"
