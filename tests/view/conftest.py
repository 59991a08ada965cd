"""A small sweep over a bright ball, reconstructed twice."""

import math

import numpy as np
import pytest
import torch

from sonosweep.geometry import pose_from_parts, poses_from_steps, rotation_from_vector
from sonosweep.scan import Trajectory, Volume, VolumeGrid
from sonosweep.view import Report, ReportRun

FRAMES = 20
GRID = VolumeGrid((40, 30, 20), (0.5, 0.5, 1.0), (-1.0, -2.0, -3.0))


def ball(center: tuple[float, float, float], dtype: type = np.uint8) -> np.ndarray:
    """Voxels of GRID, 200 inside of a ball of 5 mm about a place in mm, 20 outside."""
    z, y, x = np.indices(GRID.size[::-1])
    along = (
        origin + index * spacing
        for origin, index, spacing in zip(GRID.origin_mm, (x, y, z), GRID.spacing_mm, strict=True)
    )
    squared = sum((mm - c) ** 2 for mm, c in zip(along, center, strict=True))
    return np.where(squared < 25, 200, 20).astype(dtype)


def straight(step_mm: float, std: float | None = None) -> Trajectory:
    """Frames that follow each other along z, turning a little about y."""
    turn = rotation_from_vector(torch.tensor([0.0, math.radians(1.0), 0.0], dtype=torch.float64))
    step = pose_from_parts(turn, torch.tensor([0.0, 0.0, step_mm], dtype=torch.float64))
    poses = poses_from_steps(step.expand(FRAMES - 1, 4, 4), first=torch.eye(4, dtype=torch.float64))
    bands = None if std is None else torch.full((FRAMES - 1, 6), std, dtype=torch.float64)
    return Trajectory(poses, step_std=bands, method="tracked" if std is None else "decorrelation")


@pytest.fixture
def tracked_volume() -> Volume:
    """A ball with its centre in the middle."""
    return Volume(ball((9.0, 5.5, 6.5)), GRID)


@pytest.fixture
def report(tracked_volume: Volume) -> Report:
    """A tracked and a sensorless reconstruction with everything a report can hold."""
    doppler = Volume(ball((12.0, 5.5, 6.5)) // 2, GRID)
    metrics = {
        "final_drift_mm": (3.14159, "mm"),
        "final_drift_rate_path_percent": (17.25, "%"),
        "psnr_db": (None, "dB"),
        "our own": (-0.000123, "mm"),
    }
    frames = np.random.default_rng(0).integers(0, 256, (FRAMES, 48, 64), dtype=np.uint8)
    return Report(
        title="Ball",
        facts=(("Frames", "20"), ("Scan", "ball.h5")),
        runs=(
            ReportRun("tracked", straight(0.5), tracked_volume, {"power Doppler": doppler}),
            ReportRun(
                "sensorless",
                straight(0.4, 0.02),
                Volume(ball((9.0, 5.5, 5.0)), GRID),
                {},
                metrics,
                np.linspace(0, 3.14159, FRAMES),
            ),
        ),
        verdict=("It drifts by 3.14 mm.",),
        assumptions=("The sweep went forward.",),
        outputs=("volume.nrrd", "trajectory.csv"),
        command="sonosweep demo",
        versions={"sonosweep": "0.1.0"},
        frames=frames,
        spacing_mm=(0.3, 0.25),
    )
