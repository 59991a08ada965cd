"""The files of the released MoGLo-Net code: cm, degrees, rows first, sensor poses."""

import h5py
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from sonosweep.errors import FormatError, ScanError
from sonosweep.geometry import moglo_from_step, steps_from_poses, transform_points
from sonosweep.io.moglo import is_moglo, read_moglo

from ..strategies import sweeps
from .damage import LARGEST_RESIDENT_MB, assert_reads_or_explains, damaged, resident_mb_after

FLOAT32_MM = 1e-4  # six numbers of 24 bits, some steps, coordinates below 0.3 m
FRAMES = 6


def write_moglo(path, sensor_poses, dtype=np.float32, **changes):
    """A file of this layout for known poses of the sensor."""
    count = len(sensor_poses)
    parts = {
        "img_B": np.random.default_rng(0).integers(0, 256, (count, 1, 8, 8)).astype(dtype),
        "y_rel": moglo_from_step(steps_from_poses(sensor_poses)).numpy().astype(np.float32),
        "y_abs": moglo_from_step(sensor_poses).numpy().astype(np.float32),
        **changes,
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        for name, value in parts.items():
            if value is not None:
                file[name] = value


def straight_sweep():
    """A sensor that moves 0.3 mm out of plane per frame, to our +z."""
    poses = torch.eye(4, dtype=torch.float64).repeat(FRAMES, 1, 1)
    poses[:, 2, 3] = torch.arange(FRAMES) * 0.3
    return poses


def test_centimeters_rows_first_become_millimeters_columns_first(tmp_path):
    """0.1 cm along their first axis (rows) is 1 mm along our second (axial)."""
    motion = np.zeros((1, 6), np.float32)
    motion[0, :3] = 0.1, 0.02, -0.03
    write_moglo(tmp_path / "scan.h5", straight_sweep()[:2], y_rel=motion, y_abs=None)

    scan = read_moglo(tmp_path / "scan.h5")

    expected = torch.tensor([0.2, 1.0, 0.3]).double()
    torch.testing.assert_close(scan.image_to_reference[1, :3, 3], expected, atol=FLOAT32_MM, rtol=0)


@given(sweeps(FRAMES, largest_turn_rad=0.05))
def test_chained_motion_leads_to_the_absolute_poses(tmp_path_factory, sweep):
    """With y_rel and y_abs of one sweep, the poses are the sensor's and nothing is noted."""
    path = tmp_path_factory.mktemp("moglo") / "scan.h5"
    write_moglo(path, sweep)

    scan = read_moglo(path)

    torch.testing.assert_close(scan.image_to_reference, sweep, atol=10 * FLOAT32_MM, rtol=0)
    assert "poses" not in scan.notes


def test_the_hidden_offset_places_the_image_on_request(tmp_path):
    """Their grid point (row, column, out) - (20, 0, 7) mm is ours at (column, row - 20, 7)."""
    write_moglo(tmp_path / "scan.h5", straight_sweep())

    plain = read_moglo(tmp_path / "scan.h5")
    moved = read_moglo(tmp_path / "scan.h5", sensor_offset=True)

    point = torch.tensor([[3.0, 5.0, 0.0]], dtype=torch.float64)
    here = transform_points(plain.image_to_reference[0], point)[0]
    there = transform_points(moved.image_to_reference[0], point)[0]
    assert plain.calibration.image_to_probe is None
    assert (there - here).tolist() == [0.0, -20.0, 7.0]


def test_scan_facts(tmp_path):
    """Pixels are 38/256 mm, the channel axis is gone, the subject is the folder."""
    write_moglo(tmp_path / "001" / "LH_uS1_an31.h5", straight_sweep())

    scan = read_moglo(tmp_path / "001" / "LH_uS1_an31.h5")

    assert is_moglo(tmp_path / "001" / "LH_uS1_an31.h5")
    assert scan.calibration.spacing_mm == (38 / 256, 38 / 256)
    assert scan.frames.shape == (FRAMES, 8, 8)
    assert (scan.name, scan.subject) == ("LH_uS1_an31", "001")


def test_labels_that_disagree_are_noted(tmp_path):
    """When y_abs leads elsewhere than y_rel, the notes say how far and where."""
    elsewhere = moglo_from_step(straight_sweep()).numpy()
    elsewhere[3, 0] += 0.25
    write_moglo(tmp_path / "scan.h5", straight_sweep(), y_abs=elsewhere)

    note = read_moglo(tmp_path / "scan.h5").notes["poses"]

    assert "2.5 mm" in note
    assert "frame 3" in note


def test_poses_come_from_what_is_there(tmp_path):
    """Only y_abs is enough; neither leaves a scan without poses that says why."""
    write_moglo(tmp_path / "a.h5", straight_sweep(), y_rel=None)
    write_moglo(tmp_path / "b.h5", straight_sweep(), y_rel=None, y_abs=None)

    poses = read_moglo(tmp_path / "a.h5").image_to_reference
    bare = read_moglo(tmp_path / "b.h5")

    torch.testing.assert_close(poses, straight_sweep(), atol=FLOAT32_MM, rtol=0)
    assert bare.image_to_reference is None
    assert "neither" in bare.notes["poses"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"y_rel": np.zeros((FRAMES, 6))}, "6 frames need 5 motions"),
        ({"y_rel": np.zeros((FRAMES - 1, 7))}, "must have the shape any x 6"),
        ({"y_abs": np.zeros((FRAMES - 1, 6))}, "6 frames but 5 'y_abs'"),
        ({"y_rel": np.full((FRAMES - 1, 6), np.nan)}, "the pose of frame 1"),
        ({"img_B": np.zeros((FRAMES, 2, 8, 8))}, "1, 3 or 4 channels"),
        ({"img_B": np.zeros((FRAMES, 64))}, "must hold frames of numbers"),
    ],
)
def test_contradictions_are_said(tmp_path, changes, message):
    """Counts that differ and NaN motion are refused in one sentence."""
    write_moglo(tmp_path / "scan.h5", straight_sweep(), **changes)

    with pytest.raises((FormatError, ScanError), match=message):
        read_moglo(tmp_path / "scan.h5")


def test_opening_a_long_scan_needs_little_memory(tmp_path):
    """4 GB of float frames stay in the file."""
    with h5py.File(tmp_path / "long.h5", "w") as file:
        file.create_dataset("img_B", (16384, 1, 256, 256), np.float32)

    used = resident_mb_after(
        "from sonosweep.io.moglo import read_moglo\n"
        "assert not read_moglo(path).frames[16000:16010].any()",
        tmp_path / "long.h5",
    )

    assert used < LARGEST_RESIDENT_MB


@given(data=st.data())
def test_damaged_files_are_explained(tmp_path_factory, data):
    """Bytes lost or changed anywhere give frames or a sentence, nothing else."""
    path = tmp_path_factory.mktemp("damaged") / "scan.h5"
    write_moglo(path, straight_sweep())
    path.write_bytes(data.draw(damaged(path.read_bytes())))

    assert_reads_or_explains(lambda: read_moglo(path))
