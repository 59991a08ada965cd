"""Whatever a person gets wrong: one sentence, exit code 1, nothing half-written."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sonosweep.cli.main import VERBS


def one_sentence(ran, tmp_path, expected):
    """The command failed as it should."""
    assert ran.code == 1, (ran.code, ran.error)
    assert "Traceback" not in ran.error
    assert ran.sentence.startswith("sonosweep: ")
    assert expected in ran.sentence
    assert not (tmp_path / "out").exists()
    assert not list(tmp_path.glob(".writing-*"))


@pytest.mark.parametrize("verb", VERBS)
def test_help_of_every_verb(run, verb):
    """Every verb explains itself."""
    ran = run(verb, "--help")

    assert ran.code == 0
    assert ran.out.startswith("Usage: sonosweep " + verb)


@pytest.mark.parametrize(
    "name", ["a.igs.mha", "a.h5", "a.dcm", "a.mp4", "a.mat", "a.nrrd", "a.xyz"]
)
@pytest.mark.parametrize("content", [b"", b"not what the suffix says", b"\0" * 4096])
def test_files_that_are_not_what_they_say(run, tmp_path, name, content):
    """Empty, foreign and zero-filled files are named in the sentence."""
    (tmp_path / name).write_bytes(content)

    one_sentence(run("reconstruct", name, "-o", "out"), tmp_path, name)


def test_what_is_not_there(run, tmp_path):
    """A missing file, an empty folder, an unknown verb and option."""
    (tmp_path / "empty").mkdir()

    one_sentence(run("reconstruct", "gone.h5", "-o", "out"), tmp_path, "there is no 'gone.h5'")
    one_sentence(run("reconstruct", "empty", "-o", "out"), tmp_path, "neither images nor DICOM")
    one_sentence(run("sing"), tmp_path, "sing")
    one_sentence(run("reconstruct", "x.h5", "-o", "out", "--louder"), tmp_path, "--louder")


def frames(folder: Path, count: int) -> Path:
    """A folder of small images."""
    folder.mkdir()
    for k in range(count):
        pixels = np.random.default_rng(k).integers(0, 255, (64, 48), dtype=np.uint8)
        Image.fromarray(pixels).save(folder / f"{k:03d}.png")
    return folder


def test_missing_pixel_size_is_asked_for(run, tmp_path):
    """Images tell no spacing, and none is guessed."""
    folder = frames(tmp_path / "frames", 3)

    one_sentence(run("reconstruct", folder, "-o", "out"), tmp_path, "--pixel-spacing")


def test_one_frame_has_no_motion(run, tmp_path):
    """Motion needs two frames."""
    folder = frames(tmp_path / "frames", 1)

    ran = run("reconstruct", folder, "--pixel-spacing", "0.1", "0.1", "-o", "out")

    one_sentence(ran, tmp_path, "2 frames or more")


@pytest.mark.parametrize("spacing", ["0", "-1", "nan"])
def test_zero_spacing_is_refused(run, tmp_path, spacing):
    """A pixel has a size."""
    folder = frames(tmp_path / "frames", 3)

    ran = run("reconstruct", folder, "--pixel-spacing", spacing, "0.1", "-o", "out")

    one_sentence(ran, tmp_path, "above 0")


def test_counts_that_differ(run, tmp_path):
    """Three frames and two poses without times cannot be matched."""
    folder = frames(tmp_path / "frames", 3)
    (tmp_path / "p.csv").write_text("tx,ty,tz,qx,qy,qz,qw\n0,0,0,0,0,0,1\n0,0,1,0,0,0,1\n")

    ran = run(
        "reconstruct", folder, "--pixel-spacing", "0.1", "0.1", "--pose-file", "p.csv",
        "--poses", "tracked", "-o", "out",
    )  # fmt: skip

    one_sentence(ran, tmp_path, "3 frames in 'frames' but 2 poses")


@pytest.mark.parametrize("row", ["nan,0,0,0,0,0,1", "0,0,0,2,0,0,5", "0,0,x,0,0,0,1"])
def test_poses_that_are_none(run, tmp_path, row):
    """NaN, quaternions of the wrong length and words are refused."""
    folder = frames(tmp_path / "frames", 2)
    (tmp_path / "p.csv").write_text(f"tx,ty,tz,qx,qy,qz,qw\n0,0,0,0,0,0,1\n{row}\n")

    ran = run("reconstruct", folder, "--pose-file", "p.csv", "--poses", "tracked", "-o", "out")

    one_sentence(ran, tmp_path, "p.csv")


def test_an_absurd_grid_is_refused(run, sweep, tmp_path):
    """10^12 voxels are refused before any is allocated, with a size that would fit."""
    ran = run("reconstruct", sweep, "--poses", "tracked", "--voxel-mm", "0.0002", "-o", "out")

    one_sentence(ran, tmp_path, "or larger")


def test_poses_that_are_missing_are_named(run, recordings, tmp_path):
    """The link that is missing in a chain of transforms, and those that are known."""
    file = recordings / "plus_spine_freehand" / "SpinePhantomFreehand.igs.mha"

    ran = run("reconstruct", file, "--poses", "tracked", "-o", "out")

    one_sentence(ran, tmp_path, "ImageToProbe")
    assert "ProbeToTracker" in ran.sentence


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("--latency-ms", "60"), "--latency-ms is about the poses of a --pose-file"),
        (("--pose-of", "probe"), "--pose-of is about the poses of a --pose-file"),
        (("--variable", "bmode"), "holds one scan: leave out --variable"),
        (("--image-orientation", "UF"), "--image-orientation says how"),
        (("--reject-below", "nan"), "--reject-below must be a gray level, got nan"),
        (("--pixel-spacing", "70000", "1"), "below 1000 mm, got 70000"),
    ],
)
def test_options_that_do_nothing_or_make_no_sense(run, sweep, tmp_path, words, expected):
    """An option is obeyed or refused, never passed over."""
    ran = run("reconstruct", sweep, "--poses", "tracked", "-o", "out", *words)

    one_sentence(ran, tmp_path, expected)


def test_absurd_sizes_are_refused_before_memory_is_taken(run, sweep, tmp_path):
    """A frame of 10^12 pixels is a slip of the keyboard."""
    ran = run("convert", sweep, "out", "--resize", "1000000", "1000000")

    one_sentence(ran, tmp_path, "1 to 8192 each way")


def test_numbers_need_a_file_name(run, sweep, tmp_path):
    """A folder is no place for the numbers of `evaluate`."""
    one_sentence(run("evaluate", "x.csv", sweep, "-o", "."), tmp_path, "'.' is a folder")


def test_a_name_that_cannot_be_written_is_said_before_the_work(run, sweep, tmp_path):
    """A minute of estimation must not end in "unknown suffix"."""
    ran = run("estimate", sweep, "-o", "path.json")

    one_sentence(ran, tmp_path, "cannot write a trajectory as 'path.json'")
    assert "estimating" not in ran.error


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("--fan-radius-px", "0", "9"), "--fan-angles-deg"),
        (("--reject-below", "1e9"), "--reject-below"),
        (("--threads", "100000"), "1024 threads"),
        (("--calibration", "x.toml"), "--poses tracked does not"),
        (("--euler-order", "XYZ"), "--pose-file"),
    ],
)
def test_options_that_would_do_nothing(run, sweep, tmp_path, words, expected):
    """An option without effect, or with an empty or absurd one, is refused."""
    ran = run("reconstruct", sweep, "--poses", "tracked", "-o", "out", *words)

    one_sentence(ran, tmp_path, expected)


def test_euler_angles_need_their_order(run, tmp_path):
    """A table of Euler angles is read when the order of the turns is told, and only then."""
    folder = frames(tmp_path / "frames", 2)
    (tmp_path / "p.csv").write_text("tx,ty,tz,rx_deg,ry_deg,rz_deg\n0,0,0,1,2,3\n0,0,1,1,2,3\n")

    told = run("info", folder, "--pose-file", "p.csv", "--euler-order", "ZYX")
    untold = run("info", folder, "--pose-file", "p.csv")

    assert told.code == 0, told.error
    assert "2 of 2, path 1.0 mm" in told.out
    one_sentence(untold, tmp_path, "order")
