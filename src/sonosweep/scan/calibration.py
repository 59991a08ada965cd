"""How pixels become millimetres, and where the image sits on the tracked probe."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sonosweep.errors import ScanError
from sonosweep.geometry import is_rigid, pose_from_parts, scale_pixels

PixelAxes = Literal["column_row", "row_column"]
LARGEST_SPACING_MM = 1000.0  # of no ultrasound pixel: the unit is wrong


@dataclass(frozen=True)
class Calibration:
    """The size of a pixel and, for tracked probes, the place of the image on the probe.

    Everything here is in our image coordinates (x along columns, y along rows, origin at
    the centre of the first pixel). The last two fields remember how the *source* counts
    pixels, for its landmarks and for writing its files again.

    Attributes:
        spacing_mm: Distance between neighbouring columns (lateral) and rows (axial).
        shear: Lateral mm per axial mm by which the image leans; 0 unless a tracker
            calibration found axes that are not perpendicular.
        image_to_probe: Rigid pose of the image on the tracked sensor, mm; ``None`` if not
            tracked or not known.
        latency_s: How much later the frame times are than the tracker's, for the same
            moment: a frame stamped t shows what the tracker saw at t - latency_s.
        pixel_axes: Whether the source writes a pixel as (column, row) or (row, column).
        pixel_origin: Whether the source counts pixels from 0 or from 1.
    """

    spacing_mm: tuple[float, float]
    shear: float = 0.0
    image_to_probe: Float[Tensor, "4 4"] | None = None
    latency_s: float = 0.0
    pixel_axes: PixelAxes = "column_row"
    pixel_origin: Literal[0, 1] = 0

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ScanError: If a spacing is not positive and finite, or a matrix is not rigid.
        """
        for axis, value in zip(("lateral", "axial"), self.spacing_mm, strict=True):
            if not (np.isfinite(value) and 0 < value < LARGEST_SPACING_MM):
                raise ScanError(
                    f"{axis} pixel spacing must be above 0 mm and below"
                    f" {LARGEST_SPACING_MM:g} mm, got {value:g}"
                )
        if not (np.isfinite(self.shear) and abs(self.shear) < 1):
            raise ScanError(f"image shear must be between -1 and 1, got {self.shear:g}")
        if not np.isfinite(self.latency_s):
            raise ScanError(f"latency must be a number of seconds, got {self.latency_s:g}")
        if self.image_to_probe is not None and not bool(is_rigid(self.image_to_probe)):
            raise ScanError("image_to_probe must be rigid: give the pixel size as spacing")


def pixel_to_image(calibration: Calibration) -> Float[Tensor, "4 4"]:
    """Return the matrix from (column, row, 0, 1), counted from 0, to image mm."""
    return scale_pixels(calibration.spacing_mm, calibration.shear)


def calibration_from_matrix(
    pixel_to_probe: Float[Tensor, "4 4"],
    pixel_axes: PixelAxes = "column_row",
    pixel_origin: Literal[0, 1] = 0,
) -> Calibration:
    """Split a measured pixel-to-probe matrix into spacing, shear and a rigid pose.

    The third column is not used: a pixel has no third coordinate, and files disagree on
    what they write there. Our z axis is x cross y.

    Args:
        pixel_to_probe: Affine matrix from the source's pixel numbers to the probe, mm.
        pixel_axes: Which number comes first in the source's pixels.
        pixel_origin: The number of the source's first pixel.

    Raises:
        ScanError: If the matrix holds NaN, or maps the image onto a line.
    """
    matrix = pixel_to_probe.to(torch.float64)
    if not bool(torch.isfinite(matrix).all()):
        raise ScanError("the pixel-to-probe matrix holds values that are not numbers")
    x, y = matrix[:3, 0], matrix[:3, 1]
    if pixel_axes == "row_column":
        x, y = y, x
    origin = matrix[:3, 3] + pixel_origin * (x + y)
    x_spacing = float(torch.linalg.vector_norm(x))
    z = torch.linalg.cross(x, y)
    if not float(torch.linalg.vector_norm(z)) > 1e-12:
        raise ScanError("the pixel-to-probe matrix maps the image onto a line: zero spacing")
    x_axis = x / x_spacing
    z_axis = z / torch.linalg.vector_norm(z)
    y_axis = torch.linalg.cross(z_axis, x_axis)
    y_spacing = float(y @ y_axis)
    return Calibration(
        spacing_mm=(x_spacing, y_spacing),
        shear=float(y @ x_axis) / y_spacing,
        image_to_probe=pose_from_parts(torch.stack((x_axis, y_axis, z_axis), dim=-1), origin),
        pixel_axes=pixel_axes,
        pixel_origin=pixel_origin,
    )
