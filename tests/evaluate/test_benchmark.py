"""Many scans and methods: numbers, what is kept, and what each method may look at."""

import json
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from sonosweep.errors import FormatError, ScanError
from sonosweep.estimators import DecorrelationCurve, DecorrelationEstimator, MotionEstimate
from sonosweep.estimators.network_input import center_mm, center_poses
from sonosweep.evaluate import benchmark
from sonosweep.evaluate.baselines import (
    decorrelation_baselines,
    longest_of_subjects,
    mean_curve,
    mean_motion,
    quick_baselines,
)
from sonosweep.evaluate.benchmark import measure, run_benchmark
from sonosweep.evaluate.dataset_scans import dataset_scans
from sonosweep.evaluate.methods import (
    Decorrelation,
    MeanMotion,
    Method,
    Network,
    NoMotion,
    TrueMean,
)
from sonosweep.geometry import (
    motion_from_step,
    poses_from_steps,
    step_from_motion,
    steps_from_poses,
)
from sonosweep.io import open_scan
from sonosweep.io.hdf5 import write_scan
from sonosweep.scan import Calibration, Scan, Trajectory
from sonosweep.simulate import make_dataset

from ..cli.conftest import speckle_scan
from ..estimators.tiny_weights import SIDE, SPACING_MM, tiny_weights
from ..simulate.tiny_dataset import tiny_recipe

ROUND_OFF = 1e-9


def scan_of(*elevational_mm: float, name: str = "sweep", subject: str = "a") -> Scan:
    """Black frames of 40 x 32 pixels that move by these steps along z."""
    motion = torch.zeros(len(elevational_mm), 6, dtype=torch.float64)
    motion[:, 2] = torch.tensor(elevational_mm)
    return Scan(
        name=name,
        frames=np.zeros((len(motion) + 1, 32, 40), np.uint8),
        calibration=Calibration(spacing_mm=(0.2, 0.1)),
        image_to_reference=poses_from_steps(
            step_from_motion(motion), torch.eye(4, dtype=torch.float64)
        ),
        subject=subject,
    )


@pytest.fixture
def files(tmp_path) -> list[Path]:
    """Three scans of three subjects with mean steps of 1, 2 and 3 mm."""
    paths = []
    for name, steps in {"a": (0.5, 1.5), "b": (1.0, 3.0), "c": (3.0, 3.0, 3.0)}.items():
        write_scan(scan_of(*steps, name=name, subject=name), tmp_path / f"{name}.h5")
        paths.append(tmp_path / f"{name}.h5")
    return paths


@pytest.fixture
def one_process(monkeypatch) -> None:
    """Do the work here: a process of its own takes seconds to start."""

    def run_jobs(work, jobs, workers, report):
        for job in jobs:
            work(job, report)

    monkeypatch.setattr(benchmark, "run_jobs", run_jobs)


@pytest.fixture(scope="module")
def tiny(tmp_path_factory) -> Path:
    """A simulated data set: two scans to train on, two for tests."""
    return make_dataset(tiny_recipe(), tmp_path_factory.mktemp("made") / "tiny").folder


@pytest.fixture
def dataset(tiny, tmp_path) -> Path:
    """A copy of it that may be changed."""
    return Path(shutil.copytree(tiny, tmp_path / "tiny"))


@dataclass(frozen=True)
class Spy(Method):
    """Says that nothing moved, and whether it saw the poses."""

    name: str = "spy"

    def trajectory(self, scan, progress=None):
        """Refuse to see poses."""
        assert scan.image_to_reference is None
        assert scan.tracked is None
        return Trajectory(torch.eye(4, dtype=torch.float64).repeat(len(scan.frames), 1, 1))


def test_the_numbers_of_a_sweep_of_three_frames():
    """Steps of 1 and 3 mm, estimated as 2 and 2: 1 mm wrong per step, right in the end."""
    row, trajectory = measure(TrueMean(), scan_of(1.0, 3.0))

    assert row["relative_error_mm"] == pytest.approx(1 / 3)  # of three translations
    assert row["relative_error_deg"] == pytest.approx(0, abs=ROUND_OFF)
    assert row["relative_error_mixed"] == pytest.approx(1 / 6)
    assert row["relative_frame_error_mm"] == pytest.approx(1)
    assert row["accumulated_frame_error_mm"] == pytest.approx(0.5)
    assert row["final_drift_mm"] == pytest.approx(0, abs=ROUND_OFF)
    assert row["final_drift_rate_path_percent"] == pytest.approx(0, abs=ROUND_OFF)
    assert row["correlation_elevational"] is None  # the same motion in every step
    assert trajectory.image_to_reference[:, 2, 3].tolist() == pytest.approx([0, 2, 4])


