"""Our own scan files, and the lazy frames that all HDF5 readers share."""

import pickle
import subprocess
import sys
from dataclasses import replace

import h5py
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from sonosweep.errors import FormatError, ScanError
from sonosweep.io.hdf5 import is_scan_hdf5, read_scan, write_scan
from sonosweep.scan import Calibration, Companion, Region, Scan

from ..strategies import scans
from .damage import LARGEST_RESIDENT_MB, assert_reads_or_explains, damaged, resident_mb_after


def full_scan() -> Scan:
    """A scan with something in every field."""
    generator = np.random.default_rng(1)
    poses = torch.eye(4, dtype=torch.float64).repeat(4, 1, 1)
    poses[:, 2, 3] = torch.arange(4) * 0.3
    poses[2] = torch.nan
    image_to_probe = torch.eye(4, dtype=torch.float64)
    image_to_probe[0, 3] = 12.5
    return Scan(
        name="Müller sweep",
        frames=generator.integers(0, 256, (4, 6, 5), dtype=np.uint8),
        calibration=Calibration((0.2, 0.1), 0.01, image_to_probe, 0.04, "row_column", 1),
        timestamps_s=torch.tensor([0.0, 0.05, 0.1, 0.17], dtype=torch.float64),
        image_to_reference=poses,
        tracked=torch.tensor([True, True, False, True]),
        subject="007",
        region=Region((1, 2, 3, 4), generator.random((6, 5)) > 0.5),
        companions={
            "power_doppler": Companion(
                generator.random((4, 3, 2), dtype=np.float32), (0.4, 0.5), (0.1, -0.2)
            )
        },
        notes={"time": "made up\nin two lines"},
    )


@pytest.mark.parametrize("compression", [None, "lzf", "gzip"])
def test_a_scan_file_gives_back_every_field(tmp_path, compression):
    """Nothing that a scan can hold is lost or rounded in our own file."""
    scan = full_scan()

    write_scan(scan, tmp_path / "scan.h5", compression)
    again = read_scan(tmp_path / "scan.h5")

    assert (again.name, again.subject, dict(again.notes)) == (
        scan.name,
        scan.subject,
        dict(scan.notes),
    )
    np.testing.assert_array_equal(again.frames[:], scan.frames[:])
    assert again.frames.dtype == np.uint8
    assert torch.equal(again.timestamps_s, scan.timestamps_s)
    np.testing.assert_array_equal(again.image_to_reference, scan.image_to_reference)
    assert torch.equal(again.tracked, scan.tracked)
    assert replace(again.calibration, image_to_probe=None) == replace(
        scan.calibration, image_to_probe=None
    )
    assert torch.equal(again.calibration.image_to_probe, scan.calibration.image_to_probe)
    assert again.region.rectangle_px == (1, 2, 3, 4)
    np.testing.assert_array_equal(again.region.mask, scan.region.mask)
    doppler = again.companions["power_doppler"]
    assert (doppler.spacing_mm, doppler.origin_mm) == ((0.4, 0.5), (0.1, -0.2))
    np.testing.assert_array_equal(doppler.frames[:], scan.companions["power_doppler"].frames[:])


@given(scans(), st.sampled_from([np.uint8, np.uint16, np.int16, np.float32, np.float64]))
def test_pixels_and_poses_of_any_scan_come_back(tmp_path_factory, scan, dtype):
    """Pixel type, pixels and float64 poses survive exactly."""
    path = tmp_path_factory.mktemp("hdf5") / "scan.h5"
    scan = replace(scan, frames=scan.frames.astype(dtype))

    write_scan(scan, path)
    again = read_scan(path)

    np.testing.assert_array_equal(again.frames[:], scan.frames)
    assert again.frames.dtype == dtype
    assert torch.equal(again.image_to_reference, scan.image_to_reference)


