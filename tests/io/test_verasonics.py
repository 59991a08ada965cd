"""Workspaces of Verasonics machines."""

import pickle

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonosweep.errors import FormatError, ScanError
from sonosweep.imaging import BeamformSettings, PixelGrid, beamform, demodulate
from sonosweep.io.verasonics import is_verasonics, read_verasonics

from .channel_files import assert_opens_or_explains
from .damage import LARGEST_RESIDENT_MB, damaged, resident_mb_after
from .matlab_files import save_mat
from .verasonics_files import (
    ANGLES,
    ELEMENTS,
    FRAMES,
    FREQUENCY_MHZ,
    LENS_MM,
    PEAK,
    PULSES,
    ROWS,
    SPEED,
    START_DEPTH,
    interleaved,
    laser,
    plane_wave,
    positions_mm,
    trans,
    workspace,
)

FREQUENCY_HZ = FREQUENCY_MHZ * 1e6
LENS_S = LENS_MM * 1e-3 / SPEED
ECHO_S = 1.63e-6  # no multiple of any sampling interval
ROUNDING_S = 1e-15
# Largest error, part of the echo's height. RF is only rounded to int16; the other modes cut
# the band of a pulse as short as this one, BS50BW most.
# Pixels are 0.005 mm.
DEPTH_ERROR_MM = {"NS200BW": 0.005, "BS100BW": 0.01}
LATERAL_ERROR_MM = 0.02
ERRORS = {"NS200BW": 2e-4, "BS67BW": 0.01, "BS100BW": 0.012, "BS50BW": 0.05}


@pytest.fixture(params=["5", "7.3"])
def version(request):
    """Return the version of the MATLAB files."""
    return request.param


def test_the_modalities_of_an_interleaved_frame_are_told_apart(tmp_path, version):
    """Steered waves make the B-mode, repeated ones the ensemble, silent ones the laser shot."""
    contents, samples = interleaved()

    sweep = read_verasonics(save_mat(tmp_path / "arm.mat", contents, version))

    count = len(ANGLES)
    np.testing.assert_array_equal(sweep.b_mode.samples[:], samples[:, :count])
    np.testing.assert_array_equal(
        sweep.power_doppler.samples[:], samples[:, count : count + PULSES]
    )
    np.testing.assert_array_equal(sweep.photoacoustic.samples[:], samples[:, count + PULSES :])
    assert sweep.b_mode.samples.dtype == np.int16
    assert sweep.photoacoustic.transmit_delays_s is None


def test_clocks_follow_from_depth_pulse_and_lens(tmp_path, version):
    """An echo's peak lies at its time of flight: pulse and lens are taken off, out and back."""
    contents, _ = interleaved()

    sweep = read_verasonics(save_mat(tmp_path / "arm.mat", contents, version))

    start_s = (2 * START_DEPTH - PEAK) / FREQUENCY_HZ - 2 * LENS_S
    np.testing.assert_allclose(sweep.b_mode.start_time_s, start_s, rtol=0, atol=ROUNDING_S)
    laser_s = 2 * START_DEPTH / FREQUENCY_HZ - LENS_S
    np.testing.assert_allclose(sweep.photoacoustic.start_time_s, laser_s, rtol=0, atol=ROUNDING_S)
    for delays, angle in zip(sweep.b_mode.transmit_delays_s, ANGLES, strict=True):
        slope = np.polyfit(positions_mm(), delays, 1)[0]
        assert slope == pytest.approx(np.sin(angle) / SPEED / 1e3)
        assert delays.min() == 0
    assert sweep.b_mode.sampling_frequency_hz == 4 * FREQUENCY_HZ
    assert sweep.power_doppler.pulse_repetition_hz == pytest.approx(5000)
    period_s = (len(ANGLES) + PULSES + 1) * 200e-6
    np.testing.assert_allclose(sweep.b_mode.timestamps_s, np.arange(FRAMES) * period_s)


@pytest.mark.parametrize("units", ["mm", "wavelengths"])
def test_the_probe_is_the_same_in_either_unit(tmp_path, version, units):
    """Positions, width and lens are in Trans.units; z of the machine points into the body."""
    contents, _ = interleaved()
    contents["Trans"] = trans(units)

    sweep = read_verasonics(save_mat(tmp_path / "arm.mat", contents, version))

    probe = sweep.b_mode.probe
    np.testing.assert_allclose(probe.element_positions_mm[:, 0], positions_mm())
    np.testing.assert_array_equal(probe.element_positions_mm[:, 1:], 0)
    assert probe.element_width_mm == pytest.approx(0.27)
    assert (probe.name, probe.center_frequency_hz) == ("L11-5v", FREQUENCY_HZ)
    assert (probe.elevation_aperture_mm, probe.elevation_focus_mm) == (5, 18)
    start_s = (2 * START_DEPTH - PEAK) / FREQUENCY_HZ - 2 * LENS_S
    assert float(sweep.b_mode.start_time_s[0]) == pytest.approx(start_s)


