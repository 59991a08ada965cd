"""Hypothesis strategies that build our objects from a seed and the few numbers that matter."""

import numpy as np
import torch
from hypothesis import strategies as st

from sonosweep.geometry import pose_from_parts, rotation_from_vector
from sonosweep.scan import Calibration, Scan


@st.composite
def poses(
    draw, count: int | None = None, largest_angle_rad: float = 3.0, largest_mm: float = 200.0
):
    """One random pose, or ``count`` of them, float64."""
    generator = torch.Generator().manual_seed(draw(st.integers(0, 2**31 - 1)))
    n = 1 if count is None else count
    axis = torch.randn(n, 3, generator=generator, dtype=torch.float64)
    axis = axis / torch.linalg.vector_norm(axis, dim=-1, keepdim=True)
    angle = torch.rand(n, 1, generator=generator, dtype=torch.float64) * largest_angle_rad
    shift = (torch.rand(n, 3, generator=generator, dtype=torch.float64) * 2 - 1) * largest_mm
    result = pose_from_parts(rotation_from_vector(axis * angle), shift)
    return result[0] if count is None else result


@st.composite
def sweeps(draw, frames: int = 10, largest_step_mm: float = 1.0, largest_turn_rad: float = 0.05):
    """The poses of a smooth sweep that starts at a random place, float64."""
    first = draw(poses())
    steps = draw(poses(frames - 1, largest_turn_rad, largest_step_mm))
    result = [first]
    for step in steps:
        result.append(result[-1] @ step)
    return torch.stack(result)


@st.composite
def scans(draw, frames: int = 5, rows: int = 16, columns: int = 12):
    """A small tracked scan of random pixels."""
    seed = draw(st.integers(0, 2**31 - 1))
    pixels = np.random.default_rng(seed).integers(0, 256, (frames, rows, columns), dtype=np.uint8)
    return Scan(
        name="made up",
        frames=pixels,
        calibration=Calibration(spacing_mm=(0.2, 0.15), image_to_probe=draw(poses())),
        timestamps_s=torch.arange(frames, dtype=torch.float64) / 20,
        image_to_reference=draw(sweeps(frames)),
    )
