"""The TUS-REC sets: layouts, pixels counted from 1, poses of the tracked tool."""

from dataclasses import replace
from itertools import pairwise

import h5py
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from sonosweep.errors import FormatError, ScanError
from sonosweep.geometry import rotation_from_euler, steps_from_poses, transform_points
from sonosweep.io.tusrec import (
    is_tusrec,
    list_tusrec,
    read_tusrec,
    read_tusrec_calibration,
    read_tusrec_landmarks,
    write_tusrec,
)
from sonosweep.scan import Calibration, Scan, pixel_to_image

from ..strategies import scans
from .damage import LARGEST_RESIDENT_MB, assert_reads_or_explains, damaged, resident_mb_after

ROUND_OFF_MM = 1e-9  # float64 on coordinates below 1 m
FLOAT32_MM = 1e-4  # poses are stored with 24 bits; coordinates below 1 m, and a rotation's lever
TITLES = (
    "scaling_from_pixel_to_mm",
    "spatial_calibration_from_image_coordinate_system_to_tracking_tool_coordinate_system",
)
S = np.diag([0.23, 0.22, 1.0, 1.0])
C = np.array([[0.0, -1, 0, -70], [-1, 0, 0, -80], [0, 0, -1, -46], [0, 0, 0, 1]])


def tool_poses(count: int) -> np.ndarray:
    """Rigid poses of the tool as the files hold them, float32."""
    turn = torch.zeros(count, 3, dtype=torch.float64)
    turn[:, 1] = torch.linspace(0.2, 0.4, count)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = rotation_from_euler(turn, "ZYX")
    poses[:, :3, 3] = np.linspace([100, -50, 30], [110, -45, 90], count)
    return poses.astype(np.float32)


def write_table(path) -> None:
    """The calibration table, in the exact form of the data set."""
    lines = []
    for title, matrix in zip(TITLES, (S, C), strict=True):
        lines += [title, *(",".join(map(str, row)) for row in matrix.tolist())]
    path.write_bytes(("\r\n".join(lines) + "\r\n").encode())


def write_scan_file(path, **parts) -> None:
    """An HDF5 file of these data sets."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        for name, value in parts.items():
            file[name] = value


@pytest.fixture
def training(tmp_path):
    """The training layout of both years, with one scan and its landmarks."""
    frames = np.arange(5 * 6 * 8, dtype=np.uint8).reshape(5, 6, 8)
    scan = tmp_path / "data" / "frames_transfs" / "000" / "LH_Par_C_DtP.h5"
    write_scan_file(scan, frames=frames, tforms=tool_poses(5))
    write_scan_file(
        tmp_path / "data" / "landmarks" / "landmark_000.h5",
        LH_Par_C_DtP=np.array([[0, 1, 1], [4, 8, 6]]),
    )
    write_table(tmp_path / "data" / "calib_matrix.csv")
    return scan


@pytest.fixture
def validation(tmp_path):
    """The layout of the validation and test sets: frames and poses in two files."""
    frames = np.zeros((5, 6, 8), np.uint8)
    write_scan_file(tmp_path / "val" / "transfs" / "050" / "RH_rotation.h5", tforms=tool_poses(5))
    write_scan_file(
        tmp_path / "val" / "landmark" / "landmark_050.h5", RH_rotation=np.array([[2, 3, 4]])
    )
    write_scan_file(tmp_path / "val" / "dataset_keys.h5", sub050__RH_rotation=np.zeros(1))
    write_table(tmp_path / "val" / "calib_matrix.csv")
    scan = tmp_path / "val" / "frames" / "050" / "RH_rotation.h5"
    write_scan_file(scan, frames=frames)
    return scan


def test_a_pixel_lands_where_the_data_set_says(training):
    """Pixel (column, row) from 1 lies at T C S (column, row, 0, 1), by hand."""
    scan = read_tusrec(training)

    column, row, frame = 7, 3, 4
    by_hand = tool_poses(5)[frame].astype(np.float64) @ C @ S @ [column, row, 0, 1]
    ours = pixel_to_image(scan.calibration) @ torch.tensor([column - 1, row - 1, 0, 1]).double()
    landed = transform_points(scan.image_to_reference[frame], ours[None, :3])[0]
    np.testing.assert_allclose(landed, by_hand[:3], atol=FLOAT32_MM, rtol=0)


def test_the_published_table_places_the_first_pixel(recordings):
    """With the real table, pixel (1, 1) is at C S (1, 1, 0, 1) and the spacing is S's."""
    calibration = read_tusrec_calibration(recordings / "tusrec" / "calib_matrix.csv")

    scaled = torch.tensor([0.229389190673828, 0.220979690551758, 0.0], dtype=torch.float64)
    rotation = torch.tensor(
        [
            [0.231064671309448, -0.218052035041340, 0.948189025293473],
            [-0.190847036221471, -0.965787272832032, -0.175591436013112],
            [0.954036962825936, -0.140386087807861, -0.264773903381482],
        ],
        dtype=torch.float64,
    )
    shift = torch.tensor(
        [-70.7413291931152, -80.6505661010742, -46.1766223907471], dtype=torch.float64
    )
    expected = rotation @ scaled + shift
    torch.testing.assert_close(
        calibration.image_to_probe[:3, 3], expected, atol=ROUND_OFF_MM, rtol=0
    )
    assert calibration.spacing_mm == pytest.approx((0.229389, 0.220980), abs=1e-5)
    assert (calibration.pixel_axes, calibration.pixel_origin) == ("column_row", 1)


