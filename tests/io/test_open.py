"""One way in: the format is found, and poses are brought to their frames."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from torch.testing import assert_close

from sonosweep.errors import FormatError, ScanError
from sonosweep.io import open_scan, write_scan_as
from sonosweep.io.attach_poses import attach_poses
from sonosweep.io.trajectory_text import write_trajectory_csv, write_tum
from sonosweep.scan import Calibration, FrameView, Scan, Trajectory

from ..strategies import scans

ROUND_OFF_MM = 1e-9  # float64 on coordinates below 1 m
PRINTED_MM = 1e-4  # PLUS sequences hold their matrices in six to nine digits


@pytest.mark.parametrize("name", ["a.igs.mha", "a.igs.nrrd", "a.seq.nrrd", "a.h5"])
@settings(max_examples=5, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(scan=scans())
def test_formats_with_poses_round_trip(tmp_path, name, scan):
    """Pixels, times, spacing and poses come back from every format that can hold them."""
    write_scan_as(scan, tmp_path / name)

    again = open_scan(tmp_path / name)

    assert np.array_equal(again.frames[:], scan.frames[:])
    assert_close(again.timestamps_s, scan.timestamps_s, atol=1e-6, rtol=0)
    assert_close(again.calibration.spacing_mm, scan.calibration.spacing_mm, atol=1e-9, rtol=0)
    assert_close(again.image_to_reference, scan.image_to_reference, atol=PRINTED_MM, rtol=0)


@pytest.mark.parametrize("name", ["a.mp4", "a.mkv", "images"])
@settings(max_examples=3, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(scan=scans())
def test_formats_without_poses_round_trip_with_their_csv(tmp_path, name, scan):
    """Video and images come back without loss, with the poses in the csv beside them."""
    folder = tmp_path / str(np.random.default_rng().integers(1 << 60))
    _, poses = write_scan_as(scan, folder / name)

    again = open_scan(folder / name, pose_file=poses, spacing_mm=scan.calibration.spacing_mm)

    pixels = again.frames[:]
    assert np.array_equal(pixels if pixels.ndim == 3 else pixels[..., 0], scan.frames[:])
    assert_close(again.image_to_reference, scan.image_to_reference, atol=ROUND_OFF_MM, rtol=0)


@pytest.fixture
def frames():
    """Ten frames at 20 Hz."""
    return Scan(
        "x",
        np.zeros((10, 8, 8), np.uint8),
        Calibration((0.1, 0.1)),
        timestamps_s=torch.arange(10, dtype=torch.float64) / 20,
    )


def slide(times):
    """Poses of a probe that slides at 10 mm/s along x."""
    poses = torch.eye(4, dtype=torch.float64).repeat(len(times), 1, 1)
    poses[:, 0, 3] = 10 * times
    return Trajectory(poses, times)


def test_a_fast_tracker_is_interpolated_at_the_frames(tmp_path, frames):
    """60 Hz poses of a steady slide give each 20 Hz frame its place, 12 ms of lag undone."""
    samples = torch.arange(-12, 60, dtype=torch.float64) / 60
    write_tum(slide(samples), tmp_path / "tracker.txt")

    scan = attach_poses(frames, tmp_path / "tracker.txt", latency_s=0.012)

    expected = 10 * (frames.timestamps_s - 0.012)
    assert_close(scan.image_to_reference[:, 0, 3], expected, atol=1e-6, rtol=0)
    assert scan.tracked is None


def test_a_known_latency_is_used_unless_another_is_given(tmp_path, frames):
    """Frames of a calibrated system that are 12 ms late show the probe of 12 ms before."""
    samples = torch.arange(-12, 60, dtype=torch.float64) / 60
    write_tum(slide(samples), tmp_path / "tracker.txt")
    late = replace(frames, calibration=Calibration((0.1, 0.1), latency_s=0.012))

    for latency_s, expected_s in ((None, 0.012), (0.0, 0.0), (0.05, 0.05)):
        scan = attach_poses(late, tmp_path / "tracker.txt", latency_s)
        expected = 10 * (frames.timestamps_s - expected_s)
        assert_close(scan.image_to_reference[:, 0, 3], expected, atol=1e-6, rtol=0)


def test_frames_in_a_gap_have_no_pose(tmp_path, frames):
    """Where the tracker was silent for 200 ms, frames are not tracked, and the notes say so."""
    samples = torch.cat((torch.arange(0, 10), torch.arange(22, 40))).double() / 60
    write_tum(slide(samples), tmp_path / "tracker.txt")

    scan = attach_poses(frames, tmp_path / "tracker.txt")

    assert scan.tracked.tolist() == [True] * 4 + [False] * 4 + [True] * 2
    assert scan.notes["matching"] == (
        "matched by time: 4 of 10 frames have no pose (between frames 4 and 7); the longest gap"
        " between tracker samples is 0.217 s"
    )


def test_a_frame_column_says_where_poses_belong(tmp_path, frames):
    """A table of frames 2 and 5 tracks these two."""
    (tmp_path / "p.csv").write_text(
        "frame,tx,ty,tz,qx,qy,qz,qw\n2,1,0,0,0,0,0,1\n5,2,0,0,0,0,0,1\n"
    )

    scan = attach_poses(frames, tmp_path / "p.csv")

    assert scan.tracked.nonzero()[:, 0].tolist() == [2, 5]
    assert scan.image_to_reference[5, 0, 3] == 2
    with pytest.raises(ScanError, match="a pose of frame 5"):
        attach_poses(
            replace(frames, frames=frames.frames[:4], timestamps_s=None), tmp_path / "p.csv"
        )


def test_whose_poses_they_are(tmp_path, frames):
    """With a calibrated probe, a foreign table must say whether it holds image or probe poses."""
    image_to_probe = torch.eye(4, dtype=torch.float64)
    image_to_probe[1, 3] = 7
    calibrated = replace(frames, calibration=Calibration((0.1, 0.1), image_to_probe=image_to_probe))
    write_tum(slide(frames.timestamps_s), tmp_path / "p.txt")
    write_trajectory_csv(slide(frames.timestamps_s), tmp_path / "ours.csv")

    with pytest.raises(ScanError, match="--pose-of"):
        attach_poses(calibrated, tmp_path / "p.txt")
    probe = attach_poses(calibrated, tmp_path / "p.txt", pose_of="probe")
    image = attach_poses(calibrated, tmp_path / "p.txt", pose_of="image")
    ours = attach_poses(calibrated, tmp_path / "ours.csv")

    assert probe.image_to_reference[0, 1, 3] == 7
    assert image.image_to_reference[0, 1, 3] == 0
    assert ours.image_to_reference[0, 1, 3] == 0
    with pytest.raises(ScanError, match="ImageToProbe"):
        attach_poses(frames, tmp_path / "p.txt", pose_of="probe")


def test_what_cannot_be_opened(tmp_path):
    """A file that is not there, one image alone, and an unknown suffix."""
    (tmp_path / "a.png").write_bytes(b"x")
    (tmp_path / "a.docx").write_bytes(b"x")

    with pytest.raises(FormatError, match="there is no"):
        open_scan(tmp_path / "gone.h5")
    with pytest.raises(FormatError, match="give the folder"):
        open_scan(tmp_path / "a.png")
    with pytest.raises(FormatError, match="no format we know"):
        open_scan(tmp_path / "a.docx")


def test_zenodo_sequences_are_known_by_their_calibration(tmp_path, recordings):
    """A PLUS sequence below that set's calibration has (row, column) pixels and late poses."""
    text = (recordings / "tusrec" / "calib_matrix_zenodo7740734.csv").read_text()
    folder = tmp_path / "000"
    write_probe_sequence(folder / "scan.mha", frames=12)
    without = open_scan(folder / "scan.mha")

    (tmp_path / "calib_matrix.csv").write_text(text)
    scan = open_scan(folder / "scan.mha")

    assert without.image_to_reference is None
    assert len(scan.frames) == 8  # transforms come four frames late
    assert_close(scan.calibration.spacing_mm, (0.23554039, 0.22447395), atol=1e-3, rtol=0)


