"""Comparing an estimate with the tracker, and the tables of it."""

import csv
import json
import math
from dataclasses import replace

import h5py
import numpy as np
import pytest
import torch
from hypothesis import given

from sonosweep.errors import FormatError, ScanError
from sonosweep.evaluate import (
    compare_trajectories,
    comparison_row,
    comparison_table,
    markdown_table,
    paper_table,
    summarize,
    write_csv,
    write_json,
)
from sonosweep.geometry import interpolate_poses, pose_from_parts
from sonosweep.scan import Calibration, Region, Scan, Trajectory

from ..strategies import poses, scans

ROUND_OFF_MM = 1e-6


def straight(*elevational_mm):
    """Poses that only move, to the given distances along z."""
    shift = torch.zeros(len(elevational_mm), 3, dtype=torch.float64)
    shift[:, 2] = torch.tensor(elevational_mm)
    return pose_from_parts(torch.eye(3, dtype=torch.float64).expand(len(shift), 3, 3), shift)


def scan_of(image_to_reference, **changes):
    """A scan of black frames with these poses, 10 frames per second."""
    count = len(image_to_reference)
    fields = {
        "name": "sweep",
        "frames": np.zeros((count, 32, 40), np.uint8),
        "calibration": Calibration(spacing_mm=(0.2, 0.1)),
        "timestamps_s": torch.arange(count, dtype=torch.float64) / 10,
        "image_to_reference": image_to_reference,
    }
    return Scan(**{**fields, **changes})


@given(scans(), poses())
def test_the_tracked_trajectory_is_without_error(scan, reference):
    """The tracker compared with itself, in whatever reference, drifts nowhere."""
    estimated = Trajectory(reference @ scan.image_to_reference, method="tracked")

    found = compare_trajectories(estimated, scan)

    assert found.metrics.maximum_drift_mm == pytest.approx(0, abs=ROUND_OFF_MM)
    assert found.tusrec.global_pixel_error_mm == pytest.approx(0, abs=ROUND_OFF_MM)
    assert found.matched_by == "count"
    assert found.direction_agrees is True


def test_a_drift_of_half_a_millimetre():
    """1 mm in 10 frames, estimated as 1.5: the sentence a person reads."""
    found = compare_trajectories(
        Trajectory(straight(0.0, 0.75, 1.5), method="made up", assumptions=("forward",)),
        scan_of(straight(0.0, 0.5, 1.0)),
    )

    assert str(found) == (
        "sweep: final drift 0.5 mm (50 % of a path of 1 mm), median 0.375 mm, over 3 frames"
    )
    assert found.drift_mm.tolist() == pytest.approx([0, 0.25, 0.5])
    assert found.points == "256 pixels of columns 0 to 39 and rows 0 to 31"
    assert found.assumptions == ("forward",)


def test_a_sweep_taken_for_its_mirror_image_is_noticed():
    """The wrong direction is said in words, with what to do."""
    found = compare_trajectories(Trajectory(straight(0.0, -1, -2)), scan_of(straight(0.0, 1, 2)))

    assert found.direction_agrees is False
    assert "sweeps the other way: set the direction" in str(found)


def test_a_probe_at_rest_has_no_direction_and_no_rate():
    """Without movement there is nothing to divide by, and the sentence leaves it out."""
    found = compare_trajectories(Trajectory(straight(0.0, 0.1)), scan_of(straight(0.0, 0.0)))

    assert found.direction_agrees is None
    assert str(found) == "sweep: final drift 0.1 mm, median 0.1 mm, over 2 frames"


def test_frames_are_matched_by_time_if_counts_differ():
    """An estimate of every second frame at 1 mm per 0.1 s is right, and so are times between."""
    scan = scan_of(straight(*[float(i) for i in range(10)]))
    times = torch.tensor([0.05, 0.25, 0.45, 0.65], dtype=torch.float64)
    estimated = Trajectory(straight(0.0, 2, 4, 6), timestamps_s=times)

    found = compare_trajectories(estimated, scan)

    assert found.matched_by == "time"
    assert found.metrics.maximum_drift_mm == pytest.approx(0, abs=ROUND_OFF_MM)
    assert found.metrics.path_length_mm == pytest.approx(6)


@given(scans(frames=8))
def test_both_ways_to_match_agree(scan):
    """At the frames' own times, matching by time is matching by number."""
    estimated = Trajectory(scan.image_to_reference.flip(0), timestamps_s=scan.timestamps_s)

    by_time = compare_trajectories(estimated, scan, match="time").metrics.as_dict()

    by_count = compare_trajectories(estimated, scan, match="count").metrics.as_dict()
    assert by_time == pytest.approx(by_count, abs=ROUND_OFF_MM)


