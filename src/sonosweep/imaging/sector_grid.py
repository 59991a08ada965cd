"""Where the samples of a convex probe's lines lie, before scan conversion."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from sonosweep.errors import ScanError


@dataclass(frozen=True)
class SectorGrid:
    """Samples along lines that fan out from a curved array.

    A sample at angle a and depth d lies at lateral (R + d) sin(a) and axial
    (R + d) cos(a) - R in probe coordinates, R being the radius of the face: lateral 0 is the
    middle of the array, axial 0 its face there.

    Attributes:
        lines: Number of lines, symmetric about the array's middle.
        samples: Along each line.
        line_spacing_rad: Angle between neighbouring lines.
        sample_spacing_mm: Distance between neighbouring samples of a line.
        first_depth_mm: Depth of the first sample below the face.
        radius_mm: Of the face.
    """

    lines: int
    samples: int
    line_spacing_rad: float
    sample_spacing_mm: float
    first_depth_mm: float
    radius_mm: float

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ScanError: If there is no sample, or a size is not positive and finite.
        """
        if self.lines < 1 or self.samples < 1:
            raise ScanError(f"a sector needs samples, got {self.lines} x {self.samples}")
        sizes = (self.line_spacing_rad, self.sample_spacing_mm, self.radius_mm)
        if not all(np.isfinite(value) and value > 0 for value in sizes):
            raise ScanError(f"the sizes of a sector must be above 0, got {sizes}")
        if not (np.isfinite(self.first_depth_mm) and self.first_depth_mm >= 0):
            raise ScanError(f"a sector begins at depth 0 or below, got {self.first_depth_mm:g}")

    @property
    def angles_rad(self) -> Float[np.ndarray, " lines"]:
        """Angle of each line, 0 straight ahead, positive to the right."""
        return self.line_spacing_rad * (np.arange(self.lines) - (self.lines - 1) / 2)

    @property
    def depths_mm(self) -> Float[np.ndarray, " samples"]:
        """Depth of each sample below the face, along its line."""
        return self.first_depth_mm + self.sample_spacing_mm * np.arange(self.samples)
