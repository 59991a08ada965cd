"""MATLAB files old and new: which array holds the frames, and in which order."""

import pickle
import struct

import h5py
import numpy as np
import pytest
import scipy.io
from hypothesis import given
from hypothesis import strategies as st

from sonosweep.errors import FormatError, ScanError
from sonosweep.io.matlab import read_mat

from .damage import LARGEST_RESIDENT_MB, assert_reads_or_explains, damaged, resident_mb_after

ROWS, COLUMNS, FRAMES = 5, 7, 4


def as_matlab_shows(frames: np.ndarray) -> np.ndarray:
    """Rows x columns (x 3) x frames."""
    return np.moveaxis(frames, 0, -1)


def sweep(channels: int = 0, dtype=np.uint8) -> np.ndarray:
    """Frames that all differ, in our order."""
    shape = (FRAMES, ROWS, COLUMNS, *([channels] if channels else []))
    return np.arange(np.prod(shape)).reshape(shape).astype(dtype)


def save(path, version: str, variables: dict) -> None:
    """Write arrays (and structs of them) as MATLAB would."""
    if version == "v5":
        scipy.io.savemat(path, variables, do_compression=True)
        return
    with h5py.File(path, "w", userblock_size=512) as file:
        save_new(file, variables)
    with path.open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file, made by a test".ljust(116) + b" " * 8 + b"\0\2IM")


def save_new(group, variables: dict) -> None:
    """Write into a group, axes reversed, structs as groups."""
    for name, value in variables.items():
        if isinstance(value, dict):
            save_new(group.create_group(name), value)
        elif isinstance(value, str):
            group[name] = np.frombuffer(value.encode("utf-16-le"), np.uint16)[:, None]
            group[name].attrs["MATLAB_class"] = np.bytes_("char")
        else:
            array = np.atleast_2d(np.asarray(value))
            group[name] = array.T
            names = {"float64": "double", "float32": "single"}
            group[name].attrs["MATLAB_class"] = np.bytes_(
                names.get(array.dtype.name, array.dtype.name)
            )


VERSIONS = pytest.mark.parametrize("version", ["v5", "v7.3"])


@VERSIONS
@pytest.mark.parametrize("dtype", [np.uint8, np.int16, np.uint16, np.float32, np.float64])
def test_rows_columns_frames_become_our_order(tmp_path, version, dtype):
    """I(row, column, frame) of MATLAB is frames[frame][row, column]; nothing is converted."""
    save(tmp_path / "a.mat", version, {"I": as_matlab_shows(sweep(dtype=dtype)), "fps": 20.0})

    scan = read_mat(tmp_path / "a.mat")

    np.testing.assert_array_equal(scan.frames[:], sweep(dtype=dtype))
    np.testing.assert_array_equal(scan.frames[-1], sweep(dtype=dtype)[-1])
    assert (scan.frames.dtype, scan.name) == (dtype, "a")
    assert scan.calibration is scan.timestamps_s is scan.image_to_reference is None


@VERSIONS
def test_colour_frames(tmp_path, version):
    """Rows x columns x 3 x frames is colour."""
    save(tmp_path / "a.mat", version, {"movie": as_matlab_shows(sweep(3))})

    np.testing.assert_array_equal(read_mat(tmp_path / "a.mat").frames[1:3], sweep(3)[1:3])


@VERSIONS
def test_times_poses_and_spacing_beside_the_frames(tmp_path, version):
    """The documented names are taken; poses are 4 x 4 x frames."""
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    poses[:, :3, 3] = np.arange(FRAMES * 3).reshape(FRAMES, 3)
    times = np.array([0, 0.1, 0.25, 0.3])
    variables = {
        "frames": as_matlab_shows(sweep()),
        "timestamps_s": times[:, None],
        "image_to_reference": as_matlab_shows(poses),
        "spacing_mm": np.array([[0.2, 0.1]]),
    }
    save(tmp_path / "a.mat", version, variables)

    scan = read_mat(tmp_path / "a.mat")

    np.testing.assert_array_equal(scan.image_to_reference, poses)
    np.testing.assert_array_equal(scan.timestamps_s, times)
    assert scan.calibration.spacing_mm == (0.2, 0.1)


