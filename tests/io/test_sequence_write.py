"""Sequence files that we write: what comes back, and what other programs see."""

import re
from dataclasses import replace
from pathlib import Path

import nrrd
import numpy as np
import pytest
import SimpleITK as sitk
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from sonosweep.errors import FormatError, ScanError
from sonosweep.io.plus_config import PlusConfig
from sonosweep.io.sequence import Sequence, read_sequence
from sonosweep.io.sequence_scan import read_plus, scan_from_sequence, trajectory_from_sequence
from sonosweep.io.sequence_write import sequence_from_scan, write_sequence
from sonosweep.scan import Calibration, FrameView, Region, Scan, Trajectory, pixel_to_image

from ..strategies import poses, scans, sweeps

ROUND_OFF_MM = 1e-9  # float64 on coordinates below 1 m, written with all their digits
ROUND_OFF = 1e-12  # float64 on a pixel size after one product of matrices
SUFFIXES = [".igs.mha", ".igs.mhd", ".igs.nrrd", ".seq.nrrd", ".mha", ".seq.mha"]


def assert_same_scan(back: Scan, scan: Scan) -> None:
    """Check every field that a sequence file can carry."""
    np.testing.assert_array_equal(back.frames[:], scan.frames[:])
    assert back.frames.dtype == scan.frames.dtype
    for ours, theirs in ((back.timestamps_s, scan.timestamps_s), (back.tracked, scan.tracked)):
        assert (ours is None) == (theirs is None)
        assert ours is None or theirs is None or torch.equal(ours, theirs)
    assert (back.image_to_reference is None) == (scan.image_to_reference is None)
    if back.image_to_reference is not None and scan.image_to_reference is not None:
        torch.testing.assert_close(
            back.image_to_reference,
            scan.image_to_reference,
            atol=ROUND_OFF_MM,
            rtol=0,
            equal_nan=True,
        )
    assert (back.calibration is None) == (scan.calibration is None)
    if back.calibration is not None and scan.calibration is not None:
        assert_same_calibration(back.calibration, scan.calibration)
    assert back.subject == scan.subject
    assert (back.region is None) == (scan.region is None)
    if back.region is not None and scan.region is not None:
        assert back.region.rectangle_px == scan.region.rectangle_px


def assert_same_calibration(back: Calibration, calibration: Calibration) -> None:
    """Check every field of a calibration."""
    assert back.spacing_mm == pytest.approx(calibration.spacing_mm, rel=ROUND_OFF)
    assert back.shear == pytest.approx(calibration.shear, abs=ROUND_OFF)
    assert back.latency_s == calibration.latency_s
    assert back.pixel_axes == calibration.pixel_axes
    assert back.pixel_origin == calibration.pixel_origin
    assert (back.image_to_probe is None) == (calibration.image_to_probe is None)
    if back.image_to_probe is not None and calibration.image_to_probe is not None:
        error = back.image_to_probe - calibration.image_to_probe
        assert float(error.abs().max()) < ROUND_OFF_MM


@st.composite
def any_scans(draw) -> Scan:
    """A scan in which any part may be missing."""
    scan = draw(scans())
    assert scan.image_to_reference is not None
    calibration = Calibration(
        spacing_mm=(draw(st.floats(0.01, 2)), draw(st.floats(0.01, 2))),
        shear=draw(st.sampled_from([0.0, -0.05])),
        image_to_probe=draw(st.none() | poses()),
        latency_s=draw(st.sampled_from([0.0, 0.1])),
        pixel_axes=draw(st.sampled_from(["column_row", "row_column"])),
        pixel_origin=draw(st.sampled_from([0, 1])),
    )
    scan = replace(
        scan,
        calibration=calibration,
        timestamps_s=draw(st.sampled_from([None, scan.timestamps_s])),
        subject=draw(st.sampled_from([None, "P07"])),
        region=draw(st.sampled_from([None, Region((1, 2, 5, 6))])),
    )
    kept = draw(st.sampled_from(["all poses", "a gap", "no poses", "nothing"]))
    if kept == "a gap":
        tracked = torch.tensor([True, False, True, True, False])
        holed = scan.image_to_reference.clone()
        holed[~tracked] = float("nan")
        return replace(scan, image_to_reference=holed, tracked=tracked)
    if kept == "no poses":
        return replace(scan, image_to_reference=None)
    if kept == "nothing":
        return replace(scan, image_to_reference=None, calibration=None)
    return scan


@given(scan=any_scans(), suffix=st.sampled_from(SUFFIXES), compress=st.booleans())
def test_a_written_scan_reads_back_unchanged(tmp_path_factory, scan, suffix, compress):
    """Everything but companions and masks survives every sequence format."""
    path = tmp_path_factory.mktemp("scan") / f"scan{suffix}"

    write_sequence(scan, path, compress)

    assert_same_scan(read_plus(path), scan)


