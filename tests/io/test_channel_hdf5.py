"""Our own channel-data files."""

import pickle
from dataclasses import replace

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonosweep.errors import FormatError, ScanError
from sonosweep.io.channel_hdf5 import is_channel_hdf5, read_channels, write_channels
from sonosweep.scan import ChannelSweep, modalities

from .channel_files import (
    assert_opens_or_explains,
    assert_same_data,
    assert_same_value,
    full_sweep,
)
from .damage import LARGEST_RESIDENT_MB, damaged, resident_mb_after


@pytest.mark.parametrize("compression", [None, "lzf", "gzip"])
def test_channel_data_comes_back_bit_by_bit(tmp_path, compression):
    """RF, IQ and photoacoustic samples, their clocks and the probe survive exactly."""
    sweep = full_sweep()

    write_channels(sweep, tmp_path / "sweep.h5", compression)
    again = read_channels(tmp_path / "sweep.h5")

    assert set(modalities(again)) == set(modalities(sweep))
    for name, data in modalities(sweep).items():
        assert_same_data(modalities(again)[name], data)
    for name in ("name", "subject", "notes", "image_to_reference", "tracked"):
        assert_same_value(getattr(again, name), getattr(sweep, name))


def test_what_is_not_known_stays_unknown(tmp_path):
    """One-way data has no transmit delays, and storing it does not make any up."""
    bare = ChannelSweep(
        "bare", photoacoustic=replace(full_sweep().photoacoustic, timestamps_s=None)
    )

    write_channels(bare, tmp_path / "bare.h5")
    again = read_channels(tmp_path / "bare.h5")

    assert again.b_mode is again.power_doppler is again.image_to_reference is again.subject is None
    assert_same_data(again.photoacoustic, bare.photoacoustic)
    assert again.photoacoustic.transmit_delays_s is None


def test_samples_are_indexed_as_an_array_is(tmp_path):
    """Indices, negative ones and slices give what NumPy gives, in another process too."""
    sweep = full_sweep()
    write_channels(sweep, tmp_path / "sweep.h5")
    samples = pickle.loads(pickle.dumps(read_channels(tmp_path / "sweep.h5").b_mode.samples))

    for index in (0, -1, slice(1, 3), slice(None, None, -2)):
        np.testing.assert_array_equal(samples[index], sweep.b_mode.samples[index])
    with pytest.raises(IndexError):
        samples[3]


def test_the_same_channel_data_gives_the_same_bytes(tmp_path):
    """Files can be compared by checksum."""
    write_channels(full_sweep(), tmp_path / "a.h5")
    write_channels(full_sweep(), tmp_path / "b.h5")

    assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "b.h5").read_bytes()


def test_opening_20_gb_of_channel_data_needs_little_memory(tmp_path):
    """Only the frames that are looked at are read."""
    write_channels(full_sweep(), path := tmp_path / "long.h5")
    with h5py.File(path, "r+") as file:
        for name in ("power_doppler", "photoacoustic", "image_to_reference", "tracked"):
            del file[name]
        del file["b_mode/samples"], file["b_mode/timestamps_s"]
        shape = (1000, 5, 4, 2**19)
        file.create_dataset("b_mode/samples", shape, np.int16, chunks=(1, 1, 4, 2**19))

    used = resident_mb_after(
        "from sonosweep.io.channel_hdf5 import read_channels\n"
        "samples = read_channels(path).b_mode.samples\n"
        "assert len(samples) == 1000 and not any(samples[i].any() for i in range(0, 1000, 250))",
        path,
    )

    assert used < LARGEST_RESIDENT_MB