def test_the_label_between_two_frames_is_the_challenge_s(training):
    """A step is inv(C) inv(T0) T1 C in mm, up to where the image has its origin."""
    scan = read_tusrec(training)

    poses = tool_poses(5).astype(np.float64)
    first_pixel = np.eye(4)
    first_pixel[:2, 3] = 0.23, 0.22
    to_tool = C @ first_pixel
    for step, (this, following) in zip(
        steps_from_poses(scan.image_to_reference), pairwise(poses), strict=True
    ):
        label = np.linalg.inv(this @ to_tool) @ following @ to_tool
        np.testing.assert_allclose(step, label, atol=FLOAT32_MM, rtol=0)


def test_scan_facts(training):
    """The subject is the folder; there are no times, and the notes say why."""
    scan = read_tusrec(training)

    assert (scan.name, scan.subject, scan.timestamps_s) == ("LH_Par_C_DtP", "000", None)
    assert "20 frames/s" in scan.notes["time"]
    assert scan.frames[4][5, 7] == 239


def test_validation_poses_come_from_the_other_folder(validation):
    """Frames and poses of the same scan meet again."""
    scan = read_tusrec(validation)

    assert scan.subject == "050"
    assert scan.image_to_reference.shape == (5, 4, 4)


def test_landmarks_count_from_0(training, validation):
    """Stored (frame from 0, column from 1, row from 1) become indices of our arrays."""
    assert read_tusrec_landmarks(training).tolist() == [[0, 0, 0], [4, 7, 5]]
    assert read_tusrec_landmarks(validation).tolist() == [[2, 2, 3]]


def test_all_scans_below_a_folder_are_found(tmp_path, training, validation):
    """Poses, landmarks and keys are no scans."""
    assert list_tusrec(tmp_path) == [training, validation]
    assert not is_tusrec(tmp_path / "val" / "dataset_keys.h5")
    with pytest.raises(FormatError, match="no TUS-REC scan"):
        list_tusrec(tmp_path / "data" / "landmarks")


def test_without_calibration_the_frames_still_open(training):
    """A sensorless run needs no poses; the notes say why there are none."""
    (training.parents[2] / "calib_matrix.csv").unlink()

    scan = read_tusrec(training)

    assert scan.calibration is scan.image_to_reference is None
    assert "calib_matrix.csv" in scan.notes["poses"]


@given(scans())
def test_a_written_scan_reads_back(tmp_path_factory, scan):
    """Poses return to float32 precision, pixels and calibration exactly."""
    scan = replace(scan, subject="012", name="RH_Per_S_PtD")
    folder = tmp_path_factory.mktemp("written")

    again = read_tusrec(write_tusrec(scan, folder))

    assert list_tusrec(folder)[0].relative_to(folder).as_posix() == (
        "frames_transfs/012/RH_Per_S_PtD.h5"
    )
    torch.testing.assert_close(
        again.image_to_reference, scan.image_to_reference, atol=5 * FLOAT32_MM, rtol=0
    )
    torch.testing.assert_close(
        again.calibration.image_to_probe, scan.calibration.image_to_probe, atol=ROUND_OFF_MM, rtol=0
    )
    assert again.calibration.spacing_mm == pytest.approx(scan.calibration.spacing_mm, abs=1e-12)
    np.testing.assert_array_equal(again.frames[:], scan.frames)


