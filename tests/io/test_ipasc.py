"""Photoacoustic data in IPASC's format."""

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonosweep.errors import FormatError, ScanError
from sonosweep.io.ipasc import is_ipasc, read_ipasc

from .channel_files import assert_opens_or_explains
from .damage import damaged

ELEMENTS = 6
SAMPLES = np.random.default_rng(7).standard_normal((ELEMENTS, 9, 2, 3)).astype(np.float32)


def straight() -> np.ndarray:
    """Elements along x1, in m."""
    return np.stack([(np.arange(ELEMENTS) - 2.5) * 3e-4, *np.zeros((2, ELEMENTS))], 1)


def write(path, positions=None, orientations=None, **other):
    """Write a small recording as the consortium's tool does; ``None`` leaves a part out."""
    positions = straight() if positions is None else positions
    parts = {
        "binary_time_series_data": SAMPLES,
        "meta_data/ad_sampling_rate": 4e7,
        "meta_data/acquisition_wavelengths": np.array([7.0e-7, 8.5e-7]),
        "meta_data/speed_of_sound": 1510.0,
        "meta_data/measurement_timestamps": np.array([10.0, 10.1, 10.3]),
        "meta_data/overall_gain": "None",
        "meta_data_device/general/field_of_view": np.array([[-1, 1], [0, 0], [0, 4]]) * 1e-2,
        **{name.replace("__", "/"): part for name, part in other.items()},
    }
    for k, position in enumerate(positions):
        place = f"meta_data_device/detectors/{k:010d}"
        parts[f"{place}/detector_position"] = position
        response = np.array([[1e6, 4e6, 9e6], [0.1, 1.0, 0.2]])
        parts[f"{place}/frequency_response"] = response
        if orientations is not None:
            parts[f"{place}/detector_orientation"] = orientations[k]
    with h5py.File(path, "w") as file:
        for name, part in parts.items():
            if part is not None:
                file[name] = part
    return path


def test_one_wavelength_is_one_sweep(tmp_path):
    """Samples, clock and sound speed are those of the file; the laser pulse is time zero."""
    sweep = read_ipasc(write(tmp_path / "a.hdf5"), wavelength_nm=850.0)

    data = sweep.photoacoustic
    assert data.samples.shape == (3, 1, ELEMENTS, 9)
    np.testing.assert_array_equal(data.samples[:][:, 0], SAMPLES[:, :, 1].transpose(2, 0, 1))
    assert (data.sampling_frequency_hz, data.sound_speed_m_per_s) == (4e7, 1510)
    assert data.transmit_delays_s is None
    np.testing.assert_allclose(data.timestamps_s, [0, 0.1, 0.3])
    assert sweep.notes["wavelength"] == "850 nm"
    assert data.probe.center_frequency_hz == 4e6
    np.testing.assert_allclose(data.probe.element_positions_mm, straight() * 1e3, atol=1e-12)


def test_several_wavelengths_ask_for_one(tmp_path):
    """Mixing wavelengths would mix what absorbs."""
    path = write(tmp_path / "a.hdf5")

    with pytest.raises(FormatError, match="has frames at 700, 850 nm: say which"):
        read_ipasc(path)
    with pytest.raises(FormatError, match="no frame at 720 nm, only at 700, 850 nm"):
        read_ipasc(path, wavelength_nm=720.0)


def test_orientations_tell_the_axial_axis(tmp_path):
    """An arc that looks along x2 images the plane of x1 and x2; elevation is across it."""
    angles = np.linspace(-0.6, 0.6, ELEMENTS)
    arc = 0.04 * np.stack([np.sin(angles), 1 - np.cos(angles), 0 * angles], 1)
    inward = np.stack([-np.sin(angles), np.cos(angles), 0 * angles], 1)

    data = read_ipasc(write(tmp_path / "a.hdf5", arc, inward), wavelength_nm=700.0).photoacoustic

    np.testing.assert_allclose(data.probe.element_positions_mm, arc * 1e3, atol=1e-12)


def test_the_array_may_lie_along_any_axis(tmp_path):
    """A turned device gives the same probe: axes are turned, not mirrored."""
    turned = straight()[:, [2, 0, 1]]
    field = np.array([[0, 4], [-1, 1], [0, 0]]) * 1e-2

    path = write(tmp_path / "a.hdf5", turned, meta_data_device__general__field_of_view=field)
    probe = read_ipasc(path, wavelength_nm=700.0).photoacoustic.probe

    np.testing.assert_allclose(probe.element_positions_mm, straight() * 1e3, atol=1e-12)


def test_axes_of_length_1_may_lack(tmp_path):
    """One frame at one wavelength is elements and samples."""
    path = write(
        tmp_path / "a.hdf5",
        binary_time_series_data=SAMPLES[:, :, 0, 0],
        meta_data__acquisition_wavelengths=7e-7,
        meta_data__speed_of_sound="None",
    )

    sweep = read_ipasc(path)

    np.testing.assert_array_equal(sweep.photoacoustic.samples[0][0], SAMPLES[:, :, 0, 0])
    assert sweep.photoacoustic.sound_speed_m_per_s == 1500
    assert "assumed" in sweep.notes["sound speed"]


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"binary_time_series_data": None}, "no data set 'binary_time_series_data'"),
        ({"binary_time_series_data": np.zeros(5)}, "must be elements, samples, wavelengths"),
        ({"binary_time_series_data": SAMPLES[:4]}, "4 channels but probe 'IPASC' has 6"),
        ({"meta_data__ad_sampling_rate": None}, "lacks the number meta_data/ad_sampling_rate"),
        ({"meta_data__acquisition_wavelengths": None}, "does not tell which"),
        ({"meta_data_device__general__field_of_view": None}, "does not tell in which direction"),
        ({"positions": np.random.default_rng(1).random((6, 3))}, "does not lie in a plane"),
        ({"positions": np.zeros((6, 3))}, "are not at several places"),
        ({"positions": np.zeros((6, 2))}, "no detector_position of 3 numbers"),
        ({"positions": []}, "does not tell where its elements are"),
        ({"meta_data__speed_of_sound": np.nan}, "are not all numbers"),
    ],
)
def test_a_recording_that_contradicts_itself_is_refused(tmp_path, parts, message):
    """One sentence says what is wrong."""
    path = write(tmp_path / "a.hdf5", **parts)

    with pytest.raises((FormatError, ScanError), match=message):
        read_ipasc(path, wavelength_nm=700.0)


def test_the_layout_is_recognized(tmp_path):
    """Time series with a device description."""
    assert is_ipasc(write(tmp_path / "a.hdf5"))
    assert not is_ipasc(write(tmp_path / "b.hdf5", binary_time_series_data=None))


@given(data=st.data())
def test_damaged_files_are_explained(tmp_path_factory, data):
    """Bytes lost or changed anywhere give samples or a sentence, nothing else."""
    path = write(tmp_path_factory.mktemp("damaged") / "a.hdf5")
    path.write_bytes(data.draw(damaged(path.read_bytes())))

    assert_opens_or_explains(lambda: read_ipasc(path, wavelength_nm=700.0))