def echo(times_s):
    """A short pulse at the depth of the echo, as int16."""
    distance = (times_s - ECHO_S) * FREQUENCY_HZ
    return np.rint(2**13 * np.exp(-((distance / 2) ** 2)) * np.cos(2 * np.pi * distance)).astype(
        np.int16
    )


def stored_times(mode: str) -> tuple[np.ndarray, float]:
    """Return when the rows of an acquisition are sampled, and the machine's decimSampleRate."""
    first_s = (2 * START_DEPTH - PEAK) / FREQUENCY_HZ - 2 * LENS_S
    period_s = 1 / FREQUENCY_HZ
    if mode in ("BS100BW", "BS50BW"):
        apart = 1 if mode == "BS100BW" else 2
        pairs = first_s + np.arange(ROWS // 2) * period_s * apart
        return np.stack([pairs, pairs + period_s / 4], 1).ravel(), 4 * FREQUENCY_MHZ
    if mode == "BS67BW":
        return first_s + np.arange(ROWS) * period_s * 3 / 4, 4 / 3 * FREQUENCY_MHZ
    return first_s + np.arange(ROWS) * period_s / 4, 4 * FREQUENCY_MHZ


@pytest.mark.parametrize("mode", ERRORS)
def test_every_sampling_mode_sees_the_same_echo(tmp_path, mode):
    """RF, band-pass sampled RF and quadrature pairs have one baseband signal at a time."""
    times, rate_mhz = stored_times(mode)
    samples = np.tile(echo(times), (1, 1, ELEMENTS, 1))
    contents = workspace([plane_wave(0.0)], [0], samples, sampleMode=mode, decimSampleRate=rate_mhz)

    data = read_verasonics(save_mat(tmp_path / "echo.mat", contents, "5")).b_mode

    iq, start_s, rate_hz = (
        data.samples[0][0, 0],
        float(data.start_time_s[0]),
        data.sampling_frequency_hz,
    )
    if not np.iscomplexobj(iq):
        assert data.demodulation_frequency_hz == 0
        iq = demodulate(iq, rate_hz, FREQUENCY_HZ, start_time_s=start_s)
    else:
        assert data.demodulation_frequency_hz == FREQUENCY_HZ
    at_s = start_s + np.arange(len(iq)) / rate_hz
    envelope = 2**13 * np.exp(-(((at_s - ECHO_S) * FREQUENCY_HZ / 2) ** 2))
    truth = envelope * np.exp(-2j * np.pi * FREQUENCY_HZ * ECHO_S)
    inside = (at_s > 0.3e-6) & (at_s < at_s[-1] - 0.3e-6)
    assert np.abs(truth)[inside].max() > 0.9 * 2**13
    assert np.abs(iq - truth)[inside].max() < ERRORS[mode] * 2**13


def test_interleaved_acquisitions_double_the_rate(tmp_path, version):
    """NS200BWI: the transmit of one acquisition is half a sample later than the other's."""
    late_wavelengths = 1 / 4
    early, late = plane_wave(0.0), plane_wave(0.0)
    late["Delay"] = late["Delay"] + late_wavelengths
    first_s = (2 * START_DEPTH - PEAK) / FREQUENCY_HZ - 2 * LENS_S
    times = first_s + np.arange(ROWS) / (2 * FREQUENCY_HZ)
    pair = np.stack([echo(times - late_wavelengths / FREQUENCY_HZ), echo(times)])
    samples = np.tile(pair[None, :, None], (1, 1, ELEMENTS, 1))
    contents = workspace([late, early], [0, 1], samples, sampleMode="NS200BWI")

    data = read_verasonics(save_mat(tmp_path / "fast.mat", contents, version)).b_mode

    assert data.samples.shape == (1, 1, ELEMENTS, 2 * ROWS)
    assert data.sampling_frequency_hz == 4 * FREQUENCY_HZ
    at_s = float(data.start_time_s[0]) + np.arange(2 * ROWS) / data.sampling_frequency_hz
    np.testing.assert_array_equal(data.samples[0][0, 3], echo(at_s))
    np.testing.assert_array_equal(data.transmit_delays_s[0], 0)


@pytest.mark.parametrize("mode", ["NS200BW", "BS100BW"])
def test_a_point_is_imaged_where_it_is(tmp_path, mode):
    """What the machine would record of a point, lens and pulse included, focuses at the point."""
    lateral, axial = 0.25, 1.6
    times, rate_mhz = stored_times(mode)
    machine_s = times - times[0] + 2 * START_DEPTH / FREQUENCY_HZ
    late_s = PEAK / FREQUENCY_HZ + 2 * LENS_S
    back_s = np.hypot(positions_mm() - lateral, axial) / SPEED / 1e3
    samples = np.empty((1, len(ANGLES), ELEMENTS, ROWS), np.int16)
    for k, angle in enumerate(ANGLES):
        first_fires_s = (positions_mm() * np.sin(angle)).min() / SPEED / 1e3
        out_s = (lateral * np.sin(angle) + axial * np.cos(angle)) / SPEED / 1e3 - first_fires_s
        arrivals = out_s + back_s + late_s
        samples[0, k] = echo(machine_s - arrivals[:, None] + ECHO_S)
    contents = workspace(
        [plane_wave(angle) for angle in ANGLES],
        [0, 1, 2],
        samples,
        sampleMode=mode,
        decimSampleRate=rate_mhz,
    )

    data = read_verasonics(save_mat(tmp_path / "point.mat", contents, "5")).b_mode
    grid = PixelGrid(200, 200, (0.005, 0.005), (-0.25, 1.1))
    image = abs(beamform(data, 0, grid, BeamformSettings(f_number=None)))

    row, column = np.unravel_index(image.argmax(), image.shape)
    assert grid.axial_mm[row] == pytest.approx(axial, abs=DEPTH_ERROR_MM[mode])
    assert grid.lateral_mm[column] == pytest.approx(lateral, abs=LATERAL_ERROR_MM)


@pytest.mark.parametrize("columns", [ELEMENTS, ELEMENTS // 2])
def test_halves_of_the_array_that_receive_in_turn_are_joined(tmp_path, version, columns):
    """A 64LE has 64 receive channels for 128 elements: two acquisitions make one shot."""
    generator = np.random.default_rng(8)
    samples = generator.integers(-99, 99, (2, 4, ELEMENTS, ROWS), np.int16)
    contents = workspace([plane_wave(0.1), laser()], [0, 0, 1, 1], samples)
    halves = [np.repeat([1.0, 0.0], ELEMENTS // 2), np.repeat([0.0, 1.0], ELEMENTS // 2)]
    for k, receive in enumerate(contents["Receive"]):
        receive["Apod"] = halves[k % 2]
    if columns < ELEMENTS:
        contents["Trans"]["Connector"] = np.arange(1.0, ELEMENTS + 1)
        buffer = np.zeros((4 * ROWS, columns, 2), np.int16)
        for k in range(4):
            own = samples[:, k, :columns] if k % 2 == 0 else samples[:, k, columns:]
            buffer[k * ROWS : (k + 1) * ROWS] = own.transpose(2, 1, 0)
        contents["RcvData"] = (buffer,)

    sweep = read_verasonics(save_mat(tmp_path / "le.mat", contents, version))

    half = ELEMENTS // 2
    for data, first in ((sweep.b_mode, 0), (sweep.photoacoustic, 2)):
        assert data.samples.shape == (2, 1, ELEMENTS, ROWS)
        np.testing.assert_array_equal(data.samples[:][:, 0, :half], samples[:, first, :half])
        np.testing.assert_array_equal(data.samples[:][:, 0, half:], samples[:, first + 1, half:])


def test_the_ring_buffer_is_read_from_the_oldest_frame(tmp_path):
    """Frame 1 of RcvData is not the first in time once the buffer went round."""
    contents, samples = interleaved()
    contents["Resource"]["RcvBuffer"]["lastFrame"] = 2.0

    sweep = read_verasonics(save_mat(tmp_path / "arm.mat", contents, "7.3"))

    np.testing.assert_array_equal(sweep.b_mode.samples[:], samples[[2, 0, 1], : len(ANGLES)])


def test_each_modality_may_have_its_own_buffer(tmp_path, version):
    """Photoacoustic frames often go to a receive buffer of their own, shorter than the other."""
    generator = np.random.default_rng(3)
    samples = generator.integers(-99, 99, (2, 2, ELEMENTS, ROWS), np.int16)
    contents = workspace([plane_wave(0.0), laser()], [0, 1], samples)
    (both,) = contents["RcvData"]
    contents["RcvData"] = (both[:ROWS], both[ROWS:])
    for receive in contents["Receive"]:
        if receive["acqNum"] == 2:
            receive.update(bufnum=2.0, acqNum=1.0, startSample=1.0, endSample=float(ROWS - 8))

    sweep = read_verasonics(save_mat(tmp_path / "two.mat", contents, version))

    np.testing.assert_array_equal(sweep.b_mode.samples[:], samples[:, :1])
    np.testing.assert_array_equal(sweep.photoacoustic.samples[:], samples[:, 1:, :, :-8])


def test_silent_elements_do_not_fire(tmp_path):
    """A sub-aperture transmits: the delays of the others are not those of a wave."""
    wave = plane_wave(0.1)
    wave["Apod"] = np.array([0, 0, 1, 1, 1, 1, 1, 0.0])
    contents = workspace([wave], [0], np.ones((1, 1, ELEMENTS, ROWS), np.int16))

    data = read_verasonics(save_mat(tmp_path / "sub.mat", contents, "5")).b_mode

    np.testing.assert_array_equal(np.isfinite(data.transmit_delays_s[0].numpy()), wave["Apod"] != 0)


def test_poses_added_to_the_workspace_are_read(tmp_path, version):
    """A tracked sweep: one pose per frame beside the machine's own variables."""
    contents, _ = interleaved()
    poses = np.tile(np.eye(4)[..., None], FRAMES)
    poses[2, 3] = np.arange(FRAMES) * 0.2
    contents |= {
        "image_to_reference": poses,
        "timestamps_s": np.array([0.0, 0.06, 0.1]),
        "tracked": np.array([1.0, 0.0, 1.0]),
    }

    sweep = read_verasonics(save_mat(tmp_path / "arm.mat", contents, version))

    np.testing.assert_array_equal(sweep.image_to_reference, poses.transpose(2, 0, 1))
    assert sweep.b_mode.timestamps_s.tolist() == [0, 0.06, 0.1]
    assert sweep.tracked.tolist() == [True, False, True]


def test_samples_travel_to_another_process(tmp_path, version):
    """A pool of workers may be given frames that were opened already."""
    contents, samples = interleaved()
    data = read_verasonics(save_mat(tmp_path / "arm.mat", contents, version)).b_mode

    again = pickle.loads(pickle.dumps(data.samples))

    np.testing.assert_array_equal(again[1], samples[1, : len(ANGLES)])


def change(contents, name, value):
    """Set a field, such as ``Receive.sampleMode``, everywhere; ``None`` removes it."""
    parent, _, field = name.rpartition(".")
    nodes = contents if not parent else contents[parent.split(".")[0]]
    for part in parent.split(".")[1:]:
        nodes = nodes[part]
    for node in nodes if isinstance(nodes, list) else [nodes]:
        if value is None:
            del node[field]
        else:
            node[field] = value


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("Trans", None, "has no Trans: save the whole workspace"),
        ("Receive", None, "has no Receive"),
        ("RcvData", (np.zeros((0, 0), np.int16),), "holds no samples"),
        ("RcvData", ("text",), "must be rows x columns x frames"),
        ("RcvData", (np.zeros((100, ELEMENTS, 2), np.int16),), "has 100 rows"),
        ("Receive.sampleMode", "NS300BW", "sampleMode is 'NS300BW', but must be one of"),
        ("Receive.startSample", np.nan, r"Receive\(1\).startSample must be one number"),
        ("Receive.startDepth", None, r"Receive\(1\).startDepth is missing"),
        ("Receive.endSample", 1e6, "writes rows 1 to 1000000"),
        ("Receive.Apod", np.zeros(ELEMENTS), "all zero: nothing was received"),
        ("Receive.Apod", np.ones(3), "must be 8 numbers, one per element"),
        ("Receive.framenum", 7.0, "no entry for the first frame"),
        ("TX.Delay", np.zeros(5), r"TX\(1\).Delay must be 8 numbers"),
        ("TX.Apod", None, r"TX\(1\).Apod is missing"),
        ("Event.rcv", 999.0, r"no Event refers to Receive\(1\)"),
        ("Event", None, "save Event too"),
        ("Trans.units", "furlongs", "must be 'mm' or 'wavelengths', got 'furlongs'"),
        ("Trans.frequency", 0.0, "must be above 0 MHz"),
        ("Trans.ElementPos", np.zeros((8, 2)), "must be elements x 5 numbers, but is 8 x 2"),
        ("Trans.Connector", np.ones((8, 1)), "give each element a channel of its own"),
        ("Trans.HVMux", {"ApertureES": np.zeros((8, 2))}, "multiplexed"),
        ("Resource.Parameters", {"numTransmit": 8.0}, "speedOfSound is missing"),
        ("image_to_reference", np.zeros((4, 4, 9)), "there are 3 frames, but image_to_ref"),
    ],
)
def test_a_workspace_that_contradicts_itself_is_refused(tmp_path, version, name, value, message):
    """One sentence says what is wrong, and where."""
    contents, _ = interleaved()
    change(contents, name, value)
    path = save_mat(tmp_path / "arm.mat", contents, version)

    with pytest.raises((FormatError, ScanError), match=message) as caught:
        read_verasonics(path)

    assert "arm.mat" in str(caught.value)


def test_shots_that_are_not_understood_are_refused(tmp_path):
    """Two ensembles, a lone half of an interleaved pair, and columns that clash."""
    samples = np.ones((1, 4, ELEMENTS, ROWS), np.int16)
    two = workspace([plane_wave(0.1), plane_wave(0.2)], [0, 0, 1, 1], samples)
    lone = workspace([plane_wave(0.1)], [0], samples[:, :1], sampleMode="NS200BWI")
    clash = workspace([plane_wave(0.1)], [0], samples[:, :1])
    clash["RcvData"] = (np.ones((ROWS, 5, 1), np.int16),)

    for contents, message in (
        (two, "2 ensembles"),
        (lone, "must come in pairs"),
        (clash, "multiplexed aperture is not understood"),
    ):
        path = save_mat(tmp_path / "odd.mat", contents, "5")
        with pytest.raises(FormatError, match=message):
            read_verasonics(path)


def test_workspaces_are_recognized(tmp_path, version):
    """RcvData and Trans make a Verasonics workspace."""
    contents, _ = interleaved()

    assert is_verasonics(save_mat(tmp_path / "arm.mat", contents, version))
    assert not is_verasonics(save_mat(tmp_path / "other.mat", {"RF": np.ones((3, 3))}, version))


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> dict[str, bytes]:
    """The bytes of small valid files."""
    folder = tmp_path_factory.mktemp("whole")
    samples = np.ones((1, 2, ELEMENTS, ROWS), np.int16)
    contents = workspace([plane_wave(0.1), laser()], [0, 1], samples)
    packed = save_mat(folder / "packed.mat", contents, "5", do_compression=True).read_bytes()
    return {
        "5": save_mat(folder / "5.mat", contents, "5").read_bytes(),
        "packed": packed,
        "7.3": save_mat(folder / "7.mat", contents, "7.3").read_bytes(),
    }


@pytest.mark.parametrize("kind", ["5", "packed", "7.3"])
@given(data=st.data())
def test_damaged_workspaces_are_explained(tmp_path_factory, whole, kind, data):
    """Bytes lost or changed anywhere give samples or a sentence, nothing else."""
    path = tmp_path_factory.mktemp("damaged") / "arm.mat"
    path.write_bytes(data.draw(damaged(whole[kind])))

    assert_opens_or_explains(lambda: read_verasonics(path))


def test_opening_12_gb_of_receive_buffer_needs_little_memory(tmp_path):
    """A sweep's buffer is larger than memory: only the frames that are looked at are read."""
    contents, _ = interleaved()
    path = save_mat(tmp_path / "long.mat", contents, "7.3")
    with h5py.File(path, "r+") as file:
        rows, frames = len(contents["RcvData"][0]), 12_000_000 // 8
        shape, chunks = (frames, ELEMENTS, rows), (64, ELEMENTS, rows)
        file["RcvData"][0, 0] = file["#refs#"].create_dataset("b", shape, "i2", chunks=chunks).ref

    used = resident_mb_after(
        "from sonosweep.io.verasonics import read_verasonics\n"
        "samples = read_verasonics(path).b_mode.samples\n"
        f"assert len(samples) == {frames} and not any(samples[i].any() for i in (0, 700_000))",
        path,
    )

    assert used < LARGEST_RESIDENT_MB
