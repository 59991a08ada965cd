"""What is learnt from, and what must not be."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from sonosweep.errors import ScanError, SonosweepError
from sonosweep.estimators.network_input import InputSettings, image_steps
from sonosweep.geometry import step_from_motion, steps_from_poses
from sonosweep.imaging import lee_filter_gray
from sonosweep.io.hdf5 import write_scan
from sonosweep.scan import Calibration, Companion
from sonosweep.simulate.make import DATASET_NAME, FORMAT_NAME
from sonosweep.training.recipe import DataRecipe, SimulatedData
from sonosweep.training.scans import SimulatedScans, open_data, training_plan, training_scan
from tests.training.tiny import SIDE_PX, tiny_files, tiny_scan

SETTINGS = InputSettings(rows=SIDE_PX, columns=SIDE_PX)
ROUND_OFF = 1e-9  # float64: poses of some mm


def write(folder, *scans):
    """Write scans and return their paths."""
    paths = [folder / f"{k}.h5" for k in range(len(scans))]
    for path, scan in zip(paths, scans, strict=True):
        write_scan(scan, path)
    return tuple(str(path) for path in paths)


def data_set(folder, *subjects):
    """Write a data set as the simulator does, of subjects and what they are for."""
    scans = []
    for number, part in subjects:
        subject = f"simulated-{number:06d}"
        write_scan(tiny_scan(number, subject=subject), folder / f"{number}.h5")
        scans.append({"file": f"{number}.h5", "subject": subject, "part": part})
    facts = {"format": FORMAT_NAME, "complete": True, "scans": scans}
    (folder / DATASET_NAME).write_text(json.dumps(facts))


def lists(*paths: str) -> DataRecipe:
    """Return a recipe of scans, the last for validation."""
    return DataRecipe(train=paths[:-1], validation=paths[-1:])


def test_motion_is_that_of_the_frame():
    """The centre's motion, taken back to the first pixel, is the step of the scan's poses."""
    scan = tiny_scan(0)
    loaded = training_scan(scan, SETTINGS)

    steps = image_steps(step_from_motion(loaded.motion()), loaded.center)

    assert scan.image_to_reference is not None
    true = steps_from_poses(scan.image_to_reference)
    torch.testing.assert_close(steps, true, atol=ROUND_OFF, rtol=0)


def test_motion_of_the_frame_does_not_depend_on_its_pixels():
    """Halving the number of pixels leaves the centre, and so the motion, where it was."""
    scan = tiny_scan(0, side_px=2 * SIDE_PX)

    fine = training_scan(scan, InputSettings(rows=2 * SIDE_PX, columns=2 * SIDE_PX))
    coarse = training_scan(scan, SETTINGS)

    assert coarse.frames.shape == (12, 1, SIDE_PX, SIDE_PX)
    assert coarse.spacing_mm == pytest.approx((0.6, 0.4))
    torch.testing.assert_close(coarse.motion(), fine.motion(), atol=ROUND_OFF, rtol=0)


def test_frames_are_the_same_in_memory_and_from_the_file(tmp_path):
    """Without room in memory each frame is read when it is asked for."""
    paths = tiny_files(tmp_path)

    kept, _ = open_data(lists(*paths), SETTINGS)
    read, _ = open_data(lists(*paths).model_copy(update={"cache_gb": 0.0}), SETTINGS)

    chosen = np.array([3, 5, 4])
    assert isinstance(kept.scan(0, 1).frames, np.ndarray)
    assert not isinstance(read.scan(0, 1).frames, np.ndarray)
    np.testing.assert_array_equal(kept.scan(0, 1).stack(chosen), read.scan(0, 1).stack(chosen))


def test_windows_keep_clear_of_frames_without_pose():
    """Of 12 frames the tracker missed frame 4: windows of 3 begin at 0, 1, 5 to 9."""
    tracked = torch.ones(12, dtype=torch.bool)
    tracked[4] = False
    loaded = training_scan(tiny_scan(0, tracked=tracked), SETTINGS)

    assert loaded.starts(3).tolist() == [0, 1, 5, 6, 7, 8, 9]
    assert loaded.starts(3, stride=2).tolist() == [1, 3, 5, 6, 7]
    assert loaded.starts(13).tolist() == []


def test_a_subject_in_both_parts_is_refused(tmp_path):
    """Whoever is trained on proves nothing in validation."""
    paths = write(tmp_path, tiny_scan(0, subject="ann"), tiny_scan(1, subject="ann"))

    with pytest.raises(ScanError, match="'ann' is in train and in validation"):
        open_data(lists(*paths), SETTINGS)


@pytest.mark.parametrize("place", [0, 1])
def test_subjects_for_tests_are_refused(tmp_path, place):
    """Neither training nor the choice of settings may see them."""
    names = ["simulated-000001", "simulated-000002"]
    names[place] = "simulated-900000"
    paths = write(tmp_path, *(tiny_scan(k, subject=name) for k, name in enumerate(names)))

    with pytest.raises(ScanError, match="'simulated-900000' is kept for tests"):
        open_data(lists(*paths), SETTINGS)


def test_a_data_set_of_the_simulator_is_read_by_its_split(tmp_path):
    """Training and validation are those of dataset.json, and the test part stays closed."""
    data_set(tmp_path, (3, "train"), (4, "validation"), (900_007, "test"))

    pool, validation = open_data(DataRecipe(folder=str(tmp_path)), SETTINGS)

    assert [pool.scan(0, k).subject for k in range(len(pool))] == ["simulated-000003"]
    assert [scan.subject for scan in validation] == ["simulated-000004"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"subject": None}, "'scan0' names no subject"),
        ({"image_to_reference": None}, "'scan0' has no tracked poses"),
        ({"calibration": None}, "'scan0' has no pixel spacing"),
        ({"calibration": Calibration((0.4, 0.2))}, "train on scans of one field of view"),
    ],
)
def test_what_cannot_be_learnt_from_is_named(tmp_path, changes, message):
    """Without subject, poses or pixel size, or with pixels of another size."""
    paths = write(tmp_path, replace(tiny_scan(0), **changes), tiny_scan(1))

    with pytest.raises(ScanError, match=message):
        open_data(lists(*paths), SETTINGS)


def with_echoes(name: str, values: np.ndarray):
    """Return a scan with a companion of B-mode's pixels."""
    return tiny_scan(0, companions={name: Companion(values, (0.3, 0.2))})


