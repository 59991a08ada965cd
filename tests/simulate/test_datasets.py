"""Data sets: as large as the paper's, split by subject, made whole and made again the same."""

import json
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import get_args

import h5py
import numpy as np
import pytest
import torch

from sonosweep.errors import FormatError, ScanError
from sonosweep.io import open_scan
from sonosweep.io.hdf5 import read_scan
from sonosweep.simulate import make, refuse_test_subjects
from sonosweep.simulate.datasets import DatasetRecipe, dataset_recipe
from sonosweep.simulate.make import dataset_files, make_dataset
from sonosweep.simulate.motion import sweep_poses
from sonosweep.simulate.planned_sweep import planned_body, simulate_planned
from sonosweep.simulate.random_sweep import ScannerKind, draw_sweep
from sonosweep.simulate.seeds import generator, subject_name
from sonosweep.simulate.tracker import ELECTROMAGNETIC, OPTICAL
from tests.simulate.motion_bodies import arm
from tests.simulate.tiny_dataset import planned, tiny_recipe

FULL = {name: dataset_recipe(name) for name in ("dataset1", "dataset2", "dataset3")}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Return the folder of the tiny data set, made by two workers."""
    folder = tmp_path_factory.mktemp("datasets") / "tiny"
    make_dataset(tiny_recipe(), folder, workers=2)
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    """Return the bytes of all files below a folder."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def counts(recipe: DatasetRecipe) -> tuple[int, int, int]:
    """Return how many scans are for training, validation and test."""
    split = recipe.split()  # refuses a subject in two parts
    return len(split.train), len(split.validation), len(split.test)


@pytest.mark.parametrize(
    ("name", "subjects", "scans", "parts"),
    [
        ("dataset1", 9, 54, (30, 6, 18)),
        ("dataset2", 10, 60, (30, 6, 24)),
        ("dataset3", 19, 228, (120, 48, 60)),
    ],
)
def test_full_data_sets_have_the_papers_scans(name, subjects, scans, parts):
    """As many subjects and scans, in the paper's split by subject."""
    recipe = FULL[name]

    assert len({scan.subject for scan in recipe.scans}) == subjects
    assert len(recipe.scans) == scans
    assert counts(recipe) == parts
    assert len({(scan.subject, scan.name) for scan in recipe.scans}) == scans


@pytest.mark.parametrize(
    ("name", "frames", "total"),
    [
        ("dataset1", (900, 1000), 51_300),
        ("dataset2", (400, 550), 28_445),
        ("dataset3", (36, 430), 30_552),
    ],
)
def test_full_data_sets_have_the_papers_frames(name, frames, total):
    """Per scan in the paper's range, and within 5 % of as many in all."""
    found = [scan.motion.frames for scan in FULL[name].scans]

    assert frames[0] <= min(found)
    assert max(found) <= frames[1]
    assert sum(found) == pytest.approx(total, rel=0.05)


def test_data_set_3_has_every_shape_in_both_orientations_on_both_arms():
    """Twelve scans of each subject, of the size of the Ultrasonix's images."""
    recipe = FULL["dataset3"]
    kinds = Counter(
        (scan.side, scan.motion.shape, scan.motion.orientation) for scan in recipe.scans
    )

    assert len(kinds) == 12
    assert set(kinds.values()) == {19}
    assert {scan.pixels for scan in recipe.scans} == {(640, 480)}
    assert {scan.probe for scan in recipe.scans} == {"convex"}


def test_data_set_2_has_doppler_and_photoacoustic_frames():
    """On the poses of B-mode."""
    found = {scan.modalities for scan in FULL["dataset2"].scans}

    assert found == {("power_doppler", "photoacoustic")}


@pytest.mark.parametrize(
    ("name", "low_mm", "high_mm"),
    [("dataset1", 200, 255), ("dataset2", 80, 150), ("dataset3", 95, 200)],
)
@pytest.mark.parametrize("seed", [0, 99])
def test_sweeps_stay_on_the_arm_and_are_as_long_as_the_papers(name, low_mm, high_mm, seed):
    """Path lengths of the true poses; steps of linear sweeps are 1 mm at most."""
    body = arm(250.0, 80.0)
    for scan in dataset_recipe(name, seed=seed).scans[::7]:
        poses, _ = sweep_poses(scan.motion, body, generator(scan.subject, scan.scan, "motion"))
        length = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum()
        steps = np.linalg.inv(poses[:-1]) @ poses[1:]
        assert low_mm < length < high_mm
        if scan.probe == "linear":
            assert np.abs(steps[:, 2, 3]).max() <= 1


