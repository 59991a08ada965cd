"""USTB's channel data."""

from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonosweep.errors import FormatError, ScanError
from sonosweep.io.uff import is_uff, read_uff

from .channel_files import assert_opens_or_explains
from .damage import damaged

SPEED = 1500.0
RATE_HZ = 20e6
PITCH_M = 3e-4
X_M = (np.arange(4) - 1.5) * PITCH_M
TIME_ERROR_S = 1e-15  # rounding


def wave(**parts) -> dict:
    """A wave; ``source`` is (distance, azimuth, elevation)."""
    distance, azimuth, elevation = parts.pop("source", (np.inf, 0.0, 0.0))
    source = {"distance": distance, "azimuth": azimuth, "elevation": elevation}
    return {"wavefront": 0, "source": source, "delay": 0.0, **parts}


def channel_data(data: Any, waves: list[dict], **other) -> dict:
    """The parts of a ``uff.channel_data`` object."""
    geometry = np.zeros((7, 4))
    geometry[0], geometry[5], geometry[6] = X_M, 2.7e-4, 5e-3
    sequence = (
        waves[0] if len(waves) == 1 else {f"sequence_{k:04d}": w for k, w in enumerate(waves)}
    )
    return {
        "data": data,
        "sampling_frequency": [[RATE_HZ]],
        "initial_time": [[1e-6]],
        "modulation_frequency": [[0.0]],
        "sound_speed": [[SPEED]],
        "PRF": [[5000.0]],
        "pulse": {"center_frequency": [[5e6]]},
        "probe": {"geometry": geometry},
        "sequence": sequence,
        **other,
    }


def write(path, parts, name="channel_data"):
    """Write nested parts as groups and data sets."""
    with h5py.File(path, "w") as file:
        put(file.create_group(name), parts)
    return path


def put(group, parts):
    """Fill a group."""
    for name, part in parts.items():
        if isinstance(part, dict):
            put(group.create_group(name), part)
        else:
            group[name] = part


def random(*shape):
    """Samples."""
    return np.random.default_rng(4).standard_normal(shape).astype(np.float32)


def test_plane_waves_are_read_with_their_clocks(tmp_path):
    """Time zero is when a wave passes the middle; ``delay`` is from then to the recording."""
    data = random(2, 3, 4, 10)
    waves = [wave(source=(np.inf, angle, 0.0), delay=2e-7) for angle in (-0.1, 0.0, 0.1)]

    sweep = read_uff(write(tmp_path / "a.uff", channel_data(data, waves)))

    read = sweep.b_mode
    np.testing.assert_array_equal(read.samples[:], data)
    truth = np.sin([-0.1, 0.0, 0.1])[:, None] * X_M / SPEED
    np.testing.assert_allclose(read.transmit_delays_s, truth, rtol=0, atol=TIME_ERROR_S)
    np.testing.assert_allclose(read.start_time_s, 1.2e-6, rtol=0, atol=TIME_ERROR_S)
    assert (read.sampling_frequency_hz, read.sound_speed_m_per_s) == (RATE_HZ, SPEED)
    assert (read.pulse_repetition_hz, read.demodulation_frequency_hz) == (5000, 0)
    probe = read.probe
    np.testing.assert_allclose(probe.element_positions_mm[:, 0], X_M * 1e3)
    assert (probe.element_width_mm, probe.elevation_aperture_mm) == pytest.approx((0.27, 5))
    assert probe.center_frequency_hz == 5e6


@pytest.mark.parametrize("depth_m", [0.01, -0.01])
def test_spherical_waves_converge_or_diverge(tmp_path, depth_m):
    """Before a focus the outer elements fire first, before a virtual source last."""
    source = (abs(depth_m), 0.0 if depth_m > 0 else np.pi, 0.0)

    parts = channel_data(random(4, 10), [wave(wavefront=1, source=source)])
    delays_s = read_uff(write(tmp_path / "a.uff", parts)).b_mode.transmit_delays_s[0].numpy()

    arrival_s = np.hypot(X_M, depth_m) / SPEED
    if depth_m > 0:
        arrivals = delays_s + arrival_s
        np.testing.assert_allclose(arrivals, 0.01 / SPEED, rtol=0, atol=TIME_ERROR_S)
    else:
        np.testing.assert_allclose(delays_s, arrival_s - 0.01 / SPEED, rtol=0, atol=TIME_ERROR_S)


def test_a_source_on_an_element_is_that_element_alone(tmp_path):
    """Synthetic transmit aperture: one element after the other fires, the others are silent."""
    waves = [
        wave(wavefront=1, source=(abs(x), np.pi / 2 * np.sign(x), 0.0), delay=abs(x) / SPEED)
        for x in X_M
    ]

    data = read_uff(write(tmp_path / "a.uff", channel_data(random(4, 4, 10), waves))).b_mode

    fires = np.isfinite(data.transmit_delays_s.numpy())
    np.testing.assert_array_equal(fires, np.eye(4, dtype=bool))
    # Time zero is when the wave passes the middle's distance: the recording starts with it.
    own = data.transmit_delays_s.numpy()[fires]
    np.testing.assert_allclose(data.start_time_s.numpy() - own, 1e-6, rtol=0, atol=TIME_ERROR_S)


