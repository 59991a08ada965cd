"""The main job, run as a person runs it."""

import json
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
import torch

from sonosweep.cli.progress import progress
from sonosweep.io import read_trajectory, read_volume
from sonosweep.io.hdf5 import read_scan, write_scan
from sonosweep.scan import Companion

OUTPUTS = {
    "coverage.nrrd",
    "open_in_slicer.py",
    "report.html",
    "summary.json",
    "trajectory.csv",
    "trajectory.mrk.json",
    "vessels_photoacoustic.png",
    "volume.nrrd",
    "volume_photoacoustic.nrrd",
}


def test_tracked_sweep_to_volume(run, sweep, tmp_path):
    """A tracked sweep of 12 frames 0.2 mm apart becomes a volume as long as the sweep."""
    ran = run("reconstruct", sweep, "--poses", "tracked", "-o", "out", "--voxel-mm", "0.2")

    assert ran.code == 0, ran.error
    assert ran.out.startswith("speckle: 12 frames, tracked, 80 x 96 x 12 voxels of 0.2 mm")
    assert {path.name for path in (tmp_path / "out").iterdir()} == OUTPUTS
    volume = read_volume(tmp_path / "out" / "volume.nrrd")
    assert volume.voxels.shape == (12, 96, 80)
    assert volume.voxels.mean() > 50


def test_size_progress_and_compilation_are_said(run, sweep, monkeypatch):
    """Before the work: how large it gets and, once, that it compiles; then how far it is."""
    answers = iter([True, False])
    monkeypatch.setattr("sonosweep.cli.job.must_compile", lambda method: next(answers))
    words = "reconstruct", sweep, "--poses", "tracked", "--voxel-mm", "0.2", "-o"

    first, second = run(*words, "first"), run(*words, "second")

    size = "compounding into 2 volume(s) of 80 x 96 x 12 voxels, 369 kB"  # 2 bytes per voxel
    compiling = "compiling the kernels, once on this machine"
    said = first.error.splitlines()
    assert said.index(size) < said.index(compiling) < said.index("compounding: 12 of 12")
    assert compiling not in second.error


def test_a_bar_moves_where_a_person_looks(monkeypatch, capsys):
    """On a terminal progress is a bar, which is gone when the work is done."""
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    monkeypatch.setenv("FORCE_COLOR", "1")

    with progress("compounding") as show:
        show(6, 12)
        show(12, 12)

    error = capsys.readouterr().err
    assert "compounding" in error
    assert "\N{BOX DRAWINGS HEAVY HORIZONTAL}" in error
    assert "12 of 12" not in error


def test_photoacoustic_frames_are_corrected(run, sweep, tmp_path):
    """Skin is black in the volume, and what lies below is brighter by the light it lost."""
    words = "reconstruct", sweep, "--poses", "tracked", "--voxel-mm", "0.4", "-o"
    assert run(*words, "plain").code == 0
    fading = "--depth-compensation-per-mm", "0.05", "--photoacoustic-range-db", "40"
    assert run(*words, "corrected", "--reject-skin-mm", "5", *fading).code == 0

    plain, corrected = (
        read_volume(tmp_path / name / "volume_photoacoustic.nrrd").voxels.astype(float)
        for name in ("plain", "corrected")
    )

    depth_mm = 0.4 * np.arange(plain.shape[1])  # the frames' rows, too, are 0.4 mm apart
    assert not corrected[:, depth_mm < 4.5].any()
    levels = 255 / 40 * 20 * np.log10(np.e) * 0.05 * depth_mm[20]
    added = (corrected - plain)[:, 20][plain[:, 20] < 255 - levels]
    assert np.median(added) == pytest.approx(levels, abs=1.0)  # each is rounded to a level


def test_corrections_without_photoacoustic_frames(run, sweep, tmp_path):
    """What cannot act is refused in one sentence, before any work."""
    scan = replace(read_scan(sweep), companions={})
    write_scan(scan, tmp_path / "plain.h5")

    ran = run("reconstruct", "plain.h5", "--poses", "tracked", "--reject-skin-mm", "2", "-o", "out")

    assert ran.code != 0
    assert "no photoacoustic frames to correct" in ran.sentence
    assert not (tmp_path / "out").exists()
    ran = run("reconstruct", sweep, "--photoacoustic-range-db", "40", "-o", "out")
    assert "needs --depth-compensation-per-mm" in ran.sentence


def test_iq_becomes_no_volume(run, sweep, tmp_path):
    """Companions that are no images are named, and the rest is reconstructed."""
    scan = read_scan(sweep)
    iq = Companion(np.ones((len(scan.frames), 48, 40, 2), np.float32), (0.4, 0.4))
    write_scan(replace(scan, companions={"iq": iq}), tmp_path / "with_iq.h5")

    ran = run("reconstruct", "with_iq.h5", "--poses", "tracked", "--voxel-mm", "0.4", "-o", "out")

    assert ran.code == 0
    assert "no volume of companion 'iq': it has two channels" in ran.error
    assert not list((tmp_path / "out").glob("volume_*"))


def test_the_curve_for_slicer_follows_the_middle_of_the_image(run, sweep, tmp_path):
    """80 x 96 pixels of 0.2 mm: the middle is 7.9 mm to the side and 9.5 mm deep."""
    assert run("reconstruct", sweep, "--poses", "tracked", "-o", "out").code == 0

    curve = json.loads((tmp_path / "out" / "trajectory.mrk.json").read_text())
    first = curve["markups"][0]["controlPoints"][0]["position"]

    assert first == pytest.approx([-7.9, -9.5, 0])  # LPS of a reference that Slicer takes as RAS