def change(path, **parts):
    """Replace data sets and attributes, named with ``__`` for ``/``; ``None`` removes."""
    with h5py.File(path, "r+") as file:
        for name, value in parts.items():
            place = name.replace("__", "/")
            group, _, attribute = place.rpartition("/")
            if place in file:
                del file[place]
                if value is not None:
                    file[place] = value
            elif value is None:
                del file[group or "/"].attrs[attribute]
            else:
                file[group or "/"].attrs[attribute] = value


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"b_mode__samples": None}, "'b_mode' in 'sweep.h5' has no samples"),
        ({"b_mode__samples": np.zeros((3, 5, 4), np.int16)}, "must have the axes frames, transm"),
        ({"b_mode__samples": np.zeros((3, 5, 4, 0), np.int16)}, "holds no samples: it has 3 fr"),
        ({"b_mode__samples": np.zeros((3, 5, 4, 8), "S3")}, "must hold numbers"),
        ({"b_mode__samples": np.zeros((3, 5, 6, 8), np.int16)}, "6 channels but probe 'L11-5v'"),
        ({"b_mode__samples": np.zeros((2, 5, 4, 8), np.int16)}, "2 frames but 3 'timestamps_s'"),
        ({"b_mode__transmit_delays_s": np.full((5, 4), np.inf)}, "are not all numbers"),
        ({"b_mode__transmit_delays_s": np.zeros((5, 3))}, "transmit delays of shape"),
        (
            {"b_mode__start_time_s": np.zeros(4)},
            "'start_time_s' in 'sweep.h5' must have the shape 5",
        ),
        ({"b_mode__sampling_frequency_hz": None}, "has no attribute 'sampling_frequency_hz'"),
        ({"b_mode__sampling_frequency_hz": 0.0}, "sampling frequency must be above 0"),
        ({"b_mode__probe": None}, "has no group 'probe'"),
        ({"b_mode__probe__element_width_mm": np.nan}, "element width"),
        ({"image_to_reference": np.zeros((2, 4, 4))}, "3 frames but 2 'image_to_reference'"),
        ({"format_version": 2}, "format version 2"),
        ({"format": np.bytes_("other")}, "is no sonosweep channel data; it holds b_mode"),
    ],
)
def test_channel_data_that_contradicts_itself_is_refused(tmp_path, parts, message):
    """One sentence says what is wrong, and where."""
    path = tmp_path / "sweep.h5"
    write_channels(full_sweep(), path)
    change(path, **parts)

    with pytest.raises((FormatError, ScanError), match=message):
        read_channels(path)


@pytest.mark.parametrize(
    ("shape", "chunks", "message"),
    [
        ((10**9, 1, 4, 8), (1, 1, 4, 8), "too large to be a sweep"),
        ((2, 10**4, 4, 10**6), (1, 1, 4, 10**6), "too large to be a sweep"),
        ((4000, 5, 4, 8000), (4000, 5, 4, 8000), "one frame cannot be read alone"),
    ],
)
def test_absurd_sizes_are_refused_before_anything_is_read(tmp_path, shape, chunks, message):
    """HDF5 can state terabytes in a file of some kB."""
    path = tmp_path / "sweep.h5"
    write_channels(full_sweep(), path)
    with h5py.File(path, "r+") as file:
        del file["b_mode/samples"], file["b_mode/timestamps_s"]
        file.create_dataset("b_mode/samples", shape, np.int16, chunks=chunks)

    with pytest.raises(FormatError, match=message):
        read_channels(path)


def test_what_cannot_be_written_leaves_nothing(tmp_path):
    """A failed write leaves no file, neither whole nor half."""
    laser = full_sweep().photoacoustic
    empty = replace(laser, samples=laser.samples[:0], timestamps_s=None)

    with pytest.raises(FormatError, match="no frames"):
        write_channels(ChannelSweep("empty", photoacoustic=empty), tmp_path / "sweep.h5")
    with pytest.raises(FormatError, match="zero byte"):
        write_channels(replace(full_sweep(), name="a\0b"), tmp_path / "sweep.h5")

    assert list(tmp_path.iterdir()) == []


def test_only_channel_data_is_taken_for_channel_data(tmp_path):
    """The content decides, not the suffix."""
    write_channels(full_sweep(), tmp_path / "ours.bin")
    (tmp_path / "text.h5").write_text("no HDF5")

    assert is_channel_hdf5(tmp_path / "ours.bin")
    assert not is_channel_hdf5(tmp_path / "text.h5")


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> bytes:
    """The bytes of a small valid file."""
    path = tmp_path_factory.mktemp("whole") / "sweep.h5"
    write_channels(full_sweep(), path, "gzip")
    return path.read_bytes()


@given(data=st.data())
def test_damaged_channel_data_is_explained(tmp_path_factory, whole, data):
    """Bytes lost or changed anywhere give samples or a sentence, nothing else."""
    path = tmp_path_factory.mktemp("damaged") / "sweep.h5"
    path.write_bytes(data.draw(damaged(whole)))

    assert_opens_or_explains(lambda: read_channels(path))
