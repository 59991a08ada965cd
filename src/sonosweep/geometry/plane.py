"""Points of a frame: its corners and its pixel grid, in image coordinates.

A pixel is ``(column, row)`` with centres at integers; the origin of image coordinates is
the centre of pixel (0, 0), x runs along columns and y along rows.
"""

import torch
from jaxtyping import Float
from torch import Tensor


def scale_pixels(spacing_mm: tuple[float, float], shear: float = 0.0) -> Float[Tensor, "4 4"]:
    """Return ``pixel_to_image``: (column, row, 0) to image coordinates in mm.

    Args:
        spacing_mm: Distance between neighbouring columns and between neighbouring rows.
        shear: How many mm the image leans to the right per mm of depth; 0 for a scanner,
            but a tracker calibration can find axes that are not quite perpendicular.
    """
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[0, 0], matrix[1, 1] = spacing_mm
    matrix[0, 1] = shear * spacing_mm[1]
    return matrix


def frame_corners(
    rows: int, columns: int, spacing_mm: tuple[float, float]
) -> Float[Tensor, "points=4 xyz=3"]:
    """Return the centres of the four corner pixels, clockwise from pixel (0, 0)."""
    right, bottom = (columns - 1) * spacing_mm[0], (rows - 1) * spacing_mm[1]
    corners = [[0, 0, 0], [right, 0, 0], [right, bottom, 0], [0, bottom, 0]]
    return torch.tensor(corners, dtype=torch.float64)


def pixel_grid(
    rows: int, columns: int, spacing_mm: tuple[float, float], step: int = 1
) -> Float[Tensor, "points xyz=3"]:
    """Return the centres of the pixels, row by row, every ``step``-th of both axes."""
    x = torch.arange(0, columns, step, dtype=torch.float64) * spacing_mm[0]
    y = torch.arange(0, rows, step, dtype=torch.float64) * spacing_mm[1]
    grid_y, grid_x = torch.meshgrid(y, x, indexing="ij")
    return torch.stack((grid_x, grid_y, torch.zeros_like(grid_x)), dim=-1).reshape(-1, 3)
