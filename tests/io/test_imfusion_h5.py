"""Sweeps whose image origin is the centre of the image."""

import h5py
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from sonosweep.errors import FormatError, ScanError
from sonosweep.geometry import transform_points
from sonosweep.io.imfusion_h5 import is_imfusion_h5, read_imfusion_h5

from .damage import assert_one_sentence, assert_reads_or_explains, damaged

ROUND_OFF_MM = 1e-9  # float64 on coordinates below 1 m


def write_example(path, **changes):
    """A file of 3 frames, 6 rows by 9 columns, each 2 mm beyond the one before."""
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 2, 3] = [0, 2, 4]
    parts = {
        "images": np.arange(3 * 6 * 9, dtype=np.uint8).reshape(3, 6, 9),
        "image_to_world_mm": poses,
        "timestamps_s": np.array([1e9, 1e9 + 0.04, 1e9 + 0.08]),
        "spacing_mm": np.array([0.5, 0.25]),
        **changes,
    }
    with h5py.File(path, "w") as file:
        for name, value in parts.items():
            if value is not None:
                file[name] = value


def test_the_center_of_the_image_is_the_origin_of_its_pose(tmp_path):
    """With an identity pose, the first of 9 x 6 pixels lies at (-4 * 0.5, -2.5 * 0.25) mm."""
    write_example(tmp_path / "sweep.h5")

    scan = read_imfusion_h5(tmp_path / "sweep.h5")

    assert scan.image_to_reference[0, :3, 3].tolist() == [-2.0, -0.625, 0.0]
    assert scan.image_to_reference[2, :3, 3].tolist() == [-2.0, -0.625, 4.0]
    assert scan.calibration.spacing_mm == (0.5, 0.25)
    assert scan.frames[1][0, 0] == 54


def test_the_real_liver_sweep_reads(recordings):
    """140 frames; a pixel lands where the file's own rule puts it."""
    path = recordings / "imfusion_liver_sweep" / "liver_sweep.h5"

    scan = read_imfusion_h5(path)

    assert is_imfusion_h5(path)
    assert scan.frames.shape == (140, 593, 739)
    with h5py.File(path) as file:
        spacing, pose = file["spacing_mm"][:], file["image_to_world_mm"][77]
        assert (scan.frames[77] == file["images"][77]).all()
    column, row = 100, 500
    centered = [(column - 369) * spacing[0], (row - 296) * spacing[1], 0, 1]
    point = torch.tensor([[column * spacing[0], row * spacing[1], 0.0]], dtype=torch.float64)
    landed = transform_points(scan.image_to_reference[77], point)[0]
    np.testing.assert_allclose(landed, (pose @ centered)[:3], atol=ROUND_OFF_MM, rtol=0)


@pytest.mark.parametrize(
    "changes",
    [
        {"image_to_world_mm": np.full((3, 4, 4), np.nan)},
        {"image_to_world_mm": np.tile(np.eye(4), (2, 1, 1))},
        {"image_to_world_mm": np.tile(np.diag([2.0, 2, 2, 1]), (3, 1, 1))},
        {"spacing_mm": np.zeros(2)},
        {"spacing_mm": np.array([0.1, np.nan])},
        {"spacing_mm": np.ones(3)},
        {"timestamps_s": np.zeros(3)},
        {"images": np.zeros((3, 6, 9), complex)},
        {"images": None},
    ],
)
def test_contradictions_are_one_sentence(tmp_path, changes):
    """Zero spacing, poses that scale, counts that differ: each is refused."""
    write_example(tmp_path / "sweep.h5", **changes)

    with pytest.raises((FormatError, ScanError)) as caught:
        read_imfusion_h5(tmp_path / "sweep.h5")

    assert_one_sentence(caught.value)


@given(data=st.data())
def test_damaged_files_are_explained(tmp_path_factory, data):
    """Bytes lost or changed anywhere give frames or a sentence, nothing else."""
    path = tmp_path_factory.mktemp("damaged") / "sweep.h5"
    write_example(path)
    path.write_bytes(data.draw(damaged(path.read_bytes())))

    assert_reads_or_explains(lambda: read_imfusion_h5(path))