def test_small_data_set_1_tests_as_long_sweeps_as_the_full_one():
    """18 test scans of unseen subjects with 900 frames or more over the whole field of view."""
    recipe = dataset_recipe("dataset1", "small")
    tests = [scan for scan in recipe.scans if scan.part == "test"]

    assert counts(recipe) == (30, 6, 18)
    assert min(scan.motion.frames for scan in tests) >= 900
    assert {scan.pixels for scan in recipe.scans} == {(256, 256)}


@pytest.mark.parametrize("name", ["dataset2", "dataset3"])
def test_other_small_data_sets_are_a_small_part_of_the_work(name):
    """Less than a tenth of the pixels."""
    pixels = [
        sum(s.motion.frames * s.pixels[0] * s.pixels[1] for s in dataset_recipe(name, size).scans)
        for size in ("small", "full")
    ]

    assert pixels[0] < 0.1 * pixels[1]


@pytest.mark.parametrize(
    ("name", "scans"), [("dataset1", 2700), ("dataset2", 1800), ("dataset3", 1080)]
)
def test_varied_data_sets_have_stretches_of_many_sweeps_to_learn_from(name, scans):
    """Of 90 people; tests are on as many scans as in the small ones."""
    recipe = dataset_recipe(name, "varied")
    train = [scan for scan in recipe.scans if scan.part == "train"]
    stretches = [scan.stretch for scan in train if scan.stretch is not None]

    assert len({scan.subject for scan in train}) == 90
    assert len(stretches) == len(train) == scans
    assert {scan.frames for scan in train} == {10}
    assert len({first for first, _ in stretches}) > 50
    assert all(0 <= s.stretch[0] <= s.motion.frames - 10 for s in train if s.stretch)
    assert counts(recipe)[1:] == (6, counts(dataset_recipe(name, "small"))[2])
    assert all(s.stretch is None for s in recipe.scans if s.part != "train")
    moves = [
        {(s.motion.orientation, s.motion.shape) for s in r.scans if s.part == "validation"}
        for r in (recipe, dataset_recipe(name))
    ]
    assert moves[0] == moves[1]  # progress is measured on every kind of sweep


def test_scanners_are_as_in_the_paper_unless_others_are_asked_for():
    """Clinical ones have a preset in each scan, the others one for all."""
    for name, kind in (
        ("dataset1", "research"),
        ("dataset2", "research"),
        ("dataset3", "speckle_reduced"),
    ):
        assert {scan.scanner for scan in FULL[name].scans} == {kind}
    clinical = dataset_recipe("dataset1", scanner="clinical")
    assert {scan.scanner for scan in clinical.scans} == {"clinical"}
    assert clinical.digest() != FULL["dataset1"].digest()
    plans = clinical.scans[:12]
    presets = {kind: set[tuple[float, ...]]() for kind in get_args(ScannerKind)}
    for kind, found in presets.items():
        for plan in plans:
            drawn = draw_sweep(plan.subject, plan.scan, plan.motion, scanner=kind).scanner
            found.add((drawn.persistence_frames, drawn.speckle_reduction, drawn.dynamic_range_db))
    assert presets["research"] == {(1, 0.0, 60.0)}
    assert presets["speckle_reduced"] == {(1, 0.6, 60.0)}
    assert len(presets["clinical"]) == 12


def test_companions_can_be_added_to_a_data_set():
    """Each once, beside those that it has."""
    recipe = dataset_recipe("dataset2", "small", modalities=("iq", "power_doppler"))

    assert {scan.modalities for scan in recipe.scans} == {("power_doppler", "photoacoustic", "iq")}


def test_a_data_set_can_have_fewer_subjects_to_learn_from():
    """The first ones, with the scans that they have in the whole set; other parts stay."""
    whole = dataset_recipe("dataset1", "varied")
    part = dataset_recipe("dataset1", "varied", subjects=3)

    assert {scan.subject for scan in part.scans if scan.part == "train"} == {0, 1, 2}
    assert [s for s in whole.scans if s.part != "train" or s.subject < 3] == list(part.scans)


@pytest.mark.parametrize("count", [0, 91])
def test_a_data_set_has_no_more_subjects_than_it_has(count):
    """Nor none."""
    with pytest.raises(ScanError, match=f"90 subjects for training.*got {count}"):
        dataset_recipe("dataset1", "varied", subjects=count)


