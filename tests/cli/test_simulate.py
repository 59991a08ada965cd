"""``simulate``: one command to a sweep whose truth is known, or to a data set."""

import json

import numpy as np
import pytest
import torch

from sonosweep.geometry import is_rigid
from sonosweep.io import open_scan
from sonosweep.simulate import datasets, make
from tests.simulate.tiny_dataset import tiny_recipe

SMALL = ("--body", "uniform", "--pixels", "40", "32", "--frames", "8", "--length-mm", "4")


def test_a_sweep_has_frames_times_poses_and_a_calibration(run, tmp_path):
    """All that a tracked recording has, and the settings it was made with."""
    ran = run("simulate", "-o", "sweep.h5", *SMALL, "--subject", "900000")
    scan = open_scan(tmp_path / "sweep.h5")

    assert ran.code == 0, ran.error
    assert "8 frames of 40 x 32 pixels" in ran.out
    assert scan.frames.shape == (8, 32, 40)
    assert scan.frames[:].std() > 5  # speckle
    assert scan.subject == "simulated-900000"
    assert bool(is_rigid(scan.image_to_reference).all())
    assert scan.calibration.spacing_mm == pytest.approx((256 * 0.1484 / 40, 256 * 0.1484 / 32))
    assert json.loads(scan.notes["simulation"])["motion"]["length_mm"] == 4


def test_the_same_command_makes_the_same_bytes(run, tmp_path):
    """And another seed another sweep."""
    for name, seed in (("a", "1"), ("b", "1"), ("c", "2")):
        assert run("simulate", "-o", f"{name}.h5", *SMALL, "--seed", seed).code == 0
    first, second, other = ((tmp_path / f"{name}.h5").read_bytes() for name in "abc")

    assert first == second
    assert first != other


def test_backward_is_the_same_line_from_its_end(run, tmp_path):
    """The poses of the forward sweep in reversed order."""
    assert run("simulate", "-o", "f.h5", *SMALL).code == 0
    assert run("simulate", "-o", "b.h5", *SMALL, "--backward").code == 0
    forward, backward = (open_scan(tmp_path / name) for name in ("f.h5", "b.h5"))

    reversed_poses = forward.image_to_reference.flip(0)
    assert torch.allclose(backward.image_to_reference, reversed_poses, rtol=0, atol=1e-9)


def test_companions_and_a_tracker_come_when_asked_for(run, tmp_path):
    """On the same poses, which a tracker sees with its noise."""
    words = (*SMALL, "--modalities", "amplitude", "iq")
    exact = run("simulate", "-o", "exact.h5", *words)
    seen = run("simulate", "-o", "seen.h5", *words, "--tracker", "electromagnetic")
    true, tracked = (open_scan(tmp_path / name) for name in ("exact.h5", "seen.h5"))

    assert (exact.code, seen.code) == (0, 0), exact.error + seen.error
    assert set(true.companions) == {"amplitude", "iq"}
    assert len(true.companions["amplitude"].frames) == 8
    assert np.array_equal(true.frames[:], tracked.frames[:])
    error = (true.image_to_reference - tracked.image_to_reference)[:, :3, 3]
    assert 0.02 < float(error.std()) < 0.5


def test_other_formats_hold_a_sweep_without_its_companions(run, tmp_path):
    """The summary says what was left out."""
    ran = run("simulate", "-o", "s.igs.mha", *SMALL, "--modalities", "amplitude", "--json")

    assert ran.code == 0, ran.error
    assert json.loads(ran.out)["left_out"] == ["amplitude"]
    assert open_scan(tmp_path / "s.igs.mha").frames.shape == (8, 32, 40)


def test_a_data_set_is_made_with_its_table(run, tmp_path, monkeypatch):
    """One line says what is there; the same command again keeps it."""
    plan = (lambda *_: list(tiny_recipe().scans), ((1, 0, 1),) * 3)
    monkeypatch.setitem(datasets.RECIPES, "dataset1", plan)
    monkeypatch.setattr(make, "run_jobs", _run_here)
    words = ("simulate", "--dataset", "dataset1", "--size", "small", "-o", "set")

    first, second = run(*words), run(*words)

    assert first.code == 0, first.error
    assert "dataset1, small: 4 scans with 12 frames -> set" in first.out
    assert "frames: 24 of 24" in first.error
    assert "(4 were there)" in second.out
    assert len(list((tmp_path / "set").rglob("*.h5"))) == 4


