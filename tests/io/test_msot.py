"""Photoacoustic scans of MSOT machines."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonosweep.errors import FormatError
from sonosweep.io.msot import is_msot, read_msot, read_msot_impulse_response

from .channel_files import assert_opens_or_explains
from .damage import damaged

ELEMENTS, SAMPLES, RADIUS_M = 12, 10, 0.04
WAVELENGTHS = (700, 850)
TICKS = 637371523560823431


def arc(opening_rad: float = 2.0) -> np.ndarray:
    """Elements above the origin, from the right to the left, as the machine stores them."""
    angles = np.linspace(opening_rad, -opening_rad, ELEMENTS)
    return RADIUS_M * np.stack([np.sin(angles), np.cos(angles), 0 * angles], 1)


def write(folder, positions=None, frames: int = 4, remove: str = "", temperature: float = 25.0):
    """Write a scan of alternating wavelengths; returns its stored samples."""
    positions = arc() if positions is None else positions
    elements = "".join(
        '<PROJECTION number="1">'
        + "".join(f'<VALUE axis-ref="{k + 1}">{value!r}</VALUE>' for k, value in enumerate(place))
        + "</PROJECTION>"
        for place in positions.tolist()
    )
    shots = "".join(
        f'<DataModelScanFrame><Frame timestamp="{TICKS + k * 1_000_000}"><Z-POS>{k}</Z-POS>'
        f"<TEMPERATURE>{temperature}</TEMPERATURE><WAVELENGTH>{WAVELENGTHS[k % 2]}</WAVELENGTH>"
        "<LASER-ENERGY>70.5</LASER-ENERGY></Frame></DataModelScanFrame>"
        for k in range(frames)
    )
    text = (
        '<?xml version="1.0" encoding="utf-8"?><DataModelMsotProject>'
        '<HARDWARE-DESC xmlns="Header_Schema"><SAMPLING-FREQUENCY unit="Hz">40'
        f"</SAMPLING-FREQUENCY><TRANSDUCER>msot2</TRANSDUCER><FRAME-DESC>{elements}</FRAME-DESC>"
        f"</HARDWARE-DESC><MEASUREMENT-DESC><RECORDED-LENGTH>{SAMPLES}</RECORDED-LENGTH>"
        "<REPETITION-RATE>10</REPETITION-RATE></MEASUREMENT-DESC>"
        f"<ScanNode><ScanFrames>{shots}</ScanFrames></ScanNode></DataModelMsotProject>"
    )
    stored = np.random.default_rng(3).integers(0, 2**16, (frames, len(positions), SAMPLES), "<u2")
    folder.mkdir(exist_ok=True)
    (folder / "Scan_1.msot").write_text(text.replace(remove, "") if remove else text)
    (folder / "Scan_1.bin").write_bytes(stored.tobytes())
    return stored


def test_frames_of_one_wavelength_are_chosen(tmp_path):
    """Wavelengths alternate; the converter's middle, 32768, is silence."""
    stored = write(tmp_path / "scan")

    sweep = read_msot(tmp_path / "scan", wavelength_nm=850.0)

    data = sweep.photoacoustic
    np.testing.assert_array_equal(data.samples[:][:, 0], stored[1::2].astype(int) - 2**15)
    assert data.samples.dtype == np.int16
    np.testing.assert_allclose(data.timestamps_s, [0, 0.2], atol=1e-6)
    assert (data.sampling_frequency_hz, data.pulse_repetition_hz) == (40e6, 10)
    assert data.transmit_delays_s is None
    assert sweep.notes["laser energy"] == "70.5 to 70.5 mJ"
    assert sweep.notes["stage position"] == "1 to 3 mm"
    with pytest.raises(FormatError, match="has frames at 700, 850 nm: say which"):
        read_msot(tmp_path / "scan")
    with pytest.raises(FormatError, match="no frame at 900 nm"):
        read_msot(tmp_path / "scan", wavelength_nm=900.0)


def test_the_axial_axis_goes_from_the_arc_to_its_middle(tmp_path):
    """The array is turned, not mirrored: first element on the left, the arc above the body."""
    write(tmp_path / "scan")

    probe = read_msot(tmp_path / "scan", wavelength_nm=700.0).photoacoustic.probe

    turned = arc() * [-1e3, -1e3, 1e3]
    np.testing.assert_allclose(probe.element_positions_mm, turned, rtol=0, atol=1e-12)
    chord = 2 * RADIUS_M * 1e3 * np.sin(2.0 / (ELEMENTS - 1))
    assert probe.element_width_mm == pytest.approx(chord)