def test_no_motion_drifts_by_the_whole_path():
    """100 % of path and chord of a straight sweep."""
    row, _ = measure(NoMotion(), scan_of(1.0, 3.0))

    assert row["final_drift_rate_path_percent"] == pytest.approx(100)
    assert row["final_drift_rate_chord_percent"] == pytest.approx(100)
    assert row["accumulated_frame_error_mm"] == pytest.approx((1 + 4) / 2)


def test_no_method_but_an_oracle_sees_the_poses():
    """A scan reaches a method without its tracked poses."""
    row, _ = measure(Spy(), scan_of(1.0, 3.0))

    assert row["final_drift_mm"] == pytest.approx(4)


def test_only_what_is_missing_is_computed(files, tmp_path):
    """A second run reads the answers; one that was damaged is found again, the others stay."""
    said: list[tuple[int, int]] = []
    kept = tmp_path / "kept"
    methods = [NoMotion(), TrueMean()]

    first = run_benchmark(files[:2], methods, kept, simulated=False)
    answers = sorted(kept.iterdir())
    before = [answer.stat().st_mtime_ns for answer in answers]
    answers[0].write_text("{")
    again = run_benchmark(
        files[:2], methods, kept, simulated=False, progress=lambda *now: said.append(now)
    )

    after = [answer.stat().st_mtime_ns for answer in answers]
    assert len(answers) == 4
    assert said == [(9, 12), (12, 12)]  # 3 of 12 frames were to be done again
    assert after[0] != before[0]
    assert after[1:] == before[1:]
    clock = {"cpu_s"}
    assert [{k: v for k, v in row.items() if k not in clock} for row in again] == [
        {k: v for k, v in row.items() if k not in clock} for row in first
    ]


@pytest.mark.usefixtures("one_process")
def test_an_answer_holds_the_estimated_motion(files, tmp_path):
    """So that other numbers can be had of it without the frames."""
    run_benchmark(files[2:], [TrueMean()], tmp_path / "kept", simulated=False)
    (answer,) = (tmp_path / "kept").iterdir()

    motion = json.loads(answer.read_text())["motion"]

    assert np.allclose(motion, [[0, 0, 3, 0, 0, 0]] * 3, atol=ROUND_OFF)


@pytest.mark.usefixtures("one_process")
def test_another_scan_or_method_of_the_same_name_is_another_answer(files, tmp_path):
    """Answers are named by what went in, not by what it is called."""
    kept = tmp_path / "kept"
    slow, fast = (MeanMotion(motion=(0.0, 0.0, mm, 0.0, 0.0, 0.0)) for mm in (1.0, 2.0))
    (first,) = run_benchmark(files[:1], [slow], kept, simulated=False)
    (second,) = run_benchmark(files[:1], [fast], kept, simulated=False)
    write_scan(scan_of(2.0, 2.0, name="a", subject="a"), files[0])
    (third,) = run_benchmark(files[:1], [fast], kept, simulated=False)

    drifts = [row["final_drift_mm"] for row in (first, second, third)]
    assert drifts == pytest.approx([0, 2, 0], abs=ROUND_OFF)


def test_a_benchmark_of_nothing_or_of_two_alike_is_refused(files, tmp_path):
    """One sentence each."""
    with pytest.raises(ScanError, match="needs a scan and a method"):
        run_benchmark(files, [], tmp_path, simulated=True)
    with pytest.raises(ScanError, match="two methods are called 'no motion'"):
        run_benchmark(files, [NoMotion(), NoMotion()], tmp_path, simulated=True)
    with pytest.raises(ScanError, match="workers must be from 1"):
        run_benchmark(files, [NoMotion()], tmp_path, simulated=True, workers=0)