def write_probe_sequence(path, frames):
    """Write a sequence as PLUS does, with only the probe tracked."""
    path.parent.mkdir()
    rows = [
        "ObjectType = Image", "NDims = 3", f"DimSize = 6 4 {frames}", "Kinds = domain domain list",
        "ElementType = MET_UCHAR", "UltrasoundImageOrientation = MF",
    ]  # fmt: skip
    for k in range(frames):
        rows += [
            f"Seq_Frame{k:04d}_ProbeToTrackerTransform = 1 0 0 {k} 0 1 0 0 0 0 1 0 0 0 0 1",
            f"Seq_Frame{k:04d}_ProbeToTrackerTransformStatus = OK",
            f"Seq_Frame{k:04d}_Timestamp = {k / 20}",
        ]
    header = "\n".join([*rows, "ElementDataFile = LOCAL", ""])
    path.write_bytes(header.encode() + bytes(24 * frames))


@pytest.mark.parametrize("name", ["a.mp4", "a.mkv", "a.dcm", "images"])
@pytest.mark.parametrize("timed", [True, False])
def test_poses_stay_with_their_frames_where_the_tracker_missed_some(tmp_path, frames, name, timed):
    """The csv beside pixels says whose poses it holds: no frame gets its neighbour's."""
    seen = torch.tensor([True, True, False, False, True, True, True, False, True, True])
    poses = slide(frames.timestamps_s).image_to_reference
    poses[~seen] = torch.nan
    times = frames.timestamps_s if timed else None
    scan = replace(frames, timestamps_s=times, image_to_reference=poses, tracked=seen)
    _, beside = write_scan_as(scan, tmp_path / name)

    again = open_scan(tmp_path / name, pose_file=beside, spacing_mm=(0.1, 0.1))

    assert torch.equal(again.tracked, seen)
    assert_close(again.image_to_reference[seen], poses[seen], atol=ROUND_OFF_MM, rtol=0)


