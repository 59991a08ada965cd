"""Channel data as users of MUST save it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonosweep.errors import FormatError, ScanError
from sonosweep.io.must import is_must, read_must

from .channel_files import assert_opens_or_explains
from .damage import damaged
from .matlab_files import save_mat

PARAM = {"fs": 2e7, "fc": 5e6, "pitch": 3e-4, "width": 2.7e-4, "c": 1480.0, "t0": 1e-6, "PRF": 1e4}


@pytest.fixture(params=["5", "7.3"])
def version(request):
    """Return the version of the MATLAB files."""
    return request.param


def rf(*shape) -> np.ndarray:
    """Received samples."""
    return np.random.default_rng(9).integers(-999, 999, shape, np.int16)


def test_frames_of_one_plane_wave(tmp_path, version):
    """The third axis is slow time; MUST's SI units become ours."""
    stored = rf(20, 8, 3)
    path = save_mat(tmp_path / "disk.mat", {"RF": stored, "param": PARAM}, version)

    data = read_must(path).b_mode

    np.testing.assert_array_equal(data.samples[:][:, 0], stored.transpose(2, 1, 0))
    assert data.transmit_delays_s.tolist() == [[0.0] * 8]
    assert (data.start_time_s.tolist(), data.sound_speed_m_per_s) == ([1e-6], 1480)
    np.testing.assert_allclose(data.timestamps_s, [0, 1e-4, 2e-4])
    probe = data.probe
    np.testing.assert_allclose(probe.element_positions_mm[:, 0], (np.arange(8) - 3.5) * 0.3)
    assert (probe.element_width_mm, probe.center_frequency_hz) == (pytest.approx(0.27), 5e6)


def test_a_row_of_delays_per_matrix_makes_transmits(tmp_path, version):
    """Steered waves of one frame: as many rows of TXdelay as matrices of RF."""
    stored, delays = rf(20, 8, 3), np.random.default_rng(2).random((3, 8)) * 1e-6
    contents = {"RF": stored, "param": {**PARAM, "TXdelay": delays}}

    data = read_must(save_mat(tmp_path / "a.mat", contents, version)).b_mode

    assert data.samples.shape == (1, 3, 8, 20)
    np.testing.assert_array_equal(data.samples[0], stored.transpose(2, 1, 0))
    np.testing.assert_array_equal(data.transmit_delays_s, delays)
    assert data.timestamps_s is None


def test_a_single_matrix_is_one_frame(tmp_path, version):
    """MATLAB drops a last axis of length 1; a curved array lies on its circle."""
    stored = rf(20, 8)
    curved = {**PARAM, "radius": 0.05, "height": np.inf, "kerf": 3e-5}
    del curved["width"], curved["PRF"]

    data = read_must(save_mat(tmp_path / "a.mat", {"RF": stored, "param": curved}, version)).b_mode

    np.testing.assert_array_equal(data.samples[0][0], stored.T)
    places = data.probe.element_positions_mm.numpy()
    np.testing.assert_allclose(np.hypot(places[:, 0], places[:, 1] + 50), 50)
    np.testing.assert_allclose(np.linalg.norm(np.diff(places, axis=0), axis=1), 0.3)
    assert data.probe.elevation_aperture_mm is data.timestamps_s is None
    assert data.probe.element_width_mm == pytest.approx(0.27)


@pytest.mark.parametrize(
    ("contents", "message"),
    [
        ({"RF": None}, "but is missing"),
        ({"RF": rf(5)}, "is 8, but RF has 5 columns"),
        ({"RF": rf(2, 3, 4, 5)}, "samples x elements x frames, but has the shape"),
        ({"fs": None}, "lacks the number param.fs"),
        ({"fs": np.inf}, "lacks the number param.fs"),
        ({"fs": np.array([1.0, 2.0])}, "param.fs of 'a.mat' must be one number"),
        ({"fc": "fast"}, "must hold numbers"),
        ({"pitch": np.nan}, "holds values that are no numbers"),
        ({"pitch": -1.0}, "param.pitch must be above 0"),
        ({"width": -1.0}, "element width"),
        ({"Nelements": 9.0}, "param.Nelements of 'a.mat' is 9, but RF has 8 columns"),
        ({"TXdelay": np.zeros((1, 5))}, "is 1 x 5, but RF has 8 columns"),
        ({"TXdelay": np.zeros((2, 8))}, "has 2 rows, but RF has 3 matrices"),
    ],
)
def test_a_file_that_contradicts_itself_is_refused(tmp_path, version, contents, message):
    """One sentence says what is wrong."""
    param = {**PARAM, "Nelements": 8.0, **{k: v for k, v in contents.items() if k != "RF"}}
    param = {name: value for name, value in param.items() if value is not None}
    stored = contents.get("RF", rf(20, 8, 3))
    workspace = {"param": param} if stored is None else {"RF": stored, "param": param}
    path = save_mat(tmp_path / "a.mat", workspace, version)

    with pytest.raises((FormatError, ScanError), match=message):
        read_must(path)


def test_the_rotating_disk_is_read(recordings):
    """The recording that MUST's users know: band-pass sampled, 32 plane waves."""
    path = recordings / "pymust_rotating_disk" / "PWI_disk.mat"

    assert is_must(path)
    data = read_must(path).b_mode

    assert data.samples.shape == (32, 1, 128, 334)
    assert data.sampling_frequency_hz == pytest.approx(20e6 / 3)
    assert (data.probe.center_frequency_hz, data.pulse_repetition_hz) == (5e6, 1e4)
    assert data.start_time_s.tolist() == [9.95e-6]
    assert data.sound_speed_m_per_s == 1480


@given(data=st.data())
def test_damaged_files_are_explained(tmp_path_factory, data):
    """Bytes lost or changed anywhere give samples or a sentence, nothing else."""
    path = tmp_path_factory.mktemp("damaged") / "a.mat"
    save_mat(path, {"RF": rf(20, 8, 3), "param": PARAM}, data.draw(st.sampled_from(["5", "7.3"])))
    path.write_bytes(data.draw(damaged(path.read_bytes())))

    assert_opens_or_explains(lambda: read_must(path))