def test_a_handheld_array_may_lie_in_another_plane(tmp_path):
    """Clinical probes have their arc in x and z; the image plane is the array's."""
    write(tmp_path / "scan", arc(1.0)[:, [0, 2, 1]])

    probe = read_msot(tmp_path / "scan", wavelength_nm=700.0).photoacoustic.probe

    places = probe.element_positions_mm.numpy()
    np.testing.assert_allclose(np.hypot(*places[:, :2].T), 40)
    np.testing.assert_allclose(places[:, 2], 0, atol=1e-12)
    assert (places[:, 1] < 0).all()
    assert (np.diff(places[:, 0]) > 0).all()


def test_the_sound_speed_is_that_of_the_water(tmp_path):
    """Marczak's polynomial gives 1496.7 m/s at 25 °C; without temperature it is assumed."""
    write(tmp_path / "warm")
    write(tmp_path / "unknown", temperature=0.0)

    warm = read_msot(tmp_path / "warm", wavelength_nm=700.0)
    unknown = read_msot(tmp_path / "unknown", wavelength_nm=700.0)

    assert warm.photoacoustic.sound_speed_m_per_s == pytest.approx(1496.7, abs=0.05)
    assert unknown.photoacoustic.sound_speed_m_per_s == 1500
    assert "assumed" in unknown.notes["sound speed"]


@pytest.mark.parametrize(
    ("remove", "message"),
    [
        ("<RECORDED-LENGTH>10</RECORDED-LENGTH>", "has no RECORDED-LENGTH"),
        ("TRANSDUCER", "is no XML"),
        ("40", "SAMPLING-FREQUENCY in 'Scan_1.msot' must be a number"),
        ("<WAVELENGTH>700</WAVELENGTH>", "does not tell the wavelength of its frames"),
    ],
)
def test_a_description_with_gaps_is_refused(tmp_path, remove, message):
    """One sentence says what is missing."""
    write(tmp_path / "scan", remove=remove)

    with pytest.raises(FormatError, match=message):
        read_msot(tmp_path / "scan", wavelength_nm=850.0)


def test_samples_that_do_not_fit_the_description_are_refused(tmp_path):
    """A copy that was cut short, a missing file, an array that is not plane."""
    folder = tmp_path / "scan"
    stored = write(folder)
    (folder / "Scan_1.bin").write_bytes(stored.tobytes()[:-2])
    with pytest.raises(FormatError, match="has 958 bytes, but 4 frames of 12 elements"):
        read_msot(folder)
    (folder / "Scan_1.bin").unlink()
    with pytest.raises(FormatError, match=r"needs 'Scan_1\.bin' beside it"):
        read_msot(folder)
    write(folder, np.random.default_rng(1).random((ELEMENTS, 3)))
    with pytest.raises(FormatError, match="does not lie in a plane"):
        read_msot(folder, wavelength_nm=700.0)
    (folder / "Scan_2.msot").write_text("")
    with pytest.raises(FormatError, match=r"holds 2 \.msot files: name one"):
        read_msot(folder)


def test_a_bomb_of_entities_is_refused(tmp_path):
    """Document types are never read."""
    path = tmp_path / "Scan_1.msot"
    path.write_text('<!DOCTYPE a [<!ENTITY b "bbbb">]><a>&b;</a>')

    with pytest.raises(FormatError, match="declares a document type"):
        read_msot(path)


def test_a_real_scan_is_read(recordings):
    """256 elements on an arc of 40.5 mm, one frame at 700 nm, with its impulse response."""
    folder = recordings / "patato_msot_scan9"

    assert is_msot(folder)
    sweep = read_msot(folder)
    response = read_msot_impulse_response(folder)

    data = sweep.photoacoustic
    assert data.samples.shape == (1, 1, 256, 2030)
    places = data.probe.element_positions_mm.numpy()
    np.testing.assert_allclose(np.hypot(*places[:, :2].T), 40.5)
    assert places[127:129, 1] == pytest.approx([-40.498, -40.498], abs=1e-3)
    assert places[0, 0] < 0 < places[-1, 0]
    assert sweep.notes["wavelength"] == "700 nm"
    assert response.shape == (2030,)
    assert abs(response).argmax() == pytest.approx(2030 / 2, abs=1)  # no delay of its own
    assert response[0] == pytest.approx(0, abs=1e-3)


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> bytes:
    """The bytes of a small valid description."""
    folder = tmp_path_factory.mktemp("whole")
    write(folder, arc()[:3], frames=1)
    return (folder / "Scan_1.msot").read_bytes()


@given(data=st.data())
def test_damaged_descriptions_are_explained(tmp_path_factory, whole, data):
    """Bytes lost or changed anywhere give samples or a sentence, nothing else."""
    folder = tmp_path_factory.mktemp("damaged")
    write(folder, arc()[:3], frames=1)
    (folder / "Scan_1.msot").write_bytes(data.draw(damaged(whole)))

    assert_opens_or_explains(lambda: read_msot(folder))
