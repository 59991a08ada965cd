"""Volumes of vessels from sweeps with exact truth: are the vessels where they are?"""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sonosweep.imaging import centered_grid
from sonosweep.imaging.sweep import SweepImaging, beamform_sweep
from sonosweep.reconstruct import (
    PhotoacousticCorrection,
    VolumeSettings,
    correct_photoacoustic,
    reconstruct_scan,
    tracked_trajectory,
)
from sonosweep.scan import Calibration, Companion, Scan, Volume
from sonosweep.simulate import (
    Acquisition,
    Beam,
    Body,
    ChannelSweepSettings,
    Vessel,
    linear_probe_l11_5v,
    simulate_channel_sweep,
)
from sonosweep.simulate.motion import MotionSettings
from sonosweep.simulate.phantoms import default_vessels, vessel_phantom
from sonosweep.simulate.sweep import simulate_sweep
from sonosweep.simulate.sweep_settings import SweepSettings

from ..simulate.bodies import tube
from .centerlines import centerline_errors_mm, crossing_mm

SUBJECT = 900_001
ONE_VOXEL = 1.0
OF_FEW_SCATTERERS = 2.0  # voxels of 0.4 mm: a slice holds some 15 resolved grains of blood
SPEEDS_MM_PER_S = (100.0, 300.0, 200.0)  # of vein, artery and branch: fast enough to be seen


def reconstructed(scan: Scan, voxel_mm: float | None = None) -> dict[str, Volume]:
    """Return the volumes at the true poses."""
    return reconstruct_scan(scan, tracked_trajectory(scan), VolumeSettings(voxel_mm))


def voxels(volume: Volume, errors_mm: np.ndarray) -> np.ndarray:
    """Return distances in voxels."""
    assert len(set(volume.grid.spacing_mm)) == 1
    return errors_mm / volume.grid.spacing_mm[0]


def swept_vessels() -> tuple[Vessel, ...]:
    """Return the phantom's vein, winding artery and branch with blood that Doppler sees."""
    return tuple(
        replace(vessel, mean_speed_mm_per_s=speed)
        for vessel, speed in zip(default_vessels(), SPEEDS_MM_PER_S, strict=True)
    )


@pytest.fixture(scope="module")
def volumes() -> dict[str, Volume]:
    """Volumes of an S-shaped sweep by hand of 36 mm over a phantom with three vessels."""
    motion = MotionSettings(
        shape="S",
        length_mm=36.0,
        frames=60,
        excursion_mm=2.0,
        pauses=0,
        speed_variation=0.3,
        contact_width_mm=28.0,
    )
    settings = SweepSettings(
        SUBJECT,
        motion=motion,
        grid=centered_grid(112, 98, (0.32, 0.32), 0.5),
        modalities=("power_doppler", "photoacoustic"),
    )
    scan = simulate_sweep(settings, vessel_phantom(swept_vessels()))
    correction = PhotoacousticCorrection(reject_skin_mm=1.5, fading_per_mm=0.11)
    return reconstructed(correct_photoacoustic(scan, correction))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("modality", "vessel"),
    [
        ("power_doppler", 0),
        ("power_doppler", 1),
        ("photoacoustic", 0),
        ("photoacoustic", 1),
        ("photoacoustic", 2),
    ],
)
def test_vessels_are_recovered(volumes: dict[str, Volume], modality: str, vessel: int) -> None:
    """With true poses, vessels lie within one voxel of their true center lines."""
    vessels, volume = swept_vessels(), volumes[modality]
    errors = voxels(volume, centerline_errors_mm(volume, vessels[vessel], vessels))
    assert len(errors) >= 15  # slices, of 0.64 mm
    assert not np.isnan(errors).any()
    assert errors.mean() <= ONE_VOXEL
    assert np.percentile(errors, 95) <= ONE_VOXEL


