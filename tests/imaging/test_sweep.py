"""A sweep's channel data become a scan in which everything is where it was."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sonosweep.errors import ScanError
from sonosweep.imaging import PixelGrid
from sonosweep.imaging.beamform import BeamformSettings, beamform
from sonosweep.imaging.sweep import SweepImaging, beamform_sweep
from sonosweep.scan import ChannelSweep
from tests.imaging import channel_sweeps as made

GRID = PixelGrid(61, 81, (0.1, 0.1), (-3.0, 2.0))
SETTINGS = SweepImaging(grid=GRID, keep_amplitude=True, clutter_rank=1)  # one still point
PIXEL = 0.101  # mm: the brightest pixel is the nearest to the point


@pytest.fixture(scope="module")
def scan():
    """The beamformed sweep."""
    return beamform_sweep(made.sweep(), SETTINGS)


def brightest_mm(image):
    """Return the lateral and axial place of the brightest pixel."""
    row, column = np.unravel_index(np.argmax(image), image.shape)
    return GRID.lateral_mm[column], GRID.axial_mm[row]


def test_each_modality_shows_its_point(scan):
    """B-mode the tissue, power Doppler the blood 30 dB below it, photoacoustics the absorber."""
    shown = {
        "tissue": (scan.frames[1], made.TISSUE_MM),
        "amplitude": (scan.companions["amplitude"].frames[1], made.TISSUE_MM),
        "blood": (scan.companions["power_doppler"].frames[1], made.BLOOD_MM),
        "absorber": (scan.companions["photoacoustic"].frames[1], made.ABSORBER_MM),
    }
    for what, (image, place) in shown.items():
        assert brightest_mm(image) == pytest.approx(place, abs=PIXEL), what


def test_power_doppler_is_black_where_nothing_flows(scan):
    """Tissue, 30 dB above the blood, is gone."""
    row, column = (
        np.argmin(np.abs(axis - mm))
        for axis, mm in zip((GRID.axial_mm, GRID.lateral_mm), reversed(made.TISSUE_MM), strict=True)
    )

    assert scan.companions["power_doppler"].frames[0][row, column] < 50


def test_frames_share_one_gray_scale(scan):
    """A frame of twice the amplitude is 6 dB brighter, and the amplitude says by how much."""
    first, second = (scan.frames[k].astype(float) for k in (0, 1))
    gray = (first > 0) & (second < 255)
    amplitude = scan.companions["amplitude"].frames

    assert np.abs((second - first)[gray] - 20 * np.log10(2) * 255 / 60).max() < 1.01
    assert np.allclose(amplitude[1], 2 * amplitude[0], rtol=1e-4, atol=1e-6)
    assert scan.frames.dtype == np.uint8
    assert amplitude.dtype == scan.companions["photoacoustic"].frames.dtype == np.float32


def test_white_can_be_given():
    """With the reference that the notes of another sweep tell, gray levels compare."""
    white = 2.0 * float(
        beamform_sweep(made.sweep(), SETTINGS).companions["amplitude"].frames[2].max()
    )

    scan = beamform_sweep(made.sweep(), replace(SETTINGS, b_mode_white=white))

    assert scan.frames[2].max() == round(255 * (1 - 20 * np.log10(2) / 60))
    assert f"255 is an amplitude of {white:.6g}, 0 is 60 dB less" in scan.notes["b_mode"]


def test_poses_move_from_the_face_to_the_first_pixel(scan):
    """A pixel lies where the plane of the array's face says."""
    plane = made.sweep().image_to_reference
    pixel = torch.tensor([7 * 0.1, 11 * 0.1, 0.0, 1.0], dtype=torch.float64)
    in_plane = pixel + torch.tensor([-3.0, 2.0, 0.0, 0.0], dtype=torch.float64)

    assert torch.allclose(scan.image_to_reference @ pixel, plane @ in_plane)


def test_the_scan_says_what_it_is(scan):
    """Pixel size, times, subject, and how each modality was made."""
    assert scan.calibration.spacing_mm == (0.1, 0.1)
    assert scan.timestamps_s.tolist() == [0.0, 0.1, 0.2]
    assert scan.subject == "900001"
    assert scan.notes["made"] == "by a test"
    assert scan.notes["b_mode"].startswith("delay-and-sum of 3 transmits, f-number 1.5, 1540 m/s")
    assert "8 transmits" in scan.notes["power_doppler"]
    assert "clutter filter of rank 1" in scan.notes["power_doppler"]
    assert scan.notes["photoacoustic"].startswith("one-way delay-and-sum of 1 transmit")


def test_frames_are_those_of_the_beamformer(scan):
    """The prepared delays give what beamforming a frame alone does."""
    alone = np.abs(beamform(made.sweep().b_mode, 2, GRID))

    assert np.allclose(scan.companions["amplitude"].frames[2], alone, rtol=1e-4, atol=1e-6)