@VERSIONS
def test_frames_inside_a_struct(tmp_path, version):
    """Fields have dotted names, and the struct's own times are found."""
    struct = {"frames": as_matlab_shows(sweep()), "timestamps_s": np.arange(4.0), "who": "nobody"}
    save(tmp_path / "a.mat", version, {"scan": struct, "spacing_mm": 0.3, "note": "some words"})

    scan = read_mat(tmp_path / "a.mat", variable="scan.frames")

    np.testing.assert_array_equal(scan.frames[:], sweep())
    assert scan.timestamps_s.tolist() == [0, 1, 2, 3]
    assert scan.calibration.spacing_mm == (0.3, 0.3)


@VERSIONS
def test_the_largest_array_is_the_frames_unless_named(tmp_path, version):
    """A mask of one frame less does not hide the frames, and can be asked for."""
    variables = {"B": as_matlab_shows(sweep()), "A": as_matlab_shows(sweep()[1:])}
    save(tmp_path / "a.mat", version, variables)

    assert len(read_mat(tmp_path / "a.mat").frames) == FRAMES
    assert len(read_mat(tmp_path / "a.mat", variable="A").frames) == FRAMES - 1


@VERSIONS
@pytest.mark.parametrize(
    ("variables", "arguments", "message"),
    [
        ({"x": np.eye(3), "t": "words"}, {}, r"no numbers of shape .* it holds .*x \(3 x 3\)"),
        ({"x": sweep()}, {"variable": "y"}, r"no variable 'y'; it holds x \(4 x 5 x 7\)"),
        ({"x": sweep(), "y": np.eye(3)}, {"variable": "y"}, "cannot be frames"),
        ({"x": sweep(), "y": sweep()}, {}, "say which of x, y"),
        ({"x": sweep(), "timestamps_s": np.arange(5.0)}, {}, "7 frames but 5 timestamps_s"),
        ({"x": sweep(), "timestamps_s": np.zeros(7)}, {}, "timestamps must increase"),
        ({"x": sweep(), "spacing_mm": np.zeros(2)}, {}, "spacing must be above 0"),
        ({"x": sweep(), "spacing_mm": np.ones(3)}, {}, "1 or 2 numbers, not 3"),
        ({"x": sweep(), "image_to_reference": np.ones((7, 4, 4))}, {}, "must be 4 x 4 x 7"),
        (
            {"x": sweep(), "image_to_reference": np.full((4, 4, 7), np.nan)},
            {},
            "the pose of frame 0",
        ),
    ],
)
def test_what_is_wrong_is_said(tmp_path, version, variables, arguments, message):
    """The message lists what there is, in MATLAB's own words."""
    save(tmp_path / "a.mat", version, variables)

    with pytest.raises((FormatError, ScanError), match=message):
        read_mat(tmp_path / "a.mat", **arguments)


def test_complex_data_is_no_image(tmp_path):
    """IQ data must be beamformed and detected first."""
    save(tmp_path / "a.mat", "v5", {"iq": as_matlab_shows(sweep(dtype=np.complex128))})

    with pytest.raises(FormatError, match="no numbers of shape"):
        read_mat(tmp_path / "a.mat")


def test_the_rotating_disk_reads(recordings):
    """A real file: 32 frames of 251 x 251, saved by MATLAB."""
    path = recordings / "pymust_rotating_disk" / "bmode_PWI_disk.mat"

    frames = read_mat(path).frames

    assert (frames.shape, frames.dtype) == ((32, 251, 251), np.uint8)
    np.testing.assert_array_equal(frames[31], scipy.io.loadmat(path)["I"][:, :, 31])