def test_amplitudes_are_shares_of_the_largest():
    """Before log compression: linear, and 1 at the 99.5th percentile of the scan."""
    values = np.random.default_rng(1).rayleigh(2.0, (12, SIDE_PX, SIDE_PX)).astype(np.float32)
    settings = SETTINGS.model_copy(update={"channels": "amplitude"})

    frames = training_scan(with_echoes("amplitude", values), settings).frames

    # Eight of the twelve frames are looked at; half precision has 11 bits.
    white = np.percentile(values[np.linspace(0, 11, 8).astype(int)], 99.5)
    np.testing.assert_allclose(frames[:, 0], (values / white).clip(0, 1), atol=2**-11)


def test_iq_has_an_amplitude():
    """Where no amplitude is stored, its size is taken."""
    values = np.random.default_rng(1).normal(0, 2, (12, SIDE_PX, SIDE_PX, 2)).astype(np.float32)
    settings = SETTINGS.model_copy(update={"channels": "amplitude"})

    of_iq = training_scan(with_echoes("iq", values), settings).frames
    stored = training_scan(
        with_echoes("amplitude", np.hypot(values[..., 0], values[..., 1])), settings
    ).frames

    np.testing.assert_array_equal(of_iq[:], stored[:])


def test_iq_comes_beside_b_mode():
    """Three channels: gray levels, and real and imaginary part about 0.5."""
    values = np.random.default_rng(1).normal(0, 2, (12, SIDE_PX, SIDE_PX, 2)).astype(np.float32)
    scan = with_echoes("iq", values)

    frames = training_scan(scan, SETTINGS.model_copy(update={"channels": "b_mode+iq"})).frames

    largest = np.hypot(values[..., 0], values[..., 1])[np.linspace(0, 11, 8).astype(int)]
    parts = np.moveaxis(0.5 + 0.5 * values / np.percentile(largest, 99.5), -1, 1)
    np.testing.assert_allclose(frames[:, 0], scan.frames[:] / 255, atol=2**-11)
    np.testing.assert_allclose(frames[:, 1:], parts.clip(0, 1), atol=2**-11)


