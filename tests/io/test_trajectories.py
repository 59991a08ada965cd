"""Every trajectory format that can be read gives back the poses that were written."""

from pathlib import Path

import pytest
import torch
from hypothesis import given, settings

from sonosweep.errors import FormatError, ScanError
from sonosweep.io.trajectories import read_trajectory, write_trajectory
from sonosweep.scan import Trajectory
from tests.strategies import sweeps

# TUM's quaternions lose the last two digits of a rotation; mm of a 200 mm lever.
ROUND_OFF_MM = 1e-9
READABLE = (".csv", ".txt", ".tum", ".tfm", ".igs.mha")


@pytest.mark.parametrize("suffix", READABLE)
@settings(max_examples=10)
@given(poses=sweeps(frames=5))
def test_poses_and_times_survive(tmp_path_factory, suffix: str, poses):
    """Whatever the format, the frames are where and when they were."""
    path = tmp_path_factory.mktemp("t") / f"sweep{suffix}"
    times = torch.tensor([0.0, 0.05, 0.11, 0.15, 0.2], dtype=torch.float64)

    write_trajectory(Trajectory(poses, times), path)
    back = read_trajectory(path)

    assert float((back.image_to_reference - poses).abs().max()) < ROUND_OFF_MM
    assert back.timestamps_s is not None
    assert float((back.timestamps_s - times).abs().max()) < ROUND_OFF_MM


def test_unknown_suffixes_list_the_known(tmp_path: Path):
    """Someone who writes .xyz is told what there is."""
    trajectory = Trajectory(torch.eye(4, dtype=torch.float64)[None])
    (tmp_path / "t.xyz").write_text("1 2 3")

    with pytest.raises(FormatError, match=r"\.csv, .*\.tfm"):
        write_trajectory(trajectory, tmp_path / "t2.xyz")
    with pytest.raises(FormatError, match=r"\.csv, .*\.tfm"):
        read_trajectory(tmp_path / "t.xyz")
    with pytest.raises(FormatError, match="there is no file"):
        read_trajectory(tmp_path / "missing.csv")


def test_curves_are_written_by_their_suffix(tmp_path: Path):
    """``.mrk.json`` is for 3D Slicer and cannot be read back."""
    write_trajectory(Trajectory(torch.eye(4, dtype=torch.float64)[None]), tmp_path / "t.mrk.json")

    with pytest.raises(FormatError, match="no trajectory that we read"):
        read_trajectory(tmp_path / "t.mrk.json")


def test_a_recording_without_image_pose_gives_the_probe(recordings: Path):
    """A PLUS sweep without its configuration tells where the sensor was."""
    path = recordings / "plus_spine_freehand" / "SpinePhantomFreehand.igs.mha"

    trajectory = read_trajectory(path)

    assert trajectory.settings["pose_of"] == "Probe"
    assert len(trajectory.image_to_reference) > 10


def test_a_video_stream_without_tracker_is_no_trajectory(recordings: Path):
    """The sentence says which transform is missing."""
    folder = recordings / "plus_watertank_temporal"

    with pytest.raises(ScanError, match="no trajectory"):
        read_trajectory(folder / "WaterTankBottomTranslationVideoBuffer.igs.mha")