def test_a_real_array_agrees_with_scipy(recordings):
    """RF lines of 334 x 128 x 32, compressed, small integers stored for doubles."""
    path = recordings / "pymust_rotating_disk" / "PWI_disk.mat"

    frames = read_mat(path, variable="RF").frames

    np.testing.assert_array_equal(frames[5], scipy.io.loadmat(path)["RF"][:, :, 5])


def test_files_of_big_endian_machines_read(tmp_path):
    """Old Macs and Suns wrote the other byte order."""
    frames = sweep(dtype=np.int16)
    body = struct.pack(">IIII", 6, 8, 10, 0)  # class 10 is int16
    body += struct.pack(">IIiiii", 5, 12, ROWS, COLUMNS, FRAMES, 0)
    body += struct.pack(">HH4s", 1, 1, b"x")
    numbers = as_matlab_shows(frames).astype(">i2").tobytes(order="F")
    body += struct.pack(">II", 3, len(numbers)) + numbers
    header = b"MATLAB 5.0".ljust(124) + b"\x01\x00MI"
    (tmp_path / "a.mat").write_bytes(header + struct.pack(">II", 14, len(body)) + body)

    np.testing.assert_array_equal(read_mat(tmp_path / "a.mat").frames[:], frames)


@VERSIONS
def test_frames_travel_to_another_process(tmp_path, version):
    """A data loader may pickle frames that were already read."""
    save(tmp_path / "a.mat", version, {"x": as_matlab_shows(sweep())})
    frames = read_mat(tmp_path / "a.mat").frames
    frames[1]

    again = pickle.loads(pickle.dumps(frames))

    np.testing.assert_array_equal(again[2], sweep()[2])


def test_opening_a_new_file_of_4_gb_needs_little_memory(tmp_path):
    """Frames of a -v7.3 file are read one by one."""
    with h5py.File(tmp_path / "a.mat", "w", userblock_size=512) as file:
        file.create_dataset("x", (4096, 1024, 1024), np.uint8, chunks=(1, 1024, 1024))

    used = resident_mb_after(
        "from sonosweep.io.matlab import read_mat\n"
        "frames = read_mat(path).frames\n"
        "assert not any(frames[i].any() for i in range(0, 4096, 64))",
        tmp_path / "a.mat",
    )

    assert used < LARGEST_RESIDENT_MB


def test_an_array_too_large_for_an_old_file_is_refused(tmp_path):
    """A header may claim what it cannot hold."""
    scipy.io.savemat(tmp_path / "a.mat", {"x": as_matlab_shows(sweep())})
    whole = bytearray((tmp_path / "a.mat").read_bytes())
    place = whole.index(np.array([ROWS, COLUMNS, FRAMES], np.int32).tobytes())
    whole[place : place + 12] = np.array([2**20, 2**20, 2**10], np.int32).tobytes()
    (tmp_path / "a.mat").write_bytes(whole)

    with pytest.raises(FormatError, match="is damaged: x is too large"):
        read_mat(tmp_path / "a.mat")


def test_no_file_is_said(tmp_path):
    """A name that was mistyped, a folder."""
    for path in (tmp_path / "none.mat", tmp_path):
        with pytest.raises(FormatError, match="there is no file"):
            read_mat(path)


@VERSIONS
@given(data=st.data(), variable=st.sampled_from([None, "s.x"]))
def test_damaged_files_are_explained(tmp_path_factory, version, data, variable):
    """Bytes lost or changed anywhere give frames or a sentence, nothing else."""
    path = tmp_path_factory.mktemp("damaged") / "a.mat"
    inner = {"x": as_matlab_shows(sweep()), "timestamps_s": np.arange(4.0)}
    save(path, version, {"frames": as_matlab_shows(sweep()), "s": inner, "note": "words"})
    path.write_bytes(data.draw(damaged(path.read_bytes())))

    assert_reads_or_explains(lambda: read_mat(path, variable=variable))