def test_a_stretch_of_a_sweep_is_what_the_whole_sweep_has_there():
    """Frames, poses and times."""
    whole = replace(tiny_recipe().scans[0], stretch=None)
    part = replace(whole, stretch=(1, 2))
    body = planned_body(whole)
    long, short = simulate_planned(whole, body), simulate_planned(part, body)

    assert part.frames == len(short.frames) == 2
    assert part.digest() != whole.digest()
    np.testing.assert_array_equal(short.frames[:], long.frames[1:3])
    assert long.image_to_reference is not None
    assert short.image_to_reference is not None
    assert bool((short.image_to_reference == long.image_to_reference[1:3]).all())


@pytest.mark.parametrize("name", FULL)
def test_only_the_test_part_has_subjects_that_training_refuses(name):
    """Subjects from 900000 on; seeds share no subject."""
    first, last = dataset_recipe(name, seed=0), dataset_recipe(name, seed=99)
    for recipe in (first, last):
        for scan in recipe.scans:
            assert (scan.subject >= 900_000) == (scan.part == "test")
    names = [subject_name(scan.subject) for scan in first.scans if scan.part != "test"]
    refuse_test_subjects(names)
    with pytest.raises(ScanError, match="is kept for tests"):
        refuse_test_subjects([subject_name(scan.subject) for scan in first.scans])
    assert not {s.subject for s in first.scans} & {s.subject for s in last.scans}


def test_the_same_recipe_is_the_same_plan():
    """To the last number, and another seed another one."""
    assert dataset_recipe("dataset1", "small", 5) == dataset_recipe("dataset1", "small", 5)
    assert dataset_recipe("dataset1", "small", 5).digest() != FULL["dataset1"].digest()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("dataset9",), "there is no data set 'dataset9'; known are dataset1, dataset2, dataset3"),
        (("dataset1", "tiny"), "a data set is full, small or varied, got 'tiny'"),
        (("dataset1", "full", 100), "the seed of a data set is from 0 to 99, got 100"),
    ],
)
def test_recipes_that_do_not_exist_are_refused(arguments, words):
    """In one sentence."""
    with pytest.raises(ScanError) as caught:
        dataset_recipe(*arguments)

    assert words in str(caught.value)


def test_a_data_set_on_disk_holds_what_the_recipe_says(made):
    """Files by part, poses and companions in them, and a table of contents."""
    facts = json.loads((made / "dataset.json").read_text())
    files = list(dataset_files(made))
    scans = [open_scan(path) for _, path in files]

    assert facts["complete"]
    assert facts["split"] == {
        "train": ["simulated-000003"],
        "validation": [],
        "test": ["simulated-900007"],
    }
    assert [part for part, _ in files] == ["train", "train", "test", "test"]
    assert [scan.subject for scan in scans] == [entry["subject"] for entry in facts["scans"]]
    for scan in scans:
        assert scan.frames.shape == (3, 20, 24)
        assert scan.frames[:].std() > 5  # speckle
        assert scan.companions["amplitude"].frames.shape == (3, 20, 24)
        assert scan.image_to_reference.shape == (3, 4, 4)


def test_an_unfinished_data_set_is_completed_with_the_same_bytes(made, tmp_path):
    """What is lost, damaged or of another recipe is made again, here by one worker."""
    folder = tmp_path / "again"
    shutil.copytree(made, folder)
    lost, damaged, foreign, whole = (path for _, path in dataset_files(folder))
    lost.unlink()
    damaged.write_bytes(damaged.read_bytes()[:5000])
    shutil.copy(whole, foreign)  # it has as many frames, but they are others
    before = whole.stat().st_mtime_ns
    seen: list[tuple[int, int]] = []

    result = make_dataset(
        tiny_recipe(), folder, workers=1, progress=lambda done, total: seen.append((done, total))
    )

    assert contents(folder) == contents(made)
    assert result.kept == 1
    assert whole.stat().st_mtime_ns == before
    assert seen == [(done, 24) for done in range(6, 25)]


def test_a_complete_data_set_is_left_as_it_is(made):
    """Nothing is written, and it takes no worker."""
    before = {path: path.stat().st_mtime_ns for path in made.rglob("*.h5")}

    result = make_dataset(tiny_recipe(), made, workers=64)

    assert result.kept == 4
    assert {path: path.stat().st_mtime_ns for path in made.rglob("*.h5")} == before


@pytest.fixture
def in_this_process(monkeypatch):
    """Let jobs be done here: starting a worker takes seconds."""

    def run_here(work, jobs, workers, report):
        for job in jobs:
            work(job, report)

    monkeypatch.setattr(make, "run_jobs", run_here)