def test_frames_the_tracker_lost_do_not_count():
    """A frame without pose is left out, by number and by time; TUS-REC's errors need all."""
    true = straight(0.0, 1, 2, 3)
    true[1] = math.nan
    scan = scan_of(true, tracked=torch.tensor([True, False, True, True]))
    estimated = Trajectory(straight(0.0, 9, 2, 3), timestamps_s=scan.timestamps_s)

    found = compare_trajectories(estimated, scan)

    assert found.metrics.maximum_drift_mm == pytest.approx(0, abs=ROUND_OFF_MM)
    assert found.frames_without_pose == 1
    assert torch.isnan(found.drift_mm).tolist() == [False, True, False, False]
    assert found.tusrec is None
    by_time = compare_trajectories(estimated, scan, match="time", max_gap_s=0.15)
    assert by_time.frames_without_pose == 1


def test_only_the_region_counts():
    """Points lie in the part of the frame that holds the image, shear and spacing included."""
    turn = straight(0.0, 0.0)
    turn[1, :2, :2] = torch.tensor([[0.0, -1], [1, 0]])
    scan = scan_of(
        straight(0.0, 0.0),
        region=Region((10, 20, 1, 1)),
        calibration=Calibration(spacing_mm=(0.3, 0.4), shear=0.5),
    )

    found = compare_trajectories(Trajectory(turn), scan)

    # Pixel (10, 20) is 20 * 0.4 = 8 mm deep and 10 * 0.3 + 0.5 * 8 = 7 mm to the right.
    assert found.metrics.final_drift_mm == pytest.approx(math.sqrt(2) * math.hypot(7, 8))
    assert found.points == "1 pixels of columns 10 to 10 and rows 20 to 20"


def test_two_trajectories_with_given_points():
    """Without a scan the points are given, and there are no errors over all pixels."""
    found = compare_trajectories(
        Trajectory(straight(0.0, 2)),
        Trajectory(straight(0.0, 1)),
        points_mm=torch.zeros(1, 3).double(),
    )

    assert found.metrics.final_drift_mm == pytest.approx(1)
    assert found.tusrec is None
    assert found.points == "1 given points"


def test_landmarks_are_passed_on():
    """The challenge's landmark errors come with its landmarks."""
    found = compare_trajectories(
        Trajectory(straight(0.0, 2)), scan_of(straight(0.0, 1)), landmarks=torch.tensor([[1, 4, 5]])
    )

    assert found.tusrec.global_landmark_error_mm == pytest.approx(1)


def test_landmarks_need_the_scan_s_own_frames():
    """A landmark names a frame; matched by time, the estimate's frames have other numbers."""
    times = torch.arange(2, dtype=torch.float64)
    scan = replace(scan_of(straight(0.0, 1)), timestamps_s=times)

    with pytest.raises(ScanError, match="match by number"):
        compare_trajectories(
            Trajectory(straight(0.0, 2), times),
            scan,
            match="time",
            landmarks=torch.tensor([[1, 4, 5]]),
        )


def test_what_cannot_be_compared():
    """What is missing is named, with the scan."""
    scan = scan_of(straight(0.0, 1, 2))
    short = Trajectory(straight(0.0, 1))

    with pytest.raises(ScanError, match="2 estimated poses but 3 tracked ones in 'sweep', and no"):
        compare_trajectories(short, scan)
    with pytest.raises(ScanError, match="match them by time"):
        compare_trajectories(short, scan, match="count")
    with pytest.raises(ScanError, match="the estimate has none"):
        compare_trajectories(short, scan, match="time")
    with pytest.raises(ScanError, match="'sweep' has none"):
        compare_trajectories(
            replace(short, timestamps_s=torch.arange(2).double()),
            replace(scan, timestamps_s=None),
            match="time",
        )
    with pytest.raises(ScanError, match="'sweep' holds no tracked poses"):
        compare_trajectories(short, replace(scan, image_to_reference=None))
    with pytest.raises(ScanError, match="pixel spacing of 'sweep'"):
        compare_trajectories(short, replace(scan, calibration=None))
    with pytest.raises(ScanError, match="a trajectory has no image size"):
        compare_trajectories(short, short)


def three_comparisons():
    """Two scans of one subject and one of another, drifts 0.5, 1 and 3 mm."""
    result = []
    for name, subject, drift in (("a", "P1", 0.5), ("b", "P1", 1.0), ("c", "P2", 3.0)):
        scan = scan_of(straight(0.0, 5, 10), name=name, subject=subject)
        result.append(
            compare_trajectories(Trajectory(straight(0.0, 5, 10 + drift), method="made|up"), scan)
        )
    return result


def test_json_holds_everything(tmp_path):
    """Numbers per scan, drift per frame, and means with intervals: strict JSON."""
    lost = straight(0.0, 1, 2)
    lost[1] = math.nan
    with_gap = compare_trajectories(
        Trajectory(straight(0.0, 1, 2)),
        scan_of(lost, tracked=torch.tensor([True, False, True])),
    )

    write_json([*three_comparisons(), with_gap], tmp_path / "out" / "result.json")

    def refuse(constant):
        raise AssertionError(constant)

    content = json.loads((tmp_path / "out" / "result.json").read_text(), parse_constant=refuse)
    assert [scan["scan"] for scan in content["scans"]] == ["a", "b", "c", "sweep"]
    assert content["scans"][0]["final_drift_mm"] == pytest.approx(0.5)
    assert content["scans"][3]["drift_mm"][1] is None
    assert content["scans"][3]["relative_error_mm"] is None
    assert content["means"]["final_drift_mm"]["mean"] == pytest.approx(4.5 / 4)
    assert content["means"]["relative_error_mm"]["count"] == 3
    assert content["program"].startswith("sonosweep ")


