"""Zenodo 7740734: late transforms, invalid ones, and pixels written (row, column)."""

import h5py
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from sonosweep.errors import FormatError
from sonosweep.geometry import transform_points
from sonosweep.io import open_scan
from sonosweep.io.zenodo7740734 import read_zenodo7740734, read_zenodo_calibration
from sonosweep.io.zenodo7740734_h5 import is_zenodo7740734_h5, read_zenodo7740734_h5
from sonosweep.scan import pixel_to_image

from .damage import assert_one_sentence, assert_reads_or_explains, damaged

ROUND_OFF_MM = 1e-9  # float64 on coordinates below 1 m
S = np.diag([0.25, 0.5, 1.0, 1.0])  # mm per row, mm per column
C = np.array([[0.0, 0, -1, -67], [-1, 0, 0, -79], [0, 1, 0, -49], [0, 0, 0, 1]])


def write_table(path):
    """A headerless table: scaling above, image to probe below."""
    rows = np.concatenate([S, C]).tolist()
    path.write_text("\n".join(",".join(map(str, row)) for row in rows))


def probe_pose(frame: int) -> np.ndarray:
    """Where the probe was by the transform stored at this frame."""
    pose = np.eye(4)
    pose[:3, 3] = 10, 20, frame
    return pose


def write_mha(path, count=12, invalid=()):
    """A PLUS sequence whose frame k is filled with k and stamped k / 20 s."""
    lines = [
        "ObjectType = Image",
        "NDims = 3",
        "BinaryData = True",
        "BinaryDataByteOrderMSB = False",
        "CompressedData = False",
        f"DimSize = 8 6 {count}",
        "ElementSpacing = 1 1 1",
        "ElementType = MET_UCHAR",
        "UltrasoundImageOrientation = MF",
        "UltrasoundImageType = BRIGHTNESS",
    ]
    for k in range(count):
        numbers = " ".join(map(str, probe_pose(k).flatten().tolist()))
        status = "INVALID" if k in invalid else "OK"
        lines += [
            f"Seq_Frame{k:04d}_ProbeToTrackerTransform = {numbers}",
            f"Seq_Frame{k:04d}_ProbeToTrackerTransformStatus = {status}",
            f"Seq_Frame{k:04d}_Timestamp = {k / 20}",
            f"Seq_Frame{k:04d}_ImageStatus = OK",
        ]
    lines.append("ElementDataFile = LOCAL\n")
    pixels = np.repeat(np.arange(count, dtype=np.uint8), 6 * 8)
    path.write_bytes("\n".join(lines).encode() + pixels.tobytes())


@pytest.fixture
def subject(tmp_path):
    """A subject's folder with two sweeps and the calibration beside the data."""
    folder = tmp_path / "003"
    folder.mkdir()
    write_mha(folder / "sweep_2.mha")
    write_mha(folder / "sweep_10.mha", invalid=(6,))
    write_table(tmp_path / "calib_matrix.csv")
    return folder


def test_a_pixel_lands_where_the_data_set_says(subject):
    """Pixel (row, column) from 0 of image k lies at T[k+4] C S (row, column, 0, 1)."""
    scan = read_zenodo7740734(subject / "sweep_2.mha", subject.parent / "calib_matrix.csv")

    row, column, frame = 5, 2, 3
    by_hand = probe_pose(frame + 4) @ C @ S @ [row, column, 0, 1]
    ours = pixel_to_image(scan.calibration) @ torch.tensor([column, row, 0, 1]).double()
    landed = transform_points(scan.image_to_reference[frame], ours[None, :3])[0]
    assert scan.frames[frame][row, column] == frame
    assert scan.calibration.spacing_mm == pytest.approx((0.5, 0.25))
    np.testing.assert_allclose(landed, by_hand[:3], atol=ROUND_OFF_MM, rtol=0)