def test_large_images_are_beamformed_without_prepared_delays(scan, monkeypatch):
    """Where the delays would take too much memory the numbers are the same."""
    monkeypatch.setattr("sonosweep.imaging.sweep.LARGEST_TABLE_BYTES", 0)

    again = beamform_sweep(made.sweep(), SETTINGS)

    for name in scan.companions:
        difference = again.companions[name].frames[1] - scan.companions[name].frames[1].astype(
            float
        )
        assert np.abs(difference).max() <= 1e-4 * scan.companions[name].frames[1].max() + 1 * (
            name == "power_doppler"
        )


def test_doppler_pulses_are_a_b_mode_too():
    """Without B-mode transmits the mean of the pulses shows the tissue."""
    sweep = replace(made.sweep(), b_mode=None)

    scan = beamform_sweep(sweep, SETTINGS)

    assert brightest_mm(scan.frames[0]) == pytest.approx(made.TISSUE_MM, abs=PIXEL)
    assert scan.notes["b_mode"].startswith("mean of Doppler pulses")
    assert set(scan.companions) == {"amplitude", "power_doppler", "photoacoustic"}


def test_photoacoustics_alone():
    """A machine that only listens gives gray levels and the linear amplitude."""
    sweep = ChannelSweep("laser", photoacoustic=made.sweep().photoacoustic)

    scan = beamform_sweep(sweep, replace(SETTINGS, keep_amplitude=False))

    assert scan.frames.dtype == np.uint8
    assert brightest_mm(scan.frames[0]) == pytest.approx(made.ABSORBER_MM, abs=PIXEL)
    assert list(scan.companions) == ["photoacoustic"]
    assert "40 dB" in scan.notes["b_mode"]


def test_photoacoustic_band():
    """Drift far below the band does not show."""
    sweep = made.sweep()
    drift = 30 * np.sin(2 * np.pi * 0.1e6 * np.arange(made.SAMPLES) / made.RATE_HZ)
    samples = (np.asarray(sweep.photoacoustic.samples) + drift).astype(np.float32)
    drifting = ChannelSweep("laser", photoacoustic=replace(sweep.photoacoustic, samples=samples))

    scan = beamform_sweep(drifting, SweepImaging(grid=GRID, photoacoustic_band_hz=(2e6, 8e6)))

    assert brightest_mm(scan.frames[0]) == pytest.approx(made.ABSORBER_MM, abs=PIXEL)


def test_automatic_rank_of_the_clutter_filter():
    """Unless told, as many components are taken out as the singular values say."""
    scan = beamform_sweep(made.sweep(), replace(SETTINGS, clutter_rank="auto"))

    power = scan.companions["power_doppler"].frames[0]
    assert "rank auto" in scan.notes["power_doppler"]
    assert brightest_mm(power) != pytest.approx(made.TISSUE_MM, abs=0.5)


def test_a_silent_sweep_is_black():
    """No echo at all is no error."""
    sweep = made.sweep()
    silent = replace(sweep.b_mode, samples=np.zeros((3, 3, made.ELEMENTS, made.SAMPLES), np.int16))

    scan = beamform_sweep(ChannelSweep("silence", b_mode=silent), SETTINGS)

    assert not scan.frames[0].any()


def with_nan(frame):
    """Return the sweep with one sample that is not a number."""
    sweep = made.sweep()
    samples = np.asarray(sweep.b_mode.samples).copy()
    samples[frame, 1, 5, 9] = np.nan
    return replace(sweep, b_mode=replace(sweep.b_mode, samples=samples))


@pytest.mark.parametrize(
    ("sweep", "settings", "sentence"),
    [
        (with_nan(1), SETTINGS, "frame 1: .* transmit 1, element 5"),
        (made.sweep(), replace(SETTINGS, clutter_rank=8), "from 0 to 7 for 8 pulses, got 8"),
        (
            replace(
                made.sweep(),
                power_doppler=made.data(
                    np.zeros((3, 2, made.ELEMENTS, made.SAMPLES)), made.delays([-0.1, 0.1])
                ),
            ),
            SETTINGS,
            "different transmit delays",
        ),
        (
            made.sweep(),
            replace(SETTINGS, grid=PixelGrid(10, 10, (0.1, 0.1), (0.0, 900.0))),
            "no pixel of the image",
        ),
        (
            ChannelSweep("none", b_mode=made.data(np.zeros((0, 1, 32, 400)), made.delays([0.0]))),
            SETTINGS,
            "'none' has no frames",
        ),
    ],
)
def test_what_cannot_be_beamformed(sweep, settings, sentence):
    """One sentence, before anything is written."""
    with pytest.raises(ScanError, match=sentence):
        beamform_sweep(sweep, settings)


def test_gray_scales_out_of_range():
    """A dynamic range of zero has no gray levels."""
    with pytest.raises(ScanError, match="dynamic range of"):
        SweepImaging(b_mode_range_db=0.0)
    with pytest.raises(ScanError, match="reference amplitude of"):
        SweepImaging(power_doppler_white=-1.0)


def test_all_elements_can_listen():
    """Without an f-number the same point is found."""
    how = BeamformSettings(f_number=None)

    scan = beamform_sweep(made.sweep(), replace(SETTINGS, echoes=how, photoacoustic=how))

    assert brightest_mm(scan.frames[0]) == pytest.approx(made.TISSUE_MM, abs=PIXEL)
    assert "all elements" in scan.notes["b_mode"]