def test_the_table_people_read():
    """A line per number with its unit; what is not defined is left out."""
    found = compare_trajectories(
        Trajectory(straight(0.0, 0.75, 0.25)), scan_of(straight(0.0, 0.5, 0.0))
    )

    lines = comparison_table(found).splitlines()

    assert [cell.strip() for cell in lines[0].split("|")] == ["", "metric", "value", "unit", ""]
    cells = {line.split("|")[1].strip(): line.split("|")[2].strip() for line in lines[2:]}
    assert cells["FD"] == "0.25"
    assert cells["FDR, of the path (the paper's text)"] == "25"
    assert cells["GPE"] == "0.25"
    assert "FDR, of the chord (its code)" not in cells
    assert "GLE" not in cells


def test_csv_holds_one_line_per_scan(tmp_path):
    """Numbers come back with every digit; what is missing is empty."""
    rows = [comparison_row(comparison) for comparison in three_comparisons()]

    write_csv(rows, tmp_path / "result.csv")

    with (tmp_path / "result.csv").open(newline="") as file:
        found = list(csv.DictReader(file))
    assert [float(row["final_drift_mm"]) for row in found] == [r["final_drift_mm"] for r in rows]
    assert [row["subject"] for row in found] == ["P1", "P1", "P2"]
    assert found[0]["global_landmark_error_mm"] == ""
    assert set(found[0]) == set(rows[0])


def test_means_over_subjects():
    """Both scans of a subject are drawn together: three scans, two independent values."""
    found = summarize(three_comparisons())["final_drift_mm"]

    assert found.mean == pytest.approx(1.5)
    # Of two subjects a quarter of the draws takes one twice: means 0.75 and 3.
    assert (found.low, found.high) == pytest.approx((0.75, 3))
    assert "frames" not in summarize(three_comparisons())


def test_the_papers_table():
    """One row per method with mean and interval, in the paper's columns."""
    lines = paper_table(three_comparisons()).splitlines()

    assert len(lines) == 3
    header = [cell.strip() for cell in lines[0].split(" | ")]
    assert header[2:6] == ["rAE", "aAE", "rFE (mm)", "aFE (mm)"]
    assert lines[2].startswith("| made\\|up |     3 |")
    assert "1.5 [0.75, 3]" in lines[2]
    assert len({line.replace("\\|", "").count("|") for line in lines}) == 1


def test_markdown_by_hand():
    """Numbers stand at the right, words at the left, and what is missing is a dash."""
    table = markdown_table(
        [{"name": "a", "x": 1234.5678}, {"name": "bcd", "x": 0.00012345, "y": None}]
    )

    assert table == (
        "| name |        x |   y |\n"
        "| ---- | -------: | --: |\n"
        "| a    |     1235 |   - |\n"
        "| bcd  | 0.000123 |   - |\n"
    )


def test_tables_of_nothing(tmp_path):
    """A table without rows is refused and leaves no file."""
    with pytest.raises(ScanError, match="needs a row"):
        markdown_table([])
    with pytest.raises(ScanError, match="needs a row"):
        write_csv([], tmp_path / "none.csv")
    with pytest.raises(ScanError, match="no scan"):
        write_json([], tmp_path / "none.json")
    assert not list(tmp_path.iterdir())


def test_a_folder_that_cannot_be_written(tmp_path):
    """A file where a folder should be is one sentence."""
    (tmp_path / "file").write_text("")

    with pytest.raises(FormatError, match="cannot write"):
        write_csv([{"a": 1}], tmp_path / "file" / "result.csv")


def test_liver_sweep_at_half_its_frames(recordings):
    """Every second tracked pose, interpolated, stays within a millimetre of the tracker."""
    with h5py.File(recordings / "imfusion_liver_sweep" / "liver_sweep.h5") as file:
        tracked = torch.from_numpy(file["image_to_world_mm"][:])
        times = torch.from_numpy(file["timestamps_s"][:])
        width, height = file["spacing_mm"][:].tolist()
        scan = Scan(
            "liver",
            file["images"][:, :64, :64],
            Calibration((width, height)),
            times,
            tracked,
        )
    half = interpolate_poses(times[::2], tracked[::2], times)

    found = compare_trajectories(Trajectory(half), scan)

    assert found.metrics.maximum_drift_mm < 1
    # The sweep's README: a path of 78 mm.
    assert found.metrics.path_length_mm == pytest.approx(78, abs=8)
