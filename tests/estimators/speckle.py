"""Frames of fully developed speckle with exactly known motion, for tests.

The echo of the medium is a sum of many plane waves with random directions and phases: a
complex Gaussian field whose covariance is exactly Gaussian along each axis, anywhere, for
any pose of the probe. On a flat frame every wave is an outer product, so a frame is one
matrix product. Nothing of the package's estimators is used.
"""

import numpy as np
import torch

from sonosweep.geometry import poses_from_steps, step_from_motion
from sonosweep.scan import Calibration, Scan

AXIAL_MM = 0.30
LATERAL_MM = 0.45
ELEVATIONAL_MM = 0.60
"""Distances at which the complex correlation has fallen to 1/e."""

AMPLITUDE_WIDTH_MM = ELEVATIONAL_MM / np.sqrt(2)
"""Where that of the amplitude has: it is the square of the other, within 2 %."""

WAVES = 1500
SPACING_MM = 0.15


class Medium:
    """A world of speckle, and of slowly varying brightness if ``structure`` is above 0.

    Args:
        seed: Which world.
        structure: Standard deviation of the logarithm of its echogenicity.
        structure_mm: Size of what is brighter or darker.
    """

    def __init__(self, seed: int, structure: float = 0.0, structure_mm: float = 2.0) -> None:
        rng = np.random.default_rng(seed)
        scale = np.sqrt(2) / np.array([LATERAL_MM, AXIAL_MM, ELEVATIONAL_MM])
        self._waves = rng.standard_normal((WAVES, 3)) * scale
        self._weights = rng.standard_normal(WAVES) + 1j * rng.standard_normal(WAVES)
        self._slow_waves = rng.standard_normal((200, 3)) * (np.sqrt(2) / structure_mm)
        phases = np.exp(2j * np.pi * rng.random(200))
        self._slow_weights = phases * structure / np.sqrt(100) if structure else None

    def amplitude(self, image_to_world: np.ndarray, rows: int, columns: int) -> np.ndarray:
        """Return the echo amplitude of one frame; 1 is its root mean square."""
        echo = _field(self._waves, self._weights, image_to_world, rows, columns)
        amplitude = np.abs(echo) / np.sqrt(2 * WAVES)
        if self._slow_weights is None:
            return amplitude
        slow = _field(self._slow_waves, self._slow_weights, image_to_world, rows, columns)
        return amplitude * np.exp(slow.real)


def _field(waves, weights, image_to_world, rows, columns) -> np.ndarray:
    x = np.arange(columns) * SPACING_MM
    y = np.arange(rows) * SPACING_MM
    # Single precision for the products: 1e-6 of an amplitude is no gray level.
    along_x = np.exp(1j * np.outer(x, waves @ image_to_world[:3, 0])).astype(np.complex64)
    along_y = np.exp(1j * np.outer(y, waves @ image_to_world[:3, 1])).astype(np.complex64)
    here = (weights * np.exp(1j * waves @ image_to_world[:3, 3])).astype(np.complex64)
    return (along_y * here) @ along_x.T


def sweep(
    motion: np.ndarray,
    seed: int = 0,
    rows: int = 128,
    columns: int = 128,
    structure: float = 0.0,
    structure_mm: float = 2.0,
    persistence: float = 0.0,
    noise: float = 0.0,
) -> Scan:
    """Return a tracked scan of a probe that moves by ``motion`` (mm, rad) per step.

    Args:
        motion: One row of six per step.
        seed: Which medium.
        rows: Of a frame.
        columns: Of a frame.
        structure: How much the medium's brightness varies; 0 is pure speckle.
        structure_mm: Size of what is brighter or darker.
        persistence: Part of the shown frame that is the previous shown frame, as scanners
            average; 0 for none.
        noise: Root mean square of electronic noise, relative to the echoes.
    """
    medium = Medium(seed, structure, structure_mm)
    rng = np.random.default_rng(seed + 1)
    steps = step_from_motion(torch.as_tensor(motion, dtype=torch.float64))
    poses = poses_from_steps(steps, torch.eye(4, dtype=torch.float64))
    frames, shown = [], None
    for pose in poses:
        amplitude = medium.amplitude(pose.numpy(), rows, columns)
        if noise:
            amplitude = np.hypot(amplitude, noise * rng.standard_normal(amplitude.shape))
        gray = 200 + 255 / 60 * 20 * np.log10(np.maximum(amplitude, 1e-6))
        shown = gray if shown is None else persistence * shown + (1 - persistence) * gray
        frames.append(np.clip(np.rint(shown), 0, 255).astype(np.uint8))
    return Scan(
        name="made of waves",
        frames=np.stack(frames),
        calibration=Calibration(spacing_mm=(SPACING_MM, SPACING_MM)),
        timestamps_s=torch.arange(len(frames), dtype=torch.float64) / 20,
        image_to_reference=poses,
    )