@pytest.mark.usefixtures("in_this_process")
def test_the_layout_of_tusrec_is_read_with_the_same_poses(made, tmp_path):
    """frames_transfs/SUBJECT/NAME.h5 with a calibration; poses go through float32 there."""
    folder = tmp_path / "tusrec"
    make_dataset(tiny_recipe(), folder, layout="tusrec")

    path = folder / "frames_transfs" / "simulated-900007" / "RH_Per_S_1.h5"
    again = open_scan(path)
    ours = read_scan(made / "test" / "simulated-900007_RH_Per_S_1.h5")

    assert (folder / "calib_matrix.csv").is_file()
    assert np.array_equal(again.frames[:], ours.frames[:])
    assert again.subject == ours.subject
    # Float32 of some 100 mm.
    assert torch.allclose(again.image_to_reference, ours.image_to_reference, rtol=0, atol=1e-4)


def test_a_folder_with_something_else_is_left_alone(made, tmp_path):
    """Another data set, or somebody's files."""
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("mine")
    other = replace(tiny_recipe(), scans=(planned(4, 0, "train"),))

    with pytest.raises(FormatError, match="holds other files: choose another folder"):
        make_dataset(tiny_recipe(), tmp_path / "mine")
    with pytest.raises(FormatError, match=r"holds another data set \(tiny, small, seed 0"):
        make_dataset(other, made)
    with pytest.raises(FormatError, match="holds another data set"):
        make_dataset(tiny_recipe(), made, tracker=ELECTROMAGNETIC)
    with pytest.raises(FormatError, match="is a file, an output folder is needed"):
        make_dataset(tiny_recipe(), tmp_path / "mine" / "thesis.txt")

    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["thesis.txt"]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"workers": 0}, "workers must be from 1 to 256, got 0"),
        ({"layout": "tusrec", "tracker": OPTICAL}, "has a pose for each frame, but this tracker"),
    ],
)
def test_what_cannot_be_made_is_refused_before_anything_is_written(changes, words, tmp_path):
    """In one sentence."""
    with pytest.raises(ScanError) as caught:
        make_dataset(tiny_recipe(), tmp_path / "new", **changes)

    assert words in str(caught.value)
    assert not (tmp_path / "new").exists()


def test_a_disk_that_is_too_small_is_noticed_first(monkeypatch, tmp_path):
    """The sentence says how much is needed."""
    monkeypatch.setattr(shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(9, 8, 1000))

    with pytest.raises(FormatError, match=r"needs .* GB more, but the disk"):
        make_dataset(tiny_recipe(), tmp_path / "new")


@pytest.mark.slow
def test_what_fails_in_a_worker_is_said_and_leaves_no_half_file(tmp_path):
    """A sweep that leaves its phantom ends the run; the scans before it are kept."""
    bad = replace(planned(3, 1, "train").motion, offset_mm=(500.0, 0.0))
    recipe = replace(tiny_recipe(), scans=(planned(3, 0, "train"), planned(3, 1, "train", bad)))

    with pytest.raises(ScanError, match="the sweep leaves phantom"):
        make_dataset(recipe, tmp_path / "new", workers=1)

    assert sorted(contents(tmp_path / "new")) == [
        "dataset.json",
        "train/simulated-000003_RH_Per_S_1.h5",
    ]
    with pytest.raises(FormatError, match="is not complete: make it again to go on"):
        list(dataset_files(tmp_path / "new"))


@pytest.mark.slow
@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGKILL])
def test_an_interrupted_run_leaves_no_half_written_file(stop, tmp_path) -> None:
    """Not even if the program is killed: its workers notice and remove what they began."""
    folder = tmp_path / "dataset"
    words = ["simulate", "--dataset", "dataset1", "--size", "small", "-o", str(folder)]
    process = subprocess.Popen(
        [sys.executable, "-m", "sonosweep", *words, "--workers", "2"], stderr=subprocess.DEVNULL
    )
    wait_for(lambda: len(list(folder.rglob(".writing-*.h5"))) == 2, 300)
    process.send_signal(stop)
    code = process.wait(60)

    wait_for(lambda: not list(folder.rglob(".writing-*")), 60)
    assert code == (130 if stop == signal.SIGINT else -signal.SIGKILL)
    for path in folder.rglob("*.h5"):
        with h5py.File(path) as file:
            assert len(file["frames"]) > 0


def wait_for(condition, longest_s: float) -> None:
    """Wait until something is so."""
    end = time.monotonic() + longest_s
    while not condition():
        assert time.monotonic() < end, "waited too long"
        time.sleep(0.05)


def test_changed_code_makes_another_data_set(monkeypatch):
    """Scans of code that was changed do not join those that older code made."""
    before = dataset_recipe("dataset1", "small", 5).digest()
    monkeypatch.setattr("sonosweep.simulate.datasets.program_digest", lambda: "changed")

    assert dataset_recipe("dataset1", "small", 5).digest() != before
