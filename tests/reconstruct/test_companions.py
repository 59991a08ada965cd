"""Companions: which become volumes, and what happens to photoacoustic frames before."""

import math

import numpy as np
import pytest
import torch

from sonosweep.errors import ScanError
from sonosweep.reconstruct import reconstruct_scan, tracked_trajectory
from sonosweep.reconstruct.companions import (
    PhotoacousticCorrection,
    correct_photoacoustic,
    left_out,
)
from sonosweep.scan import Calibration, Companion, Scan

FRAMES, ROWS, COLUMNS = 4, 20, 10
STEP_MM = 0.5  # between rows


def scan_with(**frames: np.ndarray) -> Scan:
    """Return a straight sweep with companions whose first row is 1 mm below the image's top."""
    poses = torch.eye(4, dtype=torch.float64).repeat(FRAMES, 1, 1)
    poses[:, 2, 3] = torch.arange(FRAMES) * 0.5
    return Scan(
        "sweep",
        np.full((FRAMES, ROWS, COLUMNS), 9, np.uint8),
        Calibration((0.5, STEP_MM)),
        image_to_reference=poses,
        companions={k: Companion(v, (0.5, STEP_MM), (0.0, 1.0)) for k, v in frames.items()},
    )


def stack(
    dtype: type = np.float32, value: float = 1.0, channels: tuple[int, ...] = ()
) -> np.ndarray:
    """Return frames of one value."""
    return np.full((FRAMES, ROWS, COLUMNS, *channels), value, dtype)


def test_images_become_volumes() -> None:
    """Gray, float and colour companions become volumes; IQ in either form does not."""
    scan = scan_with(
        power_doppler=stack(np.uint8, 7),
        amplitude=stack(np.float32),
        color=stack(np.uint8, 3, (3,)),
        iq=stack(np.complex64),
        iq_pair=stack(np.float32, 1.0, (2,)),
        labels=stack(np.int64),
    )
    volumes = reconstruct_scan(scan, tracked_trajectory(scan))
    assert set(volumes) == {"b_mode", "power_doppler", "amplitude", "color"}
    assert volumes["power_doppler"].voxels.max() == 7
    reasons = left_out(scan)
    assert set(reasons) == {"iq", "iq_pair", "labels"}
    assert "complex" in reasons["iq"]
    assert "int64" in reasons["labels"]


def test_light_is_compensated() -> None:
    """Absorbers of one strength under exp(-mu d) of light look alike after compensation."""
    depth_mm = 1.0 + STEP_MM * np.arange(ROWS)
    faded = np.exp(-0.11 * depth_mm)[:, None] * stack()
    scan = correct_photoacoustic(
        scan_with(photoacoustic=faded.astype(np.float32)),
        PhotoacousticCorrection(fading_per_mm=0.11),
    )
    single_precision = 1e-6
    np.testing.assert_allclose(scan.companions["photoacoustic"].frames[2], 1, rtol=single_precision)


def test_decibels_are_added() -> None:
    """In log-compressed frames of 60 dB, light lost by 6.02 dB at some depth adds 25.6 levels."""
    settings = PhotoacousticCorrection(fading_per_mm=math.log(2) / 5.0, range_db=60.0)
    scan = correct_photoacoustic(scan_with(photoacoustic=stack(np.uint8, 100)), settings)
    gray = scan.companions["photoacoustic"].frames[0]
    five_mm_deep = round((5.0 - 1.0) / STEP_MM)
    assert gray[five_mm_deep, 0] == 100 + round(255 * 20 * math.log10(2) / 60)
    black = correct_photoacoustic(scan_with(photoacoustic=stack(np.uint8, 0)), settings)
    assert not black.companions["photoacoustic"].frames[0].any()


def test_bright_pixels_stay_white() -> None:
    """Compensation does not run over the largest gray level."""
    settings = PhotoacousticCorrection(fading_per_mm=1.0, range_db=20.0)
    scan = correct_photoacoustic(scan_with(photoacoustic=stack(np.uint8, 200)), settings)
    assert (scan.companions["photoacoustic"].frames[0] == 255).sum() > 0
    assert (np.diff(scan.companions["photoacoustic"].frames[0].astype(int), axis=0) >= 0).all()
    raw = correct_photoacoustic(scan_with(photoacoustic=stack(np.int16, -30_000)), settings)
    assert (raw.companions["photoacoustic"].frames[0] == -(2**15)).all()


def test_skin_is_rejected() -> None:
    """What is less deep than the skin is black; what is deeper and other companions stay."""
    scan = scan_with(photoacoustic_750nm=stack(), power_doppler=stack())
    found = correct_photoacoustic(scan, PhotoacousticCorrection(reject_skin_mm=2.0))
    frames = found.companions["photoacoustic_750nm"].frames
    above = round((2.0 - 1.0) / STEP_MM)
    assert not frames[:][:, :above].any()
    assert (frames[:][:, above:] == 1).all()
    assert found.companions["power_doppler"] is scan.companions["power_doppler"]


def test_corrections_that_cannot_be() -> None:
    """Nothing to correct, or a negative depth, is said in one sentence."""
    fading = PhotoacousticCorrection(fading_per_mm=0.1)
    with pytest.raises(ScanError, match="has no photoacoustic frames to correct"):
        correct_photoacoustic(scan_with(power_doppler=stack()), PhotoacousticCorrection(1.0))
    with pytest.raises(ScanError, match="must be 0 or above, got -1"):
        PhotoacousticCorrection(reject_skin_mm=-1.0)
    with pytest.raises(ScanError, match="--photoacoustic-range-db"):
        correct_photoacoustic(scan_with(photoacoustic=stack(np.uint8)), fading)
    with pytest.raises(ScanError, match="dynamic range"):
        PhotoacousticCorrection(range_db=0.0)
    amplitudes = scan_with(photoacoustic=stack())
    with pytest.raises(ScanError, match=r"nothing would be left .* skin to reject is 900 mm"):
        correct_photoacoustic(amplitudes, PhotoacousticCorrection(reject_skin_mm=900.0))
    with pytest.raises(ScanError, match=r"100 per mm would brighten .* by \d+ dB"):
        correct_photoacoustic(amplitudes, PhotoacousticCorrection(fading_per_mm=100.0))
