"""Real channel data: a disk that turns, and a mouse in a ring of detectors."""

import numpy as np
import pytest
from scipy import ndimage, signal
from scipy.io import loadmat

from sonosweep.imaging import PixelGrid, centered_grid
from sonosweep.imaging.beamform import BeamformSettings, beamform, prepare_beamformer
from sonosweep.imaging.bmode import log_compress
from sonosweep.imaging.doppler import axial_velocity
from sonosweep.io.open_channel_data import open_channel_data
from sonosweep.metrics.image import normalized_variance
from sonosweep.scan import modalities

DISK_GRID = PixelGrid(251, 251, (0.1, 0.1), (-12.5, 10.0))
"""That of the reference B-mode movie."""
DISK_MM, RADIUS_MM = (-0.8, 22.55), 10.2
TURN_RAD_PER_S = 61.0
REFERENCE = BeamformSettings(f_number=1.0, bandwidth_hz=0.8e6)
"""A narrow band, whose speckle is as long as the reference's."""


@pytest.fixture(scope="module")
def disk(recordings):
    """Channel data of a plane wave sent 10,000 times a second onto a turning disk."""
    return modalities(open_channel_data(recordings / "pymust_rotating_disk" / "PWI_disk.mat"))[
        "b_mode"
    ]


def within_disk(part=0.8):
    """Return which pixels are on the disk, and their lateral and axial place."""
    lateral, axial = np.meshgrid(DISK_GRID.lateral_mm, DISK_GRID.axial_mm)
    inside = np.hypot(lateral - DISK_MM[0], axial - DISK_MM[1]) < part * RADIUS_MM
    return inside, lateral[inside], axial[inside]


def test_velocity_of_the_turning_disk(disk):
    """The lag-one phase is that of a solid body: velocity away grows across, not with depth."""
    iq = prepare_beamformer(disk, DISK_GRID).apply(disk.samples[:])
    velocity = axial_velocity(
        iq,
        disk.probe.center_frequency_hz,
        disk.pulse_repetition_hz,
        disk.sound_speed_m_per_s,
        window=(5, 5),
    )
    inside, lateral, axial = within_disk()
    system = np.column_stack([lateral, axial, np.ones_like(lateral)])

    across, down, _ = np.linalg.lstsq(system, velocity[inside], rcond=None)[0]

    assert across == pytest.approx(TURN_RAD_PER_S, rel=0.03)
    assert abs(down) < 0.03 * TURN_RAD_PER_S


@pytest.mark.parametrize("frame", [0, 20])
def test_b_mode_of_the_disk_looks_like_its_reference(disk, recordings, frame):
    """Another program's movie of the same samples, speckle by speckle."""
    movie = loadmat(recordings / "pymust_rotating_disk" / "bmode_PWI_disk.mat")["I"]

    amplitude = np.abs(beamform(disk, frame, DISK_GRID, REFERENCE))

    gray = log_compress(amplitude, float(amplitude.max()), 30.0)
    assert np.corrcoef(gray.ravel(), movie[:, :, frame].ravel())[0, 1] > 0.94


def test_beamforming_by_hand_gives_the_same_disk(disk):
    """The sum of delayed analytic signals, written down directly, at some pixels."""
    samples = np.asarray(disk.samples[0])[0].astype(float)
    rate, carrier = disk.sampling_frequency_hz, disk.probe.center_frequency_hz
    start = float(disk.start_time_s[0])
    time = start + np.arange(samples.shape[1]) / rate
    mixed = samples * np.exp(-2j * np.pi * carrier * time)
    taps = signal.firwin(41, 1.4e6, fs=rate)
    baseband = 2 * ndimage.convolve1d(mixed, taps, axis=1, mode="constant")
    x, z = np.meshgrid(np.arange(-6, 5, 0.5), np.arange(16, 28, 0.5))
    image, speed = np.zeros(x.shape, complex), disk.sound_speed_m_per_s * 1e3
    for element, place in enumerate(disk.probe.element_positions_mm[:, 0].numpy()):
        flight = (z + np.hypot(x - place, z)) / speed
        heard = np.interp(flight, time, baseband[element]) * np.exp(2j * np.pi * carrier * flight)
        image += heard * (np.abs(x - place) <= z / (2 * 1.5))
    grid = PixelGrid(x.shape[1], x.shape[0], (0.5, 0.5), (-6.0, 16.0))

    ours = beamform(disk, 0, grid)

    assert abs(np.vdot(ours, image)) / np.linalg.norm(ours) / np.linalg.norm(image) > 0.97


def test_the_mouse_is_sharpest_at_the_speed_of_sound_in_warm_water(recordings):
    """Organs focus between 1470 and 1510 m/s: there the envelope varies most about its mean."""
    data = modalities(open_channel_data(recordings / "patato_msot_scan9"))["photoacoustic"]
    speeds = np.arange(1430.0, 1551.0, 10.0)
    grid = centered_grid(96, 96, (0.25, 0.25), -11.875)

    sharpness = [
        normalized_variance(
            np.abs(beamform(data, 0, grid, BeamformSettings(None, sound_speed_m_per_s=speed)))
        )
        for speed in speeds.tolist()
    ]

    best = int(np.argmax(sharpness))
    assert 1470 <= speeds[best] <= 1510
    assert sharpness[best] > 1.15 * max(sharpness[0], sharpness[-1])