def test_the_published_table_is_row_first(recordings):
    """With the real table, row 100, column 10 lands where C S (100, 10, 0, 1) does."""
    path = recordings / "tusrec" / "calib_matrix_zenodo7740734.csv"
    numbers = np.loadtxt(path, delimiter=",")

    calibration = read_zenodo_calibration(path)

    by_hand = numbers[4:] @ numbers[:4] @ [100, 10, 0, 1]
    ours = pixel_to_image(calibration) @ torch.tensor([10, 100, 0, 1]).double()
    landed = calibration.image_to_probe @ ours
    np.testing.assert_allclose(landed, by_hand, atol=ROUND_OFF_MM, rtol=0)
    assert calibration.spacing_mm == pytest.approx((0.23554, 0.22447), abs=1e-3)
    assert (calibration.pixel_axes, calibration.pixel_origin) == ("row_column", 0)
    swapped = numbers[4:] @ numbers[:4] @ [10, 100, 0, 1]
    assert np.abs(landed.numpy() - swapped).max() > 1  # mm: the trap is not a small one


def test_late_and_invalid_transforms_leave_frames_out(subject):
    """12 frames lose 4 to the delay, and the one whose transform is invalid."""
    scan = read_zenodo7740734(subject / "sweep_10.mha", subject.parent / "calib_matrix.csv")

    kept = [0, 1, 3, 4, 5, 6, 7]
    assert [int(frame[0, 0]) for frame in scan.frames[:]] == kept
    np.testing.assert_allclose(scan.timestamps_s, np.array(kept) / 20)
    in_probe = scan.image_to_reference @ torch.linalg.inv(scan.calibration.image_to_probe)
    np.testing.assert_allclose(in_probe[:, 2, 3], np.array(kept) + 4)
    assert scan.notes["frames"].startswith("5 frames")
    assert scan.subject == "003"


def test_the_folder_s_csv_says_which_frames_to_use(subject):
    """Row i belongs to the i-th sweep by number (2 before 10); end is excluded."""
    (subject / "valid.csv").write_text("scan,start,end\na,2,5\nb,1,20\n")
    table = subject.parent / "calib_matrix.csv"

    first = read_zenodo7740734(subject / "sweep_2.mha", table)
    second = read_zenodo7740734(subject / "sweep_10.mha", table)
    given_by_hand = read_zenodo7740734(subject / "sweep_2.mha", table, frames_used=(0, 2))

    assert [int(frame[0, 0]) for frame in first.frames[:]] == [2, 3, 4]
    assert [int(frame[0, 0]) for frame in second.frames[:]] == [1, 3, 4, 5, 6, 7]
    assert len(given_by_hand.frames) == 2


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("start,end\n1,2\n", "2 or more rows"),
        ("from,to\n1,2\n1,2\n", "columns start and end"),
        ("start,end\n1,2\n1.5,2\n", "whole numbers"),
        ("start,end\n1,2\n1\n", "1 values instead of 2"),
        ("start,end\n1,2\n5,5\n", "are none"),
        ("start,end\n1,2\n50,60\n", "no frame of 'sweep_10.mha'"),
        ("start,end\n1,2\nx,60\n", "'x' is not a number"),
    ],
)
def test_a_wrong_csv_is_said(subject, text, message):
    """A table that does not fit the sweeps is refused in one sentence."""
    (subject / "valid.csv").write_text(text)

    with pytest.raises(FormatError, match=message) as caught:
        read_zenodo7740734(subject / "sweep_10.mha", subject.parent / "calib_matrix.csv")

    assert_one_sentence(caught.value)


def test_the_other_set_s_table_is_not_mistaken(recordings, tmp_path):
    """A table with titles counts pixels another way and is refused."""
    with pytest.raises(FormatError, match="TUS-REC"):
        read_zenodo_calibration(recordings / "tusrec" / "calib_matrix.csv")
    (tmp_path / "short.csv").write_text("1,2,3,4\n")
    with pytest.raises(FormatError, match="8 rows of 4 numbers"):
        read_zenodo_calibration(tmp_path / "short.csv")


def write_small(path, count=3, **changes):
    """A file as the published code makes it, one subject and one sweep."""
    parts = {
        "num_frames": np.array([[count]], np.uint16),
        "sub_folders": ["007"],
        "frame_size": np.array([6, 8]),
    }
    for k in range(count):
        parts[f"sub000_scan00_frame{k:04d}"] = np.full((6, 8), k, np.uint8)
        parts[f"sub000_scan00_tform{k:04d}"] = probe_pose(k).astype(np.float32)
    with h5py.File(path, "w") as file:
        for name, value in {**parts, **changes}.items():
            if value is not None:
                file[name] = value