def test_a_folder_that_we_wrote_is_replaced_with_its_poses(tmp_path, frames):
    """No frame and no pose of the older scan stays among the newer ones."""
    poses = slide(frames.timestamps_s).image_to_reference
    write_scan_as(replace(frames, image_to_reference=poses), tmp_path / "out")
    fewer = replace(frames, frames=np.ones((4, 8, 8), np.uint8), timestamps_s=None)

    write_scan_as(fewer, tmp_path / "out")

    again = open_scan(tmp_path / "out")
    assert len(again.frames) == 4
    assert again.image_to_reference is None
    assert {path.name for path in tmp_path.iterdir()} == {"out"}


def test_a_folder_with_files_of_others_is_left_alone(tmp_path, frames):
    """Images that we did not write are never removed."""
    write_scan_as(frames, tmp_path / "out")
    (tmp_path / "out" / "scan1.png").write_bytes(b"mine")

    with pytest.raises(FormatError, match=r"other files, such as 'scan1\.png'"):
        write_scan_as(frames, tmp_path / "out")

    assert (tmp_path / "out" / "scan1.png").read_bytes() == b"mine"


def test_a_folder_of_images_is_whole_or_not_there(tmp_path, frames):
    """Frames that cannot be read half-way leave nothing behind."""

    class Breaking(FrameView):
        """Frames of which the seventh is lost."""

        def _read(self, source):
            if source == 6:
                raise FormatError("frame 6 is damaged")
            return super()._read(source)

    with pytest.raises(FormatError, match="frame 6"):
        write_scan_as(replace(frames, frames=Breaking(frames.frames)), tmp_path / "out")

    assert not list(tmp_path.iterdir())


def test_the_folder_where_one_is_has_a_name(tmp_path, frames, monkeypatch):
    """A scan read as ``.`` is called like its folder."""
    write_scan_as(frames, tmp_path / "sweep7")
    monkeypatch.chdir(tmp_path / "sweep7")

    assert open_scan(".").name == "sweep7"


def test_a_plus_configuration_calibrates_a_folder_too(tmp_path, recordings):
    """ImageToProbe gives images in a folder their pixel size, as it does files."""
    config = recordings / "plus_bone_l14" / "BoneUltrasound_L14_config.xml"
    write_scan_as(Scan("x", np.zeros((2, 8, 8), np.uint8)), tmp_path / "frames")

    scan = open_scan(tmp_path / "frames", plus_config=config)

    # The lengths of the matrix's first two columns, by hand.
    assert_close(scan.calibration.spacing_mm, (0.08544, 0.08544), atol=1e-4, rtol=0)


def test_a_truncated_hdf5_file_is_called_damaged(tmp_path):
    """Half a file is no question of layout, and the sentence says to copy it again."""
    write_scan_as(Scan("x", np.zeros((4, 64, 64), np.uint8)), tmp_path / "whole.h5")
    content = (tmp_path / "whole.h5").read_bytes()
    (tmp_path / "half.h5").write_bytes(content[: len(content) // 2])

    with pytest.raises(FormatError, match=r"'half\.h5' is not a readable HDF5 file.*copy"):
        open_scan(tmp_path / "half.h5")


def test_the_packaged_sweep_has_a_name_unless_a_file_has_it(tmp_path, monkeypatch):
    """It is tracked, and options apply to it as to a file."""
    monkeypatch.chdir(tmp_path)
    packaged = open_scan("demo-sweep", spacing_mm=(0.2, 0.3))
    assert packaged.image_to_reference is not None
    assert packaged.calibration is not None
    assert packaged.calibration.spacing_mm == (0.2, 0.3)
    assert packaged.frames.shape[0] == 140
    (tmp_path / "demo-sweep").mkdir()

    with pytest.raises(FormatError, match="demo-sweep"):
        open_scan("demo-sweep")
