"""NIfTI as other programs write it, and headers that promise the impossible."""

import gzip
from pathlib import Path

import nibabel
import numpy as np
import pytest

from sonosweep.errors import FormatError
from sonosweep.io.nifti import read_nifti, write_nifti
from sonosweep.scan import Volume, VolumeGrid
from tests.io.volume_files import random_volume

FLOAT32_MM = 1e-4  # NIfTI-1 keeps its numbers in float32; positions below 200 mm


def test_sform_and_qform_say_the_same(tmp_path: Path):
    """Programs that prefer either find the volume at the same place, with the same code."""
    pose = np.eye(4)
    pose[:3, :3] = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]])
    pose[:3, 3] = (120.0, -80.0, 33.0)
    write_nifti(random_volume(np.random.default_rng(0), pose=pose), tmp_path / "v.nii")

    header = nibabel.Nifti1Image.from_filename(tmp_path / "v.nii").header

    assert header["sform_code"] == header["qform_code"] == 1
    np.testing.assert_allclose(header.get_sform(), header.get_qform(), atol=FLOAT32_MM)


def test_under_ras_nifti_coordinates_are_ours(tmp_path: Path):
    """NIfTI is RAS, so with ``world="ras"`` nibabel's affine is voxel to reference."""
    volume = Volume(
        np.zeros((4, 3, 2), np.uint8), VolumeGrid((2, 3, 4), (0.5, 1.0, 2.0), (7.0, 8.0, 9.0))
    )
    write_nifti(volume, tmp_path / "v.nii")

    affine = nibabel.Nifti1Image.from_filename(tmp_path / "v.nii").affine

    assert affine.tolist() == [[0.5, 0, 0, 7], [0, 1, 0, 8], [0, 0, 2, 9], [0, 0, 0, 1]]


def test_nifti_2_and_other_units_are_read(tmp_path: Path):
    """A NIfTI-2 file in metres is read in millimetres."""
    image = nibabel.Nifti2Image(np.arange(24, dtype=np.int16).reshape(2, 3, 4), np.eye(4) * 1e-3)
    image.header.set_xyzt_units("meter")
    image.to_filename(tmp_path / "v.nii")

    volume = read_nifti(tmp_path / "v.nii")

    assert volume.grid.spacing_mm == pytest.approx((1, 1, 1))
    assert volume.voxels[3, 2, 1] == 23


def test_scaled_voxels_come_as_real_numbers(tmp_path: Path):
    """A slope and an intercept in the header are applied."""
    image = nibabel.Nifti1Image(np.arange(8, dtype=np.int16).reshape(2, 2, 2), np.eye(4))
    image.header.set_slope_inter(0.5, 10)
    image.to_filename(tmp_path / "v.nii")
    raw = bytearray((tmp_path / "v.nii").read_bytes())
    raw[112:120] = np.array([0.5, 10], "<f4").tobytes()
    (tmp_path / "v.nii").write_bytes(raw)

    volume = read_nifti(tmp_path / "v.nii")

    assert volume.voxels.dtype == np.float32
    assert volume.voxels[0, 0, 0] == 10
    assert np.ptp(volume.voxels) == pytest.approx(3.5)


def test_left_handed_affines_of_others_keep_every_voxel_in_place(tmp_path: Path):
    """Radiological storage (x to the left) is the usual NIfTI of hospitals."""
    values = np.arange(24, dtype=np.uint8).reshape(2, 3, 4)
    affine = np.diag([-1.0, 1.0, 1.0, 1.0])
    nibabel.Nifti1Image(values, affine).to_filename(tmp_path / "v.nii")

    volume = read_nifti(tmp_path / "v.nii")

    # Voxel (1, 2, 3) holds 23 and lies at (-1, 2, 3); slices are counted from the other end.
    assert volume.voxels[0, 2, 1] == 23
    matrix = np.asarray(volume.grid.direction) * volume.grid.spacing_mm
    assert (matrix @ (1, 2, 0) + volume.grid.origin_mm).tolist() == pytest.approx([-1, 2, 3])


@pytest.mark.parametrize("suffix", [".nii", ".nii.gz"])
def test_a_terabyte_in_the_header_is_refused(tmp_path: Path, suffix: str):
    """30000 x 30000 x 30000 voxels in a file of a few hundred bytes give one sentence."""
    path = tmp_path / f"v{suffix}"
    write_nifti(random_volume(np.random.default_rng(1)), path)
    raw = bytearray(
        gzip.decompress(path.read_bytes()) if suffix == ".nii.gz" else path.read_bytes()
    )
    raw[42:48] = np.array([30000] * 3, "<i2").tobytes()
    path.write_bytes(gzip.compress(raw) if suffix == ".nii.gz" else raw)

    with pytest.raises(FormatError, match=r"27,000,000,000,000 bytes"):
        read_nifti(path)


def test_a_gzip_bomb_in_the_extensions_is_not_unpacked(tmp_path: Path):
    """Extensions past the first megabyte are not read, whatever length they state."""
    write_nifti(random_volume(np.random.default_rng(2)), tmp_path / "v.nii")
    raw = bytearray((tmp_path / "v.nii").read_bytes())
    raw[108:112] = np.array([1.9e9], "<f4").tobytes()
    raw[352:356] = np.array([1_900_000_000 // 16 * 16], "<i4").tobytes()
    (tmp_path / "v.nii.gz").write_bytes(gzip.compress(bytes(raw) + bytes(20_000_000)))

    with pytest.raises(FormatError, match=r"cut short|cannot read"):
        read_nifti(tmp_path / "v.nii.gz")


def test_volumes_over_time_are_refused(tmp_path: Path):
    """A 4-D series is not one volume."""
    image = nibabel.Nifti1Image(np.zeros((2, 2, 2, 5), np.uint8), np.eye(4))
    image.to_filename(tmp_path / "v.nii")

    with pytest.raises(FormatError, match="none of time"):
        read_nifti(tmp_path / "v.nii")


def test_an_axis_beyond_the_format_is_refused(tmp_path: Path):
    """NIfTI-1 counts voxels in 16 bits."""
    volume = Volume(np.zeros((1, 1, 40000), np.uint8), VolumeGrid((40000, 1, 1), (1.0, 1.0, 1.0)))

    with pytest.raises(FormatError, match="32767"):
        write_nifti(volume, tmp_path / "v.nii")


@pytest.mark.parametrize("content", [b"", b"no NIfTI at all" * 40, b"\x1f\x8b\x08broken"])
def test_what_is_no_nifti_is_explained(tmp_path: Path, content: bytes):
    """Empty files, other files and broken gzip give one sentence."""
    (tmp_path / "v.nii.gz").write_bytes(content)

    with pytest.raises(FormatError, match=r"v\.nii\.gz"):
        read_nifti(tmp_path / "v.nii.gz")