def test_a_small_pixel_is_the_mean_of_sixteen(tmp_path):
    """Small pixel (row 2, column 5) is centred on full-size pixel (9.5, 21.5)."""
    write_small(tmp_path / "frames_res4.h5")
    write_table(tmp_path / "calib_matrix.csv")

    scan = read_zenodo7740734_h5(tmp_path / "frames_res4.h5")

    by_hand = probe_pose(1) @ C @ S @ [2 * 4 + 1.5, 5 * 4 + 1.5, 0, 1]
    ours = pixel_to_image(scan.calibration) @ torch.tensor([5, 2, 0, 1]).double()
    landed = transform_points(scan.image_to_reference[1], ours[None, :3])[0]
    np.testing.assert_allclose(landed, by_hand[:3], atol=ROUND_OFF_MM, rtol=0)
    assert scan.frames[-1].tolist() == np.full((6, 8), 2).tolist()
    assert scan.frames[0:2].shape == (2, 6, 8)
    assert (scan.subject, scan.frames.dtype) == ("sub000", np.uint8)
    assert is_zenodo7740734_h5(tmp_path / "frames_res4.h5")
    with pytest.raises(IndexError):
        scan.frames[3]


def test_without_calibration_the_small_frames_still_open(tmp_path):
    """The frames are there; the notes say why there are no poses."""
    write_small(tmp_path / "frames_res4.h5")

    scan = read_zenodo7740734_h5(tmp_path / "frames_res4.h5")

    assert scan.calibration is scan.image_to_reference is None
    assert "calib_matrix.csv" in scan.notes["poses"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"num_frames": np.array([[0]])}, "has 0 frames"),
        ({"num_frames": np.array([[9]])}, "no data set 'sub000_scan00_tform0003'"),
        ({"num_frames": np.array([3])}, "must have the shape"),
        ({"sub000_scan00_frame0000": np.zeros(3)}, "are of shape"),
        ({"sub000_scan00_tform0001": np.zeros((3, 3))}, "must have the shape 4 x 4"),
    ],
)
def test_contradictions_in_the_small_file_are_said(tmp_path, changes, message):
    """Counts and shapes that do not fit are refused in one sentence."""
    write_small(tmp_path / "frames_res4.h5", **changes)

    with pytest.raises(FormatError, match=message):
        read_zenodo7740734_h5(tmp_path / "frames_res4.h5")


def test_a_sweep_that_is_not_there_is_said(tmp_path):
    """The message says how many there are."""
    write_small(tmp_path / "frames_res4.h5")

    with pytest.raises(FormatError, match="no sweep 1 of subject 0"):
        read_zenodo7740734_h5(tmp_path / "frames_res4.h5", sweep=1)


def test_a_sweep_is_chosen_by_its_name(tmp_path):
    """Of a file of two sweeps the second is read by name, and the first says that it is one."""
    path = tmp_path / "frames_res4.h5"
    write_small(
        path,
        num_frames=np.array([[3, 1]]),
        sub000_scan01_frame0000=np.full((6, 8), 77, np.uint8),
        sub000_scan01_tform0000=probe_pose(0).astype(np.float32),
    )

    assert open_scan(path).notes["sweeps"] == "this is sub000_scan00, one of 2 in the file"
    assert open_scan(path, variable="sub000_scan01").frames[0][0, 0] == 77
    with pytest.raises(FormatError, match="such as sub003_scan07"):
        open_scan(path, variable="scan01")


@given(data=st.data(), which=st.sampled_from(["sweep", "small", "table", "csv"]))
def test_damaged_files_are_explained(tmp_path_factory, data, which):
    """Bytes lost or changed in any of the files give frames or a sentence."""
    folder = tmp_path_factory.mktemp("damaged")
    paths = {
        "sweep": folder / "1.mha",
        "small": folder / "frames_res4.h5",
        "table": folder / "calib_matrix.csv",
        "csv": folder / "valid.csv",
    }
    write_mha(paths["sweep"])
    write_small(paths["small"])
    write_table(paths["table"])
    paths["csv"].write_text("start,end\n1,5\n")
    path = paths[which]
    path.write_bytes(data.draw(damaged(path.read_bytes())))

    assert_reads_or_explains(lambda: read_zenodo7740734(paths["sweep"], paths["table"]))
    assert_reads_or_explains(lambda: read_zenodo7740734_h5(paths["small"]))
