"""``convert``: what is written can be relied upon, and nobody's file is lost."""

import os
import subprocess
import sys

import numpy as np
import pytest
import torch

from sonosweep.io import open_scan, read_trajectory
from sonosweep.io.hdf5 import write_scan
from sonosweep.io.sequence_write import write_sequence
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


def test_companions_that_a_format_cannot_hold_are_named(run, sweep):
    """Nobody shall believe that the photoacoustic frames went along."""
    lost, kept = run("convert", sweep, "a.igs.mha"), run("convert", sweep, "b.h5")

    assert "photoacoustic left out: only .h5 holds companions" in lost.out
    assert "left out" not in kept.out


def test_frames_that_the_tracker_missed_are_counted(run, half_tracked):
    """Leaving frames out is said."""
    ran = run("reconstruct", "half.h5", "--poses", "tracked", "-o", "out")

    assert "3 of 8 frames have no pose and are left out" in ran.error


@pytest.mark.skipif(sys.platform != "linux", reason="other systems refuse such names")
@pytest.mark.parametrize("encoding", ["utf-8", "ascii"])
def test_names_that_are_no_text(half_tracked, tmp_path, encoding):
    """A file name of arbitrary bytes is read, shown and written about as well as can be."""
    odd = os.fsdecode(b"r\xe9sum\xff.igs.mha")
    write_sequence(half_tracked, tmp_path / odd)
    words = ["reconstruct", odd, "--poses", "tracked", "-o", "out"]

    ran = subprocess.run(
        [sys.executable, "-m", "sonosweep", *words],
        cwd=tmp_path,
        capture_output=True,
        env={**os.environ, "PYTHONIOENCODING": f"{encoding}:strict"},
    )

    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.startswith(b"r?sum?: 5 frames, tracked")
    assert (tmp_path / "out" / "report.html").exists()


@pytest.mark.skipif(sys.platform == "win32", reason="needs a limit on the size of files")
@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("convert", "half.h5", "out"), "cannot write 'out/frame0000.png'"),
        (("convert", "half.h5", "out.mp4"), "'out.mp4' cannot be written as a video"),
        (("reconstruct", "half.h5", "--poses", "tracked", "-o", "out"), "cannot write to 'out'"),
    ],
)
def test_a_full_disk_is_said_of_the_file_that_was_asked_for(
    half_tracked, tmp_path, words, expected
):
    """No temporary name is shown, and nothing is left behind."""
    import resource

    limit = 300 if words[0] == "convert" else 20_000  # bytes: of a frame, of a report

    ran = subprocess.run(
        [sys.executable, "-m", "sonosweep", *words],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path.parent / "numba")},
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)),
    )

    assert ran.returncode == 1
    assert expected in ran.stderr.splitlines()[-1]
    assert {path.name for path in tmp_path.iterdir()} == {"half.h5"}