def test_a_bare_scan_stays_bare(tmp_path):
    """What a scan does not know is not made up by storing it; colour keeps its channels."""
    colour = np.arange(2 * 3 * 4 * 3, dtype=np.uint8).reshape(2, 3, 4, 3)

    write_scan(Scan(name="bare", frames=colour), tmp_path / "bare.h5")
    again = read_scan(tmp_path / "bare.h5")

    assert again.calibration is again.timestamps_s is again.image_to_reference is None
    assert again.tracked is again.subject is again.region is None
    assert (again.companions, again.notes) == ({}, {})
    np.testing.assert_array_equal(again.frames[:], colour)


def test_frames_behave_like_an_array(tmp_path):
    """Indices, negative ones and slices with steps give what NumPy gives; outside is outside."""
    scan = full_scan()
    write_scan(scan, tmp_path / "scan.h5")
    frames = read_scan(tmp_path / "scan.h5").frames

    for index in (0, -1, 2, slice(1, 3), slice(None, None, -2), slice(3, 1)):
        np.testing.assert_array_equal(frames[index], scan.frames[index])
    with pytest.raises(IndexError):
        frames[4]


def test_frames_travel_to_another_process(tmp_path):
    """A data loader may pickle frames that were already read."""
    write_scan(full_scan(), tmp_path / "scan.h5")
    frames = read_scan(tmp_path / "scan.h5").frames
    first = frames[0]

    again = pickle.loads(pickle.dumps(frames))

    np.testing.assert_array_equal(again[0], first)


def test_the_same_scan_gives_the_same_bytes(tmp_path):
    """Files can be compared by checksum."""
    write_scan(full_scan(), tmp_path / "a.h5")
    write_scan(full_scan(), tmp_path / "b.h5")

    assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "b.h5").read_bytes()


def test_a_scan_can_be_written_over_the_file_it_is_read_from(tmp_path):
    """The frames are still in the old file while the new one is made beside it."""
    write_scan(full_scan(), tmp_path / "scan.h5")

    write_scan(read_scan(tmp_path / "scan.h5"), tmp_path / "scan.h5", "lzf")

    np.testing.assert_array_equal(read_scan(tmp_path / "scan.h5").frames[:], full_scan().frames)


def test_opening_a_scan_of_4_gb_needs_little_memory(tmp_path):
    """Only the frames that are looked at are read."""
    path = tmp_path / "long.h5"
    with h5py.File(path, "w") as file:
        file.attrs["format"], file.attrs["format_version"] = np.bytes_("sonosweep scan"), 1
        shape = (4096, 1024, 1024)
        file.create_dataset("frames", shape, np.uint8, chunks=(1, 1024, 1024))

    used = resident_mb_after(
        "from sonosweep.io.hdf5 import read_scan\n"
        "frames = read_scan(path).frames\n"
        "assert len(frames) == 4096 and not any(frames[i].any() for i in range(0, 4096, 64))",
        path,
    )

    assert used < LARGEST_RESIDENT_MB


def test_only_our_files_are_taken_for_ours(tmp_path):
    """The content decides, not the suffix."""
    write_scan(full_scan(), tmp_path / "ours.bin")
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["frames"] = np.zeros((2, 3, 4), np.uint8)
    (tmp_path / "text.h5").write_text("no HDF5")

    assert is_scan_hdf5(tmp_path / "ours.bin")
    assert not is_scan_hdf5(tmp_path / "other.h5")
    assert not is_scan_hdf5(tmp_path / "text.h5")
    assert not is_scan_hdf5(tmp_path)
    with pytest.raises(FormatError, match="not a sonosweep scan file; it holds frames"):
        read_scan(tmp_path / "other.h5")