@pytest.mark.usefixtures("one_process")
def test_a_method_that_cannot_use_a_scan_is_named(tmp_path):
    """So that a run over many says where it stopped."""
    write_scan(scan_of(1.0, 1.0, name="flat"), tmp_path / "flat.h5")

    with pytest.raises(ScanError, match="'decorrelation, scale guessed' on 'flat': "):
        run_benchmark([tmp_path / "flat.h5"], [Decorrelation()], tmp_path, simulated=False)


def test_the_mean_motion_is_that_of_the_training_scans(dataset):
    """Every training scan counts, and without the scans for tests it is the same."""
    data = dataset_scans(dataset)
    before = mean_motion(data.training)

    for path in data.scans:
        path.unlink()

    assert {open_scan(path).subject for path in data.training} == {"simulated-000003"}
    assert {path.parent.name for path in data.scans} == {"test"}
    assert torch.equal(mean_motion(data.training), before)
    assert not torch.equal(mean_motion(data.training[:1]), before)
    assert quick_baselines(data.training)[1].motion == pytest.approx(before.tolist())


def test_methods_learn_from_no_test_subject(tmp_path):
    """A file of a test subject among the training scans is refused by name."""
    write_scan(scan_of(1.0, 1.0, subject="simulated-900001"), tmp_path / "test.h5")

    with pytest.raises(ScanError, match="'simulated-900001' is kept for tests"):
        quick_baselines([tmp_path / "test.h5"])
    with pytest.raises(ScanError, match="'simulated-900001' is kept for tests"):
        decorrelation_baselines([tmp_path / "test.h5"], tmp_path)


def test_a_data_set_with_a_subject_in_two_parts_is_refused(dataset):
    """Whatever dataset.json says, the files' own subjects count."""
    data = dataset_scans(dataset)
    data.scans[0].write_bytes(data.training[0].read_bytes())

    with pytest.raises(ScanError, match="'simulated-000003' is in train and in test"):
        dataset_scans(dataset)


def test_the_first_scans_of_a_part(tiny, tmp_path):
    """As many as asked for, and no more than there are."""
    assert len(dataset_scans(tiny, first=1).scans) == 1
    with pytest.raises(ScanError, match="has 2 scans: asked for the first 3"):
        dataset_scans(tiny, first=3)
    with pytest.raises(ScanError, match="no scans for validation"):
        dataset_scans(tiny, "validation")
    with pytest.raises(FormatError, match="cannot be read"):
        dataset_scans(tmp_path)


def test_the_mean_of_curves():
    """Widths of 0.2 and 0.8 mm have a mean of 0.4 mm: they are scales."""
    one, other = (
        DecorrelationCurve(width_mm=(w,), exponent=e, preset=p)
        for w, e, p in ((0.2, 1.0, "a"), (0.8, 2.0, "b"))
    )

    mean = mean_curve([one, other])

    assert mean.width_mm == pytest.approx((0.4,))
    assert mean.exponent == pytest.approx(1.5)
    assert mean.preset == "a, b"
    with pytest.raises(ScanError, match="different depths"):
        mean_curve([one, DecorrelationCurve(depth_mm=(0.0, 9.0), width_mm=(1.0, 1.0))])


@pytest.mark.usefixtures("one_process")
def test_a_network_is_one_of_the_methods(tmp_path):
    """Its answer is that of the weights, and the direction turns the elevational motion."""
    noise = np.random.default_rng(1).integers(0, 255, (8, SIDE, SIDE), np.uint8)
    scan = replace(scan_of(*[1.0] * 7), frames=noise, calibration=Calibration((SPACING_MM,) * 2))
    write_scan(scan, tmp_path / "noise.h5")
    file = tiny_weights(tmp_path)
    both = [Network("forward", file), Network("backward", file, direction=-1)]

    rows = run_benchmark([tmp_path / "noise.h5"], both, tmp_path / "kept", simulated=False)

    assert [row["kind"] for row in rows] == ["network", "network"]
    forward, backward = (row["correlation_lateral"] for row in rows)
    assert forward == pytest.approx(backward)
    assert rows[0]["final_drift_mm"] != pytest.approx(rows[1]["final_drift_mm"])
    assert rows[0]["direction_agrees"] is not rows[1]["direction_agrees"]