@given(scan=any_scans())
def test_a_second_copy_is_the_same_file(tmp_path_factory, scan):
    """A sequence that was read and written again has not changed by a byte."""
    folder = tmp_path_factory.mktemp("scan")
    write_sequence(scan, folder / "a.igs.mha")

    write_sequence(read_sequence(folder / "a.igs.mha"), folder / "b.igs.mha")

    assert (folder / "b.igs.mha").read_bytes() == (folder / "a.igs.mha").read_bytes()


@settings(max_examples=10)
@given(scan=scans(), suffix=st.sampled_from(SUFFIXES))
def test_colour_and_deep_pixels_are_kept(tmp_path_factory, scan, suffix):
    """RGB, 16 bits and floats are stored as they are."""
    folder = tmp_path_factory.mktemp("scan")
    colour = np.stack([scan.frames, scan.frames, scan.frames], axis=-1)
    for k, pixels in enumerate([colour, scan.frames.astype("uint16"), scan.frames / np.float32(7)]):
        path = folder / f"{k}{suffix}"

        write_sequence(replace(scan, frames=pixels), path)

        back = read_plus(path).frames
        np.testing.assert_array_equal(back[:], pixels)
        assert back.dtype == pixels.dtype


@pytest.mark.parametrize("compress", [True, False])
@given(scan=scans())
@settings(max_examples=5)
def test_simpleitk_reads_our_sequences(tmp_path_factory, compress, scan):
    """ITK sees the pixels and every per-frame field."""
    path = tmp_path_factory.mktemp("scan") / "a.igs.mha"
    write_sequence(scan, path, compress)

    image = sitk.ReadImage(str(path))

    np.testing.assert_array_equal(sitk.GetArrayFromImage(image), scan.frames)
    assert image.GetMetaData("Seq_Frame0004_ImageToReferenceTransformStatus") == "OK"
    assert image.GetMetaData("Seq_Frame0004_Timestamp") == "0.2"
    text = image.GetMetaData("Seq_Frame0004_ImageToReferenceTransform")
    matrix = np.array([float(word) for word in text.split()]).reshape(4, 4)
    spacing = scan.calibration.spacing_mm
    # Columns are as long as a pixel, and the third has their mean: no sheared slab.
    np.testing.assert_allclose(np.linalg.norm(matrix[:3, :3], axis=0), (*spacing, sum(spacing) / 2))
    assert np.linalg.det(matrix[:3, :3]) == pytest.approx(np.prod(spacing) * sum(spacing) / 2)


def test_pynrrd_reads_our_sequences(tmp_path):
    """Core Slicer's layout: four axes, the list last, times as its values, size in mm."""
    pixels = np.arange(60, dtype=np.uint8).reshape(3, 4, 5)
    times = torch.tensor([0.0, 0.05, 0.11], dtype=torch.float64)
    scan = Scan("a", pixels, Calibration((0.2, 0.1)), times)
    write_sequence(scan, tmp_path / "a.seq.nrrd")

    stored, header = nrrd.read(str(tmp_path / "a.seq.nrrd"), index_order="C")

    np.testing.assert_array_equal(stored[:, 0], pixels)
    assert header["kinds"] == ["domain", "domain", "domain", "list"]
    assert header["axis 3 index type"] == "numeric"
    assert header["axis 3 index values"] == "0 0.05 0.11"
    np.testing.assert_allclose(np.diag(header["space directions"][:3]), [0.2, 0.1, 0.15])


def test_frames_without_times_get_none(tmp_path):
    """Core Slicer needs an index; numbers of frames must not come back as seconds."""
    scan = Scan("a", np.zeros((3, 4, 5), np.uint8))
    write_sequence(scan, tmp_path / "a.seq.nrrd")

    assert read_sequence(tmp_path / "a.seq.nrrd").timestamps_s is None


def test_no_line_is_longer_than_plus_reads(tmp_path):
    """IGSIO cuts lines at 1000 bytes; one that cannot be shorter is refused."""
    path = tmp_path / "a.igs.mha"
    scan = Scan(
        "a",
        np.zeros((2, 4, 5), np.uint8),
        Calibration((1 / 3, 1 / 7)),
        image_to_reference=torch.eye(4, dtype=torch.float64).repeat(2, 1, 1),
        subject="x" * 2000,
    )
    write_sequence(scan, path, compress=False)

    assert max(map(len, path.read_bytes()[:-40].split(b"\n"))) < 1000
    long = Sequence("a", 1, np.zeros((1, 4, 5), np.uint8), frame_fields={"Note": ("y" * 2000,)})
    with pytest.raises(ScanError, match="Note of 'a' does not fit"):
        write_sequence(long, tmp_path / "b.igs.mha")
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("suffix", [".igs.mha", ".seq.nrrd"])
def test_more_than_four_gigabytes_are_refused(tmp_path, suffix):
    """Readers count bytes in 32 bits; the sentence says into how many frames to split."""
    pixels = np.broadcast_to(np.zeros((), np.uint8), (4097, 1024, 1024))

    with pytest.raises(ScanError, match=r"4 GiB .* parts of at most 4096 frames"):
        write_sequence(Scan("a", pixels), tmp_path / f"a{suffix}")

    assert list(tmp_path.iterdir()) == []