@pytest.mark.slow
def test_modalities_share_one_grid(volumes: dict[str, Volume]) -> None:
    """B-mode, power Doppler and photoacoustic volumes have the same voxels of the body."""
    assert set(volumes) == {"b_mode", "power_doppler", "photoacoustic"}
    assert len({str(volume.grid) for volume in volumes.values()}) == 1


@pytest.mark.slow
def test_a_vessel_elsewhere_is_noticed(volumes: dict[str, Volume]) -> None:
    """The measure is not drawn to the truth: a line beside the vessel is as far as it is."""
    vessels, volume = swept_vessels(), volumes["photoacoustic"]
    beside = np.array([2 * volume.grid.spacing_mm[0], 0.0, 0.0])
    aside = replace(vessels[0], centerline_mm=vessels[0].centerline_mm + beside)
    errors = voxels(volume, centerline_errors_mm(volume, aside))
    assert np.median(errors) == pytest.approx(2.0, abs=0.5)


def drawn(body: Body, shape: tuple[int, int, int], step_mm: float) -> np.ndarray:
    """Return frames across the body, 0.4 mm apart from z = 0, bright in the vessel's lumen."""
    frames = np.zeros(shape, np.float32)
    lateral, axial = step_mm * np.arange(shape[2]) - 8, 4 + step_mm * np.arange(shape[1])
    for k in range(shape[0]):
        center = crossing_mm(body.vessels[0], 0.4 * k)
        assert center is not None
        radius = np.hypot(lateral - center[0], axial[:, None] - center[1])
        frames[k] = np.clip(1.5 - radius, 0, 1)
    return frames


def test_a_drawn_vessel_is_recovered() -> None:
    """A companion of coarser pixels than the B-mode, which begins elsewhere, is in its place."""
    body = tube()
    poses = np.tile(np.eye(4), (16, 1, 1))
    poses[:, 0, 3], poses[:, 1, 3], poses[:, 2, 3] = -9.0, 3.0, 0.4 * np.arange(16)
    vessel = Companion(drawn(body, (16, 30, 40), 0.4), (0.4, 0.4), (1.0, 1.0))
    scan = Scan(
        "drawn",
        np.full((16, 80, 90), 60, np.uint8),
        Calibration((0.2, 0.2)),
        image_to_reference=torch.from_numpy(poses),
        companions={"photoacoustic": vessel},
    )
    volume = reconstructed(scan, voxel_mm=0.4)["photoacoustic"]
    errors = voxels(volume, centerline_errors_mm(volume, body.vessels[0]))
    assert len(errors) >= 12
    assert errors.max() < 0.2  # exact frames: only interpolation between voxels is left


@pytest.mark.slow
def test_from_channel_data_to_volumes() -> None:
    """Beamformed from channel data, a vessel lies where it is in the body, in both modalities."""
    body = tube(skin_mm=0.5)
    poses = np.tile(np.eye(4), (16, 1, 1))
    poses[:, 2, 3] = 0.4 * np.arange(16)
    settings = ChannelSweepSettings(
        angles_rad=(-0.1, 0.0, 0.1),
        pulses=12,
        density_per_mm3=14.0,
        acquisition=Acquisition(samples=560, beam=Beam(elevation_focus_mm=8.0)),
    )
    sweep = simulate_channel_sweep(body, poses, linear_probe_l11_5v(48), settings, SUBJECT)
    imaging = SweepImaging(grid=centered_grid(56, 48, (0.2, 0.2), 3.5), clutter_rank=2)
    scan = beamform_sweep(sweep, imaging)
    volumes = reconstructed(scan)
    for modality in ("power_doppler", "photoacoustic"):
        volume = volumes[modality]
        errors = voxels(volume, centerline_errors_mm(volume, body.vessels[0]))
        assert len(errors) >= 12
        assert not np.isnan(errors).any()
        assert errors.mean() <= ONE_VOXEL
        assert np.percentile(errors, 95) <= OF_FEW_SCATTERERS