def test_lee_frames_have_less_speckle():
    """The channel is the filter's own output."""
    scan = tiny_scan(0)

    frames = training_scan(scan, SETTINGS.model_copy(update={"channels": "lee"})).frames

    np.testing.assert_array_equal(frames[3, 0], lee_filter_gray(scan.frames[3]))


def test_a_missing_channel_is_named():
    """A scan without amplitudes cannot give them."""
    settings = SETTINGS.model_copy(update={"channels": "amplitude"})

    with pytest.raises(ScanError, match="need the companion 'amplitude' or 'iq', which 'scan0'"):
        training_scan(tiny_scan(0), settings)


def test_the_middle_of_frames_can_be_taken():
    """A crop of the middle keeps its pixels and its size in mm."""
    scan = tiny_scan(0, side_px=48)

    loaded = training_scan(scan, SETTINGS.model_copy(update={"crop_px": (SIDE_PX, SIDE_PX)}))

    np.testing.assert_array_equal(loaded.frames[2, 0], scan.frames[2, 8:40, 8:40])
    assert loaded.spacing_mm == (0.3, 0.2)


def test_simulated_scans_give_way_one_by_one(monkeypatch):
    """With three places, round 1 has a new scan in place 0, round 2 in place 1, and so on."""
    made: list[int] = []

    def make(number, settings):
        made.append(number)
        return training_scan(tiny_scan(number), settings)

    monkeypatch.setattr("sonosweep.training.scans.training_plan", lambda data, number: number)
    monkeypatch.setattr("sonosweep.training.scans._simulated", make)
    pool = SimulatedScans(SimulatedData(scans=3), SETTINGS)

    rounds = [[pool.scan(epoch, place).name for place in range(3)] for epoch in range(4)]

    assert rounds == [
        ["scan0", "scan1", "scan2"],
        ["scan3", "scan1", "scan2"],
        ["scan3", "scan4", "scan2"],
        ["scan3", "scan4", "scan5"],
    ]
    assert made == [0, 1, 2, 3, 4, 5]


def test_simulated_plans_are_all_different_and_for_training():
    """Sixty scans in a row are of ten subjects, none of them for tests."""
    plans = [training_plan(SimulatedData(first_seed=2), number) for number in range(60)]

    assert len({(plan.subject, plan.scan) for plan in plans}) == 60
    assert len({plan.subject for plan in plans}) == 10
    assert all(plan.part == "train" and plan.subject < 900_000 for plan in plans)


def test_simulated_plans_begin_again_after_the_last_seed():
    """There are a hundred seeds; what comes after them is refused nowhere."""
    data = SimulatedData(first_seed=99)

    assert training_plan(data, 30) == training_plan(data, 0)


@pytest.mark.slow
def test_simulated_frames_have_the_size_that_is_read():
    """The simulator makes frames at the size of the network's input."""
    data = DataRecipe(simulated=SimulatedData(scans=1, validation_scans=1))

    pool, validation = open_data(data, SETTINGS)

    assert pool.scan(0, 0).frames.shape[1:] == (1, SIDE_PX, SIDE_PX)
    assert pool.scan(0, 0).subject != validation[0].subject


def test_no_scans_for_validation_is_said(tmp_path):
    """A data set without that part cannot be trained on."""
    data_set(tmp_path, (3, "train"), (900_007, "test"))

    with pytest.raises(SonosweepError, match="no scans for validation"):
        open_data(DataRecipe(folder=str(tmp_path)), SETTINGS)
