"""Channel data of the PICMUS challenge."""

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonosweep.errors import FormatError, ScanError
from sonosweep.io.picmus import GROUP, is_picmus, read_picmus

from .channel_files import assert_opens_or_explains
from .damage import damaged

ANGLES = np.array([-0.28, 0.0, 0.28])
X_M = (np.arange(4) - 1.5) * 3e-4
SPEED = 1540.0


def write(path, **other):
    """Write a small recording; ``None`` leaves a part out."""
    generator = np.random.default_rng(6)
    real, imag = generator.standard_normal((2, 3, 4, 12)).astype(np.float32)
    parts = {
        "data/real": real,
        "data/imag": imag,
        "angles": ANGLES.astype(np.float32),
        "initial_time": np.array([2e-6]),
        "modulation_frequency": np.array([5.208e6]),
        "PRF": np.array([100.0]),
        "probe_geometry": np.stack([X_M, 0 * X_M, 0 * X_M]),
        "sampling_frequency": np.array([20.832e6]),
        "sound_speed": np.array([SPEED]),
        **{name.replace("__", "/"): part for name, part in other.items()},
    }
    with h5py.File(path, "w") as file:
        for name, part in parts.items():
            if part is not None:
                file[f"{GROUP}/{name}"] = part
    return path


def test_iq_of_all_angles_is_one_frame(tmp_path):
    """Plane waves pass the middle of the array at time zero."""
    path = write(tmp_path / "iq.hdf5")

    data = read_picmus(path).b_mode

    with h5py.File(path) as file:
        stored = file[f"{GROUP}/data/real"][()] + 1j * file[f"{GROUP}/data/imag"][()]
    np.testing.assert_array_equal(data.samples[:], stored[None])
    truth = np.sin(ANGLES.astype(np.float32)).astype(float)[:, None] * X_M / SPEED
    np.testing.assert_allclose(data.transmit_delays_s, truth, rtol=1e-6)
    assert data.start_time_s.tolist() == [2e-6] * 3
    assert data.demodulation_frequency_hz == data.probe.center_frequency_hz == 5.208e6
    assert data.pulse_repetition_hz == 100
    assert data.probe.element_width_mm == pytest.approx(0.3)


def test_rf_has_no_carrier_removed(tmp_path):
    """Without modulation the real part is RF; the center frequency is assumed, and said so."""
    sweep = read_picmus(write(tmp_path / "rf.hdf5", modulation_frequency=np.array([0.0])))

    assert sweep.b_mode.samples.dtype == np.float32
    assert sweep.b_mode.demodulation_frequency_hz == 0
    assert sweep.b_mode.probe.center_frequency_hz == 5.208e6
    assert "quarter" in sweep.notes["center frequency"]


def test_files_of_several_frames_are_read(tmp_path):
    """A movie has frames in front of the angles."""
    movie = np.random.default_rng(1).standard_normal((5, 3, 4, 12))

    data = read_picmus(write(tmp_path / "a.hdf5", data__real=movie, data__imag=movie)).b_mode

    np.testing.assert_array_equal(data.samples[3], movie[3] * (1 + 1j))


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"angles": ANGLES[:2]}, "3 transmits but 2 angles"),
        ({"angles": np.full(3, np.nan)}, "'angles' in 'a.hdf5' are not all numbers"),
        ({"data__imag": None}, "no data set 'imag'"),
        ({"data__imag": np.zeros((3, 4, 9))}, "must have the axes transmits, elements, samples"),
        ({"sampling_frequency": None}, "no data set 'sampling_frequency'"),
        ({"sampling_frequency": np.array([0.0])}, "must be above 0"),
        ({"probe_geometry": np.zeros((4, 3))}, "must have the shape 3 x any"),
        ({"probe_geometry": np.zeros((3, 4))}, "element width .* must be above 0"),
        ({"probe_geometry": np.full((3, 4), 1e300)}, "less than 100 m from the origin"),
        ({"probe_geometry": np.ones((3, 9)) * np.arange(9)}, "4 channels but probe 'PICMUS' has 9"),
        ({"sound_speed": np.ones(2)}, "'sound_speed' in 'a.hdf5' must be one number"),
    ],
)
def test_a_recording_that_contradicts_itself_is_refused(tmp_path, parts, message):
    """One sentence says what is wrong."""
    path = write(tmp_path / "a.hdf5", **parts)

    with pytest.raises((FormatError, ScanError), match=message):
        read_picmus(path)


def test_phantoms_and_images_of_the_challenge_are_no_channel_data(tmp_path):
    """The challenge's other files use the same group."""
    assert is_picmus(write(tmp_path / "a.hdf5"))
    assert not is_picmus(write(tmp_path / "b.hdf5", probe_geometry=None))


@given(data=st.data())
def test_damaged_files_are_explained(tmp_path_factory, data):
    """Bytes lost or changed anywhere give samples or a sentence, nothing else."""
    path = write(tmp_path_factory.mktemp("damaged") / "a.hdf5")
    path.write_bytes(data.draw(damaged(path.read_bytes())))

    assert_opens_or_explains(lambda: read_picmus(path))