def test_sensorless_sweep_tells_how_far_it_is_off(run, sweep, tmp_path):
    """Without the poses the same sweep is estimated, and compared with them in words."""
    ran = run("reconstruct", sweep, "-o", "out", "--json")

    assert ran.code == 0, ran.error
    summary = json.loads(ran.out)
    metrics = summary["runs"][0]["metrics"]
    assert metrics["path_length_mm"] == pytest.approx(2.2)
    assert metrics["final_drift_mm"] > 0
    assert any("forward" in sentence for sentence in summary["assumptions"])
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["scan"] == "speckle"
    trajectory = read_trajectory(tmp_path / "out" / "trajectory.csv")
    assert len(trajectory.image_to_reference) == 12


@pytest.mark.parametrize("seen", [0, 1])
def test_a_tracker_that_hardly_saw_the_sweep_stops_nothing(run, sweep, tmp_path, seen):
    """With fewer than two tracked frames there is nothing to compare, and still a volume."""
    scan = read_scan(sweep)
    tracked = torch.arange(len(scan.frames)) < seen
    poses = torch.where(tracked[:, None, None], scan.image_to_reference, torch.nan)
    write_scan(replace(scan, image_to_reference=poses, tracked=tracked), tmp_path / "lost.h5")

    ran = run("reconstruct", tmp_path / "lost.h5", "-o", "out", "--json")

    assert ran.code == 0, ran.error
    assert json.loads(ran.out)["runs"][0]["metrics"] == {}
    assert (tmp_path / "out" / "volume.nrrd").is_file()


def test_backward_is_the_mirror_of_forward(run, sweep, tmp_path):
    """The direction is the user's word: it flips the elevational way and nothing lateral."""
    for direction in ("forward", "backward"):
        ran = run("estimate", sweep, "-o", f"{direction}.csv", "--direction", direction)
        assert ran.code == 0, ran.error

    forward, backward = (
        read_trajectory(tmp_path / f"{d}.csv").image_to_reference[1, :3, 3].numpy()
        for d in ("forward", "backward")
    )

    assert forward[2] > 0
    assert np.allclose(forward * [1, 1, -1], backward, atol=1e-12)


def test_estimate_then_evaluate(run, sweep, tmp_path):
    """An estimated trajectory is measured against the scan's own poses, as json and csv."""
    assert run("estimate", sweep, "-o", "path.csv").code == 0

    ran = run("evaluate", "path.csv", sweep, "-o", "numbers")

    assert ran.code == 0, ran.error
    numbers = json.loads((tmp_path / "numbers.json").read_text())
    assert "final_drift_mm" in json.dumps(numbers)
    assert (tmp_path / "numbers.csv").read_text().count("\n") >= 2


def test_calibration_by_length_sets_the_length(run, sweep, tmp_path):
    """With a curve from the sweep's own length, the estimate is that long."""
    ran = run("calibrate", sweep, "--length-mm", "2.2", "-o", "probe.toml")
    assert ran.code == 0, ran.error

    ran = run("estimate", sweep, "--calibration", "probe.toml", "-o", "path.csv")

    assert ran.code == 0, ran.error
    path = read_trajectory(tmp_path / "path.csv").image_to_reference
    assert float(path[-1, 2, 3]) == pytest.approx(2.2, rel=0.05)  # curve fit and fusion


def test_nothing_is_overwritten_without_force(run, sweep, tmp_path):
    """A second run into the same folder is refused, leaves it as it was, and obeys --force."""
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / "mine.txt").write_text("keep")

    refused = run("reconstruct", sweep, "--poses", "tracked", "-o", "out")
    forced = run("reconstruct", sweep, "--poses", "tracked", "-o", "out", "--force")

    assert refused.code == 1
    assert "exists: choose another output or add --force" in refused.sentence
    assert forced.code == 0
    assert (folder / "mine.txt").read_text() == "keep"


def test_interrupted_leaves_nothing(sweep, tmp_path):
    """Ctrl-C half-way ends with 130, one sentence, and no folder."""
    words = ["reconstruct", str(sweep), "-o", "out", "--voxel-mm", "0.02"]
    process = subprocess.Popen(
        [sys.executable, "-m", "sonosweep", *words],
        cwd=tmp_path,
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stderr is not None
    first = process.stderr.readline()  # it says what it does: it is at work
    time.sleep(0.1)

    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=60)

    assert first
    assert process.returncode == 130
    assert error.strip().splitlines()[-1].startswith("sonosweep: interrupted")
    assert "Traceback" not in error
    assert {path.name for path in tmp_path.iterdir()} == {"speckle.h5"}


def test_several_scans_get_a_folder_each(run, sweep, tmp_path):
    """Two sweeps, two folders."""
    other = tmp_path / "other.h5"
    other.write_bytes(sweep.read_bytes())

    ran = run("reconstruct", sweep, other, "--poses", "tracked", "-o", "both")

    assert ran.code == 0, ran.error
    assert {path.name for path in (tmp_path / "both").iterdir()} == {"speckle", "other"}
    assert ran.out.count("\n") == 2


@pytest.mark.parametrize("ending", ["mha", "nii.gz"])
def test_other_volume_formats_hold_the_same_voxels(run, sweep, tmp_path, ending):
    """The format changes the file, not the volume."""
    for out, form in (("a", "nrrd"), ("b", ending)):
        ran = run("reconstruct", sweep, "--poses", "tracked", "-o", out, "--volume-format", form)
        assert ran.code == 0, ran.error

    first, second = (
        read_volume(tmp_path / "a" / "volume.nrrd"),
        read_volume(tmp_path / "b" / f"volume.{ending}"),
    )

    assert np.array_equal(first.voxels, second.voxels)
    assert np.allclose(first.grid.origin_mm, second.grid.origin_mm, atol=1e-5)