def test_a_second_calibration_in_one_folder_is_refused(tmp_path):
    """One table holds for all scans of a folder."""
    poses = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    frames = np.zeros((2, 3, 4), np.uint8)
    one = Scan("a", frames, Calibration((0.1, 0.2)), image_to_reference=poses)
    write_tusrec(one, tmp_path)
    write_tusrec(replace(one, name="b"), tmp_path)

    with pytest.raises(FormatError, match="calibration of other scans"):
        write_tusrec(replace(one, calibration=Calibration((0.1, 0.3))), tmp_path)
    with pytest.raises(FormatError, match="valid pose for each frame"):
        write_tusrec(replace(one, image_to_reference=None), tmp_path)
    with pytest.raises(FormatError, match="8-bit gray"):
        write_tusrec(replace(one, frames=frames.astype(np.uint16)), tmp_path)
    with pytest.raises(FormatError, match="cannot be the name"):
        write_tusrec(replace(one, name="../c"), tmp_path)


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"tforms": tool_poses(4)}, "5 frames but 4 'tforms'"),
        ({"tforms": tool_poses(5) * 2}, "the pose of frame 0"),
        ({"tforms": np.full((5, 4, 4), np.nan, np.float32)}, "the pose of frame 0"),
        ({"tforms": np.zeros((5, 16), np.float32)}, "must have the shape any x 4 x 4"),
        ({"frames": np.zeros((0, 6, 8), np.uint8)}, "holds no pixels"),
    ],
)
def test_contradictions_are_said(training, parts, message):
    """Counts that differ and poses that are none are refused in one sentence."""
    whole = {"frames": np.zeros((5, 6, 8), np.uint8), "tforms": tool_poses(5)}
    write_scan_file(training, **{**whole, **parts})

    with pytest.raises((FormatError, ScanError), match=message):
        read_tusrec(training)


def test_the_other_set_s_table_is_not_mistaken(recordings, tmp_path):
    """A headerless table counts pixels another way and is refused."""
    with pytest.raises(FormatError, match="Zenodo 7740734"):
        read_tusrec_calibration(recordings / "tusrec" / "calib_matrix_zenodo7740734.csv")
    (tmp_path / "calib_matrix.csv").write_text(f"{TITLES[0]}\n1,0,0\n")
    with pytest.raises(FormatError, match="4 x 4 each"):
        read_tusrec_calibration(tmp_path / "calib_matrix.csv")


def test_opening_a_long_scan_needs_little_memory(tmp_path):
    """4 GB of frames stay in the file."""
    path = tmp_path / "long.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset("frames", (14000, 480, 640), np.uint8)
        file["tforms"] = np.tile(np.eye(4, dtype=np.float32), (14000, 1, 1))
    write_table(tmp_path / "calib_matrix.csv")

    used = resident_mb_after(
        "from sonosweep.io.tusrec import read_tusrec\n"
        "scan = read_tusrec(path)\n"
        "assert len(scan.frames) == 14000 and not scan.frames[13000:13010].any()",
        path,
    )

    assert used < LARGEST_RESIDENT_MB


@given(data=st.data(), which=st.sampled_from(["scan", "table"]))
def test_damaged_files_are_explained(tmp_path_factory, data, which):
    """Bytes lost or changed in scan or calibration give frames or a sentence."""
    folder = tmp_path_factory.mktemp("damaged")
    scan, table = folder / "scan.h5", folder / "calib_matrix.csv"
    write_scan_file(scan, frames=np.zeros((2, 3, 4), np.uint8), tforms=tool_poses(2))
    write_table(table)
    path = scan if which == "scan" else table
    path.write_bytes(data.draw(damaged(path.read_bytes())))

    assert_reads_or_explains(lambda: read_tusrec(scan))
