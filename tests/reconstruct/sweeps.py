"""Small sweeps with known truth, for the tests of compounding."""

import numpy as np
import torch

from sonosweep.geometry import pose_from_parts, rotation_from_euler, scale_pixels

PIXEL_TO_IMAGE = scale_pixels((0.2, 0.2))


def winding_sweep(frames: int, length_mm: float = 6.0) -> torch.Tensor:
    """Return poses along z that also move and turn sideways, at uneven speed."""
    s = torch.linspace(0, 1, frames, dtype=torch.float64)
    s = s + 0.02 * torch.sin(7 * s)
    place = torch.stack((torch.sin(4 * s), 0.3 * s, length_mm * s), dim=-1)
    angles = torch.stack((0.1 * torch.sin(5 * s), 0.2 * torch.cos(6 * s), 0.1 * s), dim=-1)
    return pose_from_parts(rotation_from_euler(angles, "XYZ"), place)


def phantom(points_mm: np.ndarray) -> np.ndarray:
    """Return the gray level of a smooth texture with a bright sheet, between 20 and 230."""
    x, y, z = points_mm[..., 0], points_mm[..., 1], points_mm[..., 2]
    texture = np.sin(2 * x) * np.cos(1.6 * y + 0.5) + np.sin(1.3 * z + x)
    sheet = 60 * np.exp(-(((y - 3.5 - 0.2 * x) / 0.8) ** 2))
    return 100 + 30 * texture + sheet


def frames_of_phantom(
    image_to_reference: torch.Tensor,
    rows: int,
    columns: int,
    noise: float = 0.0,
    pixel_to_image: torch.Tensor = PIXEL_TO_IMAGE,
) -> np.ndarray:
    """Return what frames at these poses see, with multiplicative noise like speckle's."""
    row, column = np.mgrid[:rows, :columns]
    pixels = np.stack((column, row, 0 * row, 1 + 0 * row), axis=-1).reshape(-1, 4)
    matrix = (image_to_reference @ pixel_to_image).numpy()
    points = np.einsum("fij,pj->fpi", matrix[:, :3], pixels)
    clean = phantom(points).reshape(-1, rows, columns)
    random = np.random.default_rng(1).standard_normal(clean.shape)
    return np.clip(np.rint(clean * (1 + noise * random)), 0, 255).astype(np.uint8)