def _run_here(work, jobs, workers, report):
    for job in jobs:
        work(job, report)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("-o", "x.h5", "--size", "small"), "are about a data set: give --dataset too"),
        (
            ("-o", "x", "--dataset", "dataset1", "--shape", "C"),
            "leave out the options of a single sweep, or --dataset",
        ),
        (("-o", "x", "--dataset", "dataset1", "--seed", "-1"), "seed of a data set is from 0"),
        (("-o", "x", "--dataset", "dataset1", "--workers", "0"), "workers must be from 1"),
        (
            ("-o", "x", "--dataset", "dataset1", "--layout", "tusrec", "--tracker", "optical"),
            "has a pose for each frame",
        ),
        (("-o", "x.h5", *SMALL, "--seed", "-1"), "0 or more, got -1"),
        (("-o", "x.h5", *SMALL, "--subject", "-4"), "a number from 0 to 999999, got -4"),
        (
            ("-o", "x.h5", "--body", "wires", "--length-mm", "-4"),
            "--length-mm must be above 0 and at most 350, got -4",
        ),
        (("-o", "x.h5", *SMALL, "--excursion-mm", "30"), "too wide for a sweep of 4 mm"),
        (("-o", "x.h5", "--body", "uniform", "--frames", "0"), "from 1 to 100000 frames, got 0"),
        (("-o", "x.h5", "--length-mm", "400", "--body", "uniform"), "at most 350, got 400"),
        (("-o", "x.h5", "--length-mm", "nan"), "at most 350, got nan"),
        (("-o", "x.h5", "--length-mm", "inf"), "at most 350, got inf"),
        (("-o", "x.h5", *SMALL, "--seed", "1.5"), "a whole number is needed, got 1.5"),
        (
            ("-o", "x.h5", *SMALL, "--shape", "straight", "--excursion-mm", "3"),
            "a straight sweep has no --excursion-mm",
        ),
        (("-o", "x.h5", *SMALL, "--side", "left"), "'uniform' has no left --side"),
        (
            ("-o", "x.h5", "--body", "uniform", "--pixels", "0", "8"),
            "a frame needs pixels, got 0 x 8",
        ),
        (
            ("-o", "x.h5", "--body", "uniform", "--pixels", "90000", "8"),
            "at most 4096 a side, got 90000 x 8",
        ),
        (("-o", "x.docx", *SMALL), "cannot write a scan as 'x.docx'"),
        (
            ("-o", "x.h5", *SMALL, "--probe", "convex", "--modalities", "photoacoustic"),
            "for linear arrays only",
        ),
    ],
)
def test_what_makes_no_sense_is_refused_in_one_sentence(run, tmp_path, words, sentence):
    """And nothing is written."""
    ran = run("simulate", *words)

    assert ran.code == 1
    assert sentence in ran.sentence
    assert list(tmp_path.iterdir()) == []


def test_info_shortens_the_settings_of_a_simulation(run, tmp_path):
    """A person sees what the frames are; a program gets every setting."""
    assert run("simulate", "-o", "x.h5", *SMALL).code == 0

    shown, whole = run("info", "x.h5"), run("info", "x.h5", "--json")

    assert max(len(line) for line in shown.out.splitlines()) < 260
    assert "0.35 s at 20.0 Hz" in shown.out
    assert json.loads(json.loads(whole.out)["notes"]["simulation"])["simulated"] is True


def test_existing_output_is_not_overwritten(run, tmp_path):
    """Unless asked."""
    (tmp_path / "mine.h5").write_text("mine")

    ran = run("simulate", "-o", "mine.h5", *SMALL)

    assert ran.code == 1
    assert "'mine.h5' exists" in ran.sentence
    assert (tmp_path / "mine.h5").read_text() == "mine"
    assert run("simulate", "-o", "mine.h5", *SMALL, "--force").code == 0