def test_poses_need_a_pixel_size(tmp_path):
    """PLUS's ImageToReference maps pixels, so poses of millimetres alone cannot be written."""
    scan = Scan(
        "a",
        np.zeros((2, 4, 5), np.uint8),
        image_to_reference=torch.eye(4, dtype=torch.float64).repeat(2, 1, 1),
    )

    with pytest.raises(ScanError, match="give the pixel spacing"):
        write_sequence(scan, tmp_path / "a.igs.mha")


@pytest.mark.parametrize("name", ["a.png", "a.igs", "a.nhdr", "a"])
def test_other_suffixes_are_refused(tmp_path, name):
    """The sentence lists the suffixes that are written."""
    with pytest.raises(FormatError, match=re.escape("ends with .igs.mha")):
        write_sequence(Scan("a", np.zeros((2, 4, 5), np.uint8)), tmp_path / name)


@pytest.mark.parametrize("name", ["a.igs.mha", "a.igs.nrrd", "a.igs.mhd"])
def test_a_frame_that_cannot_be_read_leaves_no_file(tmp_path, name):
    """What goes wrong half-way leaves the folder as it was."""

    class Broken(FrameView):
        def __getitem__(self, index):
            if index == 1:
                raise KeyboardInterrupt
            return super().__getitem__(index)

    with pytest.raises(KeyboardInterrupt):
        write_sequence(Scan("a", Broken(np.zeros((2, 4, 5), np.uint8))), tmp_path / name)

    assert list(tmp_path.iterdir()) == []


@given(
    image_to_reference=sweeps(6),
    timed=st.booleans(),
    deviations=st.booleans(),
)
def test_a_trajectory_is_a_file_without_images(
    tmp_path_factory, image_to_reference, timed, deviations
):
    """Poses, times, deviations and what was assumed survive an .igs.mha without pixels."""
    path = tmp_path_factory.mktemp("trajectory") / "a.igs.mha"
    trajectory = Trajectory(
        image_to_reference,
        torch.arange(6, dtype=torch.float64) / 20 if timed else None,
        torch.rand(5, 6, dtype=torch.float64) if deviations else None,
        method="decorrelation",
        assumptions=("the sweep went forward", "speckle was isotropic"),
        settings={"window": "0.3 mm"},
    )

    write_sequence(trajectory, path)
    sequence = read_sequence(path)
    back = trajectory_from_sequence(sequence)

    assert sequence.frames is None
    error = back.image_to_reference - image_to_reference
    assert float(error.abs().max()) < ROUND_OFF_MM
    for ours, theirs in (
        (back.timestamps_s, trajectory.timestamps_s),
        (back.step_std, trajectory.step_std),
    ):
        assert (ours is None) == (theirs is None)
        assert ours is None or theirs is None or torch.equal(ours, theirs)
    assert back.method == "decorrelation"
    assert back.assumptions == trajectory.assumptions
    assert back.settings == trajectory.settings


def test_a_trajectory_has_no_place_in_nrrd(tmp_path):
    """NRRD has no axis of size 0."""
    trajectory = Trajectory(torch.eye(4, dtype=torch.float64).repeat(2, 1, 1))

    with pytest.raises(FormatError, match=r"need \.igs\.mha"):
        write_sequence(trajectory, tmp_path / "a.igs.nrrd")


@given(scan=scans())
def test_our_sequence_says_the_same_through_the_probe(scan):
    """ImageToReference and ProbeToReference with ImageToProbe are two ways to one pose."""
    calibration = scan.calibration
    probe = scan.image_to_reference @ torch.linalg.inv(calibration.image_to_probe)
    direct = sequence_from_scan(scan)
    matrices = replace(direct.transforms[("Image", "Reference")], matrices=probe)
    through = replace(
        direct,
        transforms={("Probe", "Reference"): matrices},
        static_transforms={},
    )
    config = PlusConfig(
        path=Path("device.xml"),
        transforms={("Image", "Probe"): calibration.image_to_probe @ pixel_to_image(calibration)},
    )

    assert_same_scan(scan_from_sequence(through, config), scan_from_sequence(direct))
