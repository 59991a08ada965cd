"""``convert``: what is written can be relied upon, and nobody's file is lost."""

import numpy as np
import pytest
import torch

from sonosweep.io import open_scan, read_trajectory
from sonosweep.io.hdf5 import write_scan
from sonosweep.scan import Calibration, Scan


@pytest.fixture
def half_tracked(tmp_path):
    """Eight frames at 20 Hz, 0.5 mm apart, of which the tracker missed three."""
    seen = torch.tensor([True, False, True, True, False, False, True, True])
    poses = torch.eye(4, dtype=torch.float64).repeat(8, 1, 1)
    poses[:, 2, 3] = 0.5 * torch.arange(8)
    poses[~seen] = torch.nan
    scan = Scan(
        "half",
        np.random.default_rng(3).integers(0, 255, (8, 24, 16), dtype=np.uint8),
        Calibration((0.5, 0.5)),
        timestamps_s=torch.arange(8, dtype=torch.float64) / 20,
        image_to_reference=poses,
        tracked=seen,
    )
    write_scan(scan, tmp_path / "half.h5")
    return scan


def test_a_volume_is_the_same_through_dicom_and_its_csv(run, half_tracked, tmp_path):
    """Frames that the tracker missed do not shift the poses of those after them."""
    assert run("convert", "half.h5", "half.dcm").code == 0
    again = ("half.dcm", "--pose-file", "half_poses.csv")
    for words in (("half.h5", "-o", "a"), (*again, "-o", "b")):
        ran = run("reconstruct", *words, "--poses", "tracked")
        assert ran.code == 0, ran.error

    first, second = ((tmp_path / out / "volume.nrrd").read_bytes() for out in "ab")

    assert first == second


def test_a_reconstructed_trajectory_names_its_frames(run, half_tracked, tmp_path):
    """trajectory.csv of a tracked reconstruction can be given to the same scan again."""
    assert run("reconstruct", "half.h5", "--poses", "tracked", "-o", "out").code == 0
    table = tmp_path / "out" / "trajectory.csv"

    scan = open_scan(tmp_path / "half.h5", pose_file=table)

    assert read_trajectory(table).frames.tolist() == [0, 2, 3, 6, 7]
    assert torch.equal(scan.tracked, half_tracked.tracked)


def test_the_csv_beside_a_video_is_not_overwritten_either(run, half_tracked, tmp_path):
    """Without --force nothing is, and nothing is written."""
    (tmp_path / "x_poses.csv").write_text("mine")

    ran = run("convert", "half.h5", "x.mp4")

    assert ran.code == 1
    assert "'x_poses.csv' exists" in ran.sentence
    assert (tmp_path / "x_poses.csv").read_text() == "mine"
    assert not (tmp_path / "x.mp4").exists()


def test_a_folder_of_images_obeys_force(run, half_tracked, tmp_path):
    """With --force the frames and poses of before make place."""
    assert run("convert", "half.h5", "out").code == 0

    refused = run("convert", "half.h5", "out", "--last", "3")
    forced = run("convert", "half.h5", "out", "--last", "3", "--force")

    assert refused.code == 1
    assert forced.code == 0, forced.error
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        *(f"frame000{k}.png" for k in range(4)),
        "poses.csv",
    ]