def test_iq_samples_keep_their_phase(tmp_path):
    """USTB's carrier starts with the recording, ours at time zero."""
    real, imag = random(2, 4, 10), random(2, 4, 10)[::-1]
    waves = [wave(delay=0.0), wave(source=(np.inf, 0.2, 0.0), delay=1.3e-7)]
    parts = channel_data({"real": real, "imag": imag}, waves, modulation_frequency=[[5e6]])

    data = read_uff(write(tmp_path / "a.uff", parts)).b_mode

    turn = np.exp(-2j * np.pi * 5e6 * np.array([0.0, 1.3e-7]))[:, None, None]
    np.testing.assert_allclose(data.samples[0], (real + 1j * imag) * turn, atol=1e-6)
    assert data.samples.dtype == np.complex64
    assert data.demodulation_frequency_hz == 5e6


def test_analytic_samples_are_rf(tmp_path):
    """Complex samples whose carrier was not removed: the real part is what was received."""
    real = random(1, 4, 10)

    parts = channel_data({"real": real, "imag": real[::-1]}, [wave()])
    data = read_uff(write(tmp_path / "a.uff", parts)).b_mode

    np.testing.assert_array_equal(data.samples[:], real[None])
    assert data.demodulation_frequency_hz == 0


def test_kinds_of_waves_tell_the_modality(tmp_path):
    """Photoacoustic waves have no delays; equal waves are an ensemble."""
    laser = read_uff(
        write(tmp_path / "pa.uff", channel_data(random(5, 1, 4, 10), [wave(wavefront=2)]))
    )
    ensemble = read_uff(
        write(tmp_path / "pd.uff", channel_data(random(6, 4, 10), [wave() for _ in range(6)]))
    )

    assert laser.photoacoustic.samples.shape == (5, 1, 4, 10)
    assert laser.photoacoustic.transmit_delays_s is None
    assert ensemble.power_doppler.samples.shape == (1, 6, 4, 10)
    assert ensemble.b_mode is None


def test_a_regular_array_needs_no_list_of_elements(tmp_path):
    """A curved array's elements lie on its circle, the middle one at the origin."""
    curved = {"N": [[4.0]], "pitch": [[PITCH_M]], "radius": [[0.05]], "element_width": [[2e-4]]}

    parts = channel_data(
        random(1, 4, 10), [wave(wavefront=1, source=(0.02, np.pi, 0.0))], probe=curved
    )
    places = read_uff(write(tmp_path / "a.uff", parts)).b_mode.probe.element_positions_mm.numpy()

    np.testing.assert_allclose(np.hypot(places[:, 0], places[:, 1] + 50), 50)
    np.testing.assert_allclose(np.linalg.norm(np.diff(places, axis=0), axis=1), 0.3)
    assert (places[:, 1] < 0).all()


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"probe": None}, "has no channel data: no group holds data, sampl"),
        ({"data": random(2, 4, 10)}, "data of 2 waves but a sequence of 1"),
        ({"data": random(10)}, "must be frames, waves, elements and samples"),
        ({"data": random(1, 7, 10)}, "7 channels but probe 'USTB' has 4"),
        (
            {"data": {"real": random(1, 4, 10)}, "modulation_frequency": [[5e6]]},
            "no data set 'imag'",
        ),
        ({"modulation_frequency": [[5e6]]}, "but its samples are real"),
        ({"sampling_frequency": [[np.nan]]}, "must be one number"),
        ({"sampling_frequency": [[0.0]]}, "sampling frequency must be above 0"),
        ({"sequence": {}}, "has 0 waves"),
        ({"sequence": wave(wavefront=7, source=(1.0, 0.0, 0.0))}, "unknown kind 7"),
        ({"sequence": {"a": wave(), "b": wave(wavefront=2)}, "data": random(2, 4, 10)}, "mixes"),
        ({"probe": {"geometry": np.zeros((5, 4))}}, "must have the shape 7 x any"),
        ({"probe": {"N": [[1e9]], "pitch": [[1.0]]}}, "probe of 1e"),
    ],
)
def test_channel_data_that_contradicts_itself_is_refused(tmp_path, parts, message):
    """One sentence says what is wrong."""
    contents = {**channel_data(random(1, 4, 10), [wave()]), **parts}
    contents = {name: part for name, part in contents.items() if part is not None}
    path = write(tmp_path / "a.uff", contents)

    with pytest.raises((FormatError, ScanError), match=message):
        read_uff(path)


def test_the_name_of_the_object_does_not_matter(tmp_path):
    """USTB's users choose the name; an image alone is no channel data."""
    parts = channel_data(random(1, 4, 10), [wave()])

    assert is_uff(write(tmp_path / "a.uff", parts, "my_recording"))
    assert not is_uff(write(tmp_path / "b.uff", {"data": random(5, 5)}, "b_data"))


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> bytes:
    """The bytes of a small valid file."""
    path = tmp_path_factory.mktemp("whole") / "a.uff"
    waves = [wave(), wave(wavefront=1, source=(0.01, 0.0, 0.0))]
    data = {"real": random(2, 4, 10), "imag": random(2, 4, 10)}
    return write(path, channel_data(data, waves, modulation_frequency=[[5e6]])).read_bytes()


@given(data=st.data())
def test_damaged_files_are_explained(tmp_path_factory, whole, data):
    """Bytes lost or changed anywhere give samples or a sentence, nothing else."""
    path = tmp_path_factory.mktemp("damaged") / "a.uff"
    path.write_bytes(data.draw(damaged(whole)))

    assert_opens_or_explains(lambda: read_uff(path))