def change(path, **parts):
    """Replace data sets and attributes of a file."""
    with h5py.File(path, "r+") as file:
        for name, value in parts.items():
            if name in file:
                del file[name]
                if value is not None:
                    file[name] = value
            else:
                file.attrs[name] = value


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"frames": None}, "has no data set 'frames'; it holds calibration"),
        ({"frames": np.zeros((4, 0, 5), np.uint8)}, "holds no pixels"),
        ({"frames": np.zeros((4, 6), np.uint8)}, "must hold frames of numbers"),
        ({"frames": np.zeros((4, 6, 5, 2), np.uint8)}, "1, 3 or 4 channels"),
        ({"frames": np.zeros((4, 6, 5), "S3")}, "must hold numbers"),
        ({"image_to_reference": np.zeros((3, 4, 4))}, "4 frames but 3 'image_to_reference'"),
        ({"image_to_reference": np.zeros((4, 3, 4))}, "must have the shape any x 4 x 4"),
        ({"image_to_reference": np.full((4, 4, 4), np.nan)}, "the pose of frame 0"),
        ({"timestamps_s": np.array([0.0, 1, 1, 2])}, "timestamps must increase"),
        ({"timestamps_s": np.array([0.0, 1, np.nan, 2])}, "timestamps that are not numbers"),
        ({"format_version": 2}, "format version 2"),
    ],
)
def test_a_file_that_contradicts_itself_is_refused(tmp_path, parts, message):
    """One sentence says what is wrong, and where."""
    path = tmp_path / "scan.h5"
    write_scan(full_scan(), path)
    change(path, **parts)

    with pytest.raises((FormatError, ScanError), match=message):
        read_scan(path)


@pytest.mark.parametrize(
    ("shape", "chunks", "message"),
    [
        ((10**9, 8, 8), (1, 8, 8), "too large to be a sweep"),
        ((2, 10**6, 10**6), (1, 100, 100), "too large to be a sweep"),
        ((4000, 512, 512), (4000, 512, 512), "one frame cannot be read alone"),
    ],
)
def test_absurd_sizes_are_refused_before_anything_is_read(tmp_path, shape, chunks, message):
    """HDF5 can state terabytes in a file of some kB."""
    with h5py.File(tmp_path / "scan.h5", "w") as file:
        file.attrs["format"], file.attrs["format_version"] = np.bytes_("sonosweep scan"), 1
        file.create_dataset("frames", shape, np.uint8, chunks=chunks)

    with pytest.raises(FormatError, match=message):
        read_scan(tmp_path / "scan.h5")


def test_what_cannot_be_written_is_said_and_leaves_nothing(tmp_path):
    """A failed write leaves no file, neither whole nor half."""
    nameless = replace(full_scan(), companions={"a/b": Companion(np.zeros((4, 1, 1)), (1.0, 1.0))})

    with pytest.raises(FormatError, match="no frames"):
        write_scan(Scan(name="empty", frames=np.zeros((0, 2, 2))), tmp_path / "scan.h5")
    with pytest.raises(FormatError, match="cannot be named 'a/b'"):
        write_scan(nameless, tmp_path / "scan.h5")
    with pytest.raises(FormatError, match="zero byte"):
        write_scan(replace(full_scan(), name="a\0b"), tmp_path / "scan.h5")

    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_is_one_sentence(tmp_path):
    """When no more bytes can be written, nothing is left behind and the message says so."""
    program = (
        "import resource, signal, sys\nimport numpy as np\n"
        "from sonosweep.io.hdf5 import write_scan\nfrom sonosweep.scan import Scan\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, 300_000))\n"
        "try:\n"
        "    write_scan(Scan('big', np.ones((90, 100, 100), np.uint8)), sys.argv[1])\n"
        "except Exception as error:\n"
        "    print(type(error).__name__, error)\n"
    )

    run = subprocess.run(
        [sys.executable, "-c", program, str(tmp_path / "scan.h5")],
        capture_output=True,
        text=True,
        check=True,
    )

    assert run.stdout.startswith("FormatError cannot write")
    assert list(tmp_path.iterdir()) == []


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> bytes:
    """The bytes of a small valid file."""
    path = tmp_path_factory.mktemp("whole") / "scan.h5"
    write_scan(full_scan(), path, "gzip")
    return path.read_bytes()


@given(data=st.data())
def test_damaged_files_are_explained(tmp_path_factory, whole, data):
    """Bytes lost or changed anywhere give frames or a sentence, nothing else."""
    path = tmp_path_factory.mktemp("damaged") / "scan.h5"
    path.write_bytes(data.draw(damaged(whole)))

    assert_reads_or_explains(lambda: read_scan(path))