def test_changed_code_answers_again(tmp_path, monkeypatch):
    """An answer of the code as it was before is no answer of the code as it is."""
    write_scan(scan_of(*[1.0] * 4), tmp_path / "steady.h5")
    given = ([tmp_path / "steady.h5"], [NoMotion()], tmp_path / "kept")
    run_benchmark(*given, simulated=False)
    run_benchmark(*given, simulated=False)
    assert len(list((tmp_path / "kept").iterdir())) == 1

    monkeypatch.setattr("sonosweep.evaluate.methods.source_digest", lambda *_: "changed")
    run_benchmark(*given, simulated=False)

    assert len(list((tmp_path / "kept").iterdir())) == 2


def test_the_longest_scans_of_different_subjects_teach(tmp_path):
    """Not short stretches where there are whole sweeps."""
    lengths = {"a": 3, "b": 9, "c": 5}
    for name, steps in lengths.items():
        subject = {"c": "second"}.get(name, "first")
        write_scan(replace(scan_of(*[1.0] * steps), subject=subject), tmp_path / f"{name}.h5")

    found = longest_of_subjects([tmp_path / f"{name}.h5" for name in lengths])

    assert [path.stem for path in found] == ["b", "c"]


def test_sweeps_in_the_plane_of_the_image_teach_no_decorrelation(tmp_path):
    """However long they are; if there are no others, that is said."""
    turn = torch.eye(4, dtype=torch.float64)[[2, 1, 0, 3]]  # what was out of the plane is lateral
    for name, steps, aside in (("a", 3, False), ("b", 9, True)):
        scan = replace(scan_of(*[1.0] * steps), subject="first")
        if aside:
            poses = turn @ scan.image_to_reference @ turn
            scan = replace(scan, image_to_reference=poses)
        write_scan(scan, tmp_path / f"{name}.h5")

    assert longest_of_subjects([tmp_path / "a.h5", tmp_path / "b.h5"]) == [tmp_path / "a.h5"]
    with pytest.raises(ScanError, match="no scan to learn from moves out of its plane"):
        decorrelation_baselines([tmp_path / "b.h5"], tmp_path)


def test_what_training_scans_teach_the_decorrelation_estimator(tmp_path):
    """On the scan it learned from its path is as long as the true one; nothing is learned twice."""
    speckle = speckle_scan(frames=10)
    write_scan(replace(speckle, subject="a"), tmp_path / "speckle.h5")

    guess, stretched, curved = decorrelation_baselines([tmp_path / "speckle.h5"], tmp_path)
    kept = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    again = decorrelation_baselines([tmp_path / "speckle.h5"], tmp_path)

    assert [guess, stretched, curved] == again
    assert {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()} == kept
    assert guess.stretch == 1
    assert curved.curve.source == "tracked"
    blind = replace(speckle, image_to_reference=None)
    moved = [elevation_mm(m.trajectory(blind), speckle) for m in (guess, stretched, curved)]
    true = elevation_mm(speckle, speckle)
    assert abs(moved[0] - true) > 0.1  # the guess is off, or there was nothing to learn
    # Turns of single steps are stretched too, so the chain is not exactly linear.
    assert moved[1:] == pytest.approx([true] * 2, rel=0.02)


def elevation_mm(poses, scan):
    """How far the centre of the frame goes out of its plane."""
    centers = center_poses(poses.image_to_reference, center_mm(scan))
    return float(steps_from_poses(centers)[:, 2, 3].sum())


def test_a_stretched_estimate_turns_and_moves_farther_out_of_its_plane(monkeypatch):
    """Twice as far along z and twice the pitch; nothing changes within the plane."""
    motion = torch.tensor([[0.1, 0.2, 0.3, 0.01, 0.0, 0.02]], dtype=torch.float64)
    found = MotionEstimate(motion)
    monkeypatch.setattr(DecorrelationEstimator, "estimate", lambda *_: found)

    trajectory = Decorrelation(stretch=2.0).trajectory(scan_of(1.0))

    (step,) = motion_from_step(steps_from_poses(trajectory.image_to_reference))
    assert step.tolist() == pytest.approx([0.1, 0.2, 0.6, 0.02, 0, 0.02])
