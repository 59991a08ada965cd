"""Where the pixels of a beamformed or simulated frame lie in front of the probe."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from sonosweep.errors import ScanError


@dataclass(frozen=True)
class PixelGrid:
    """A regular grid of pixels in the probe's imaging plane.

    Attributes:
        columns: Pixels along the lateral axis.
        rows: Pixels along the axial axis.
        spacing_mm: Distance between neighbouring columns (lateral) and rows (axial).
        origin_mm: Centre of the first pixel in probe coordinates (lateral, axial): lateral
            0 is the middle of the array, axial 0 its face.
    """

    columns: int
    rows: int
    spacing_mm: tuple[float, float]
    origin_mm: tuple[float, float]

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ScanError: If there is no pixel, or a spacing is not positive and finite.
        """
        if self.columns < 1 or self.rows < 1:
            raise ScanError(f"an image needs pixels, got {self.columns} x {self.rows}")
        if not all(np.isfinite(value) and value > 0 for value in self.spacing_mm):
            raise ScanError(f"pixel spacing must be above 0 mm, got {self.spacing_mm}")
        if not np.isfinite(self.origin_mm).all():
            raise ScanError(f"the origin of an image must be finite, got {self.origin_mm}")

    @property
    def lateral_mm(self) -> Float[np.ndarray, " columns"]:
        """Lateral coordinate of each column."""
        return self.origin_mm[0] + self.spacing_mm[0] * np.arange(self.columns)

    @property
    def axial_mm(self) -> Float[np.ndarray, " rows"]:
        """Depth of each row below the face of the array."""
        return self.origin_mm[1] + self.spacing_mm[1] * np.arange(self.rows)


def centered_grid(
    columns: int, rows: int, spacing_mm: tuple[float, float], first_depth_mm: float = 0.0
) -> PixelGrid:
    """Return a grid whose columns lie symmetrically in front of the array."""
    return PixelGrid(
        columns, rows, spacing_mm, (-spacing_mm[0] * (columns - 1) / 2, float(first_depth_mm))
    )


PAPER_GRID = centered_grid(256, 256, (0.1484, 0.1484), 0.5)
