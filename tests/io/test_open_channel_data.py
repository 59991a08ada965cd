"""The one place that recognizes channel data, and the line between it and scans."""

import h5py
import numpy as np
import pytest

from sonosweep.errors import FormatError
from sonosweep.io import open_scan
from sonosweep.io.channel_hdf5 import write_channels
from sonosweep.io.hdf5 import write_scan
from sonosweep.io.open_channel_data import is_channel_data, open_channel_data
from sonosweep.scan import Scan, modalities

from . import test_ipasc, test_msot, test_must, test_picmus, test_uff
from .channel_files import full_sweep
from .matlab_files import save_mat
from .verasonics_files import interleaved


def write_msot(folder):
    """An MSOT scan of one wavelength."""
    test_msot.write(folder / "scan", frames=1)
    return folder / "scan"


def write_ours(folder):
    """Our own file."""
    write_channels(full_sweep(), folder / "ours.h5")
    return folder / "ours.h5"


WRITERS = {
    "ours": write_ours,
    "verasonics": lambda folder: save_mat(folder / "v.mat", interleaved()[0], "5"),
    "verasonics 7.3": lambda folder: save_mat(folder / "v.mat", interleaved()[0], "7.3"),
    "must": lambda folder: save_mat(
        folder / "m.mat", {"RF": test_must.rf(9, 4, 2), "param": test_must.PARAM}, "5"
    ),
    "ustb": lambda folder: test_uff.write(
        folder / "a.uff", test_uff.channel_data(test_uff.random(1, 4, 9), [test_uff.wave()])
    ),
    "picmus": lambda folder: test_picmus.write(folder / "a.hdf5"),
    "ipasc": lambda folder: test_ipasc.write(
        folder / "a.hdf5",
        binary_time_series_data=test_ipasc.SAMPLES[:, :, :1],
        meta_data__acquisition_wavelengths=7e-7,
    ),
    "msot": write_msot,
}


@pytest.mark.parametrize("kind", WRITERS)
def test_every_format_is_recognized(tmp_path, kind):
    """The content decides; scans are made of images, so ``open_scan`` names the way there."""
    path = WRITERS[kind](tmp_path)

    sweep = open_channel_data(path)

    assert is_channel_data(path)
    for data in modalities(sweep).values():
        assert data.samples[0].shape == data.samples.shape[1:]
    with pytest.raises(FormatError, match="holds channel data, not images: use 'sonosweep beam"):
        open_scan(path)


def test_a_scan_is_beamformed_already(tmp_path):
    """Images need no beamforming."""
    write_scan(Scan(name="arm", frames=np.zeros((2, 3, 4), np.uint8)), tmp_path / "scan.h5")

    assert not is_channel_data(tmp_path / "scan.h5")
    with pytest.raises(FormatError, match="beamformed already: use 'sonosweep reconstruct'"):
        open_channel_data(tmp_path / "scan.h5")


def test_what_is_no_channel_data_is_said(tmp_path):
    """One sentence for each way to be wrong."""
    (tmp_path / "empty.h5").touch()
    (tmp_path / "text.h5").write_text("no HDF5")
    (tmp_path / "notes.txt").write_text("no data")
    (tmp_path / "folder").mkdir()
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["x"] = np.zeros(3)
    save_mat(tmp_path / "other.mat", {"x": np.zeros(3)}, "5")

    for name, message in (
        ("missing.h5", "there is no"),
        ("empty.h5", "is empty"),
        ("text.h5", "is not a readable HDF5 file"),
        ("notes.txt", "of no format that holds channel data; we read MUST"),
        ("folder", "folder 'folder' holds no channel data"),
        ("other.h5", "HDF5 but holds no channel data of a layout we know"),
        ("other.mat", "neither Verasonics' RcvData and Trans nor MUST's RF"),
    ):
        with pytest.raises(FormatError, match=message):
            open_channel_data(tmp_path / name)
        assert not is_channel_data(tmp_path / name)


def test_a_wavelength_is_only_asked_of_data_that_tells_it(tmp_path):
    """An option that would be ignored is refused."""
    path = WRITERS["picmus"](tmp_path)

    with pytest.raises(FormatError, match="does not tell wavelengths"):
        open_channel_data(path, wavelength_nm=700.0)
