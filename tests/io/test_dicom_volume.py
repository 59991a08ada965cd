"""DICOM series: who is in them (nobody), and what is refused."""

from pathlib import Path

import numpy as np
import pydicom
import pytest

from sonosweep.errors import FormatError
from sonosweep.io.dicom_volume import read_dicom_volume, write_dicom_volume
from sonosweep.scan import Volume, VolumeGrid
from tests.io.volume_files import itk_image, random_volume


@pytest.fixture
def series(tmp_path: Path) -> Path:
    """A small series of five slices."""
    write_dicom_volume(random_volume(np.random.default_rng(0)), tmp_path / "series")
    return tmp_path / "series"


@pytest.mark.parametrize(
    ("modality", "sop_class"),
    [("US", "1.2.840.10008.5.1.4.1.1.6.1"), ("OT", "1.2.840.10008.5.1.4.1.1.7")],
)
def test_the_series_is_what_it_says(tmp_path: Path, modality, sop_class: str):
    """US Image Storage, or Secondary Capture for viewers that split ultrasound."""
    write_dicom_volume(random_volume(np.random.default_rng(1)), tmp_path / "s", modality=modality)

    headers = [pydicom.dcmread(path) for path in sorted((tmp_path / "s").iterdir())]

    assert {header.SOPClassUID for header in headers} == {sop_class}
    assert {header.Modality for header in headers} == {modality}
    assert headers[0].ImageType == ["DERIVED", "SECONDARY"]
    assert len({header.SOPInstanceUID for header in headers}) == len(headers) == 5
    assert len({header.SeriesInstanceUID for header in headers}) == 1
    assert all(pydicom.uid.UID(header.SOPInstanceUID).is_valid for header in headers)
    assert headers[0].SpacingBetweenSlices == headers[0].SliceThickness


def test_nobody_and_no_date_is_in_it(series: Path):
    """No name, no number, no birthday, no date, no institution."""
    header = pydicom.dcmread(series / "slice_00000.dcm")

    filled = [e.keyword for e in header if e.VR in ("PN", "DA", "TM", "DT") and e.value]
    assert filled == []
    assert header.PatientID == ""
    assert header.PatientIdentityRemoved == "YES"
    assert "InstitutionName" not in header
    assert "settings" not in str(header)


def test_writing_again_replaces_the_series(series: Path):
    """The second series has fewer slices, and none of the first remain."""
    write_dicom_volume(random_volume(np.random.default_rng(2), size=(4, 4, 2)), series)

    assert len(list(series.iterdir())) == 2
    assert [child.name for child in series.parent.iterdir()] == ["series"]


def test_a_folder_with_other_files_is_never_touched(series: Path):
    """Someone's notes are worth more than our series."""
    (series / "notes.txt").write_text("keep me")

    with pytest.raises(FormatError, match=r"notes\.txt"):
        write_dicom_volume(random_volume(np.random.default_rng(3)), series)

    assert len(list(series.iterdir())) == 6


def test_a_missing_slice_is_noticed(series: Path):
    """A gap would shift everything behind it."""
    (series / "slice_00002.dcm").unlink()

    with pytest.raises(FormatError, match="is a file missing"):
        read_dicom_volume(series)


def test_two_series_in_one_folder_are_refused(series: Path, tmp_path: Path):
    """Which of them is meant?"""
    write_dicom_volume(random_volume(np.random.default_rng(4)), tmp_path / "other")
    (tmp_path / "other" / "slice_00000.dcm").rename(series / "second.dcm")

    with pytest.raises(FormatError, match="several series"):
        read_dicom_volume(series)


def test_slices_without_a_place_are_refused(series: Path):
    """A series of pictures is no volume."""
    header = pydicom.dcmread(series / "slice_00001.dcm")
    del header.ImagePositionPatient
    header.save_as(series / "slice_00001.dcm")

    with pytest.raises(FormatError, match="ImagePositionPatient"):
        read_dicom_volume(series)


def test_order_comes_from_positions_and_not_from_names(series: Path):
    """Renamed files still make the same volume."""
    before = read_dicom_volume(series)
    for number, path in enumerate(sorted(series.iterdir())):
        path.rename(series / f"{(number * 3) % 5}_{number}.dcm")
    (series / "readme.txt").write_text("not DICOM")

    after = read_dicom_volume(series)

    np.testing.assert_array_equal(after.voxels, before.voxels)


def test_a_single_slice_keeps_its_thickness(tmp_path: Path):
    """One slice says by its spacing how far the next would be."""
    volume = Volume(np.zeros((1, 3, 4), np.uint8), VolumeGrid((4, 3, 1), (0.5, 0.5, 2.0)))

    write_dicom_volume(volume, tmp_path / "s")

    assert read_dicom_volume(tmp_path / "s").grid.spacing_mm == (0.5, 0.5, 2.0)


def test_constant_real_voxels_survive(tmp_path: Path):
    """A range of zero is no division by zero."""
    volume = Volume(np.full((2, 2, 2), 0.25, np.float32), VolumeGrid((2, 2, 2), (1.0, 1.0, 1.0)))

    write_dicom_volume(volume, tmp_path / "s")

    assert itk_image(tmp_path / "s").GetPixel(0, 0, 0) == 0.25


@pytest.mark.parametrize(
    ("voxels", "message"),
    [
        (np.full((2, 2, 2), np.nan, np.float32), "not numbers"),
        (np.zeros((2, 2, 2), np.int32), "int32"),
        (np.zeros((2, 2, 2, 2), np.uint8), "2 channels"),
        (np.zeros((2, 2, 2, 3), np.uint16), "3 channels"),
    ],
)
def test_what_dicom_cannot_hold_is_refused(tmp_path: Path, voxels: np.ndarray, message: str):
    """The sentence says what and nothing is written."""
    with pytest.raises(FormatError, match=message):
        write_dicom_volume(Volume(voxels, VolumeGrid((2, 2, 2), (1.0, 1.0, 1.0))), tmp_path / "s")

    assert list(tmp_path.iterdir()) == []


def test_empty_folders_are_explained(tmp_path: Path):
    """There is nothing to read in them."""
    with pytest.raises(FormatError, match="no DICOM file"):
        read_dicom_volume(tmp_path)
