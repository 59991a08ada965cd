"""How a probe sees a scatterer: pulse, lateral and elevational beam."""

from dataclasses import dataclass

import numpy as np

from sonosweep.errors import ScanError


@dataclass(frozen=True)
class Beam:
    """A separable point spread function with a Gaussian elevational beam.

    The defaults are those of an L11-5v with 31 plane waves.

    Attributes:
        center_frequency_hz: Of the received echoes; below the probe's nominal one.
        axial_fwhm_mm: Of the envelope along the beam.
        lateral_fwhm_mm: Of the envelope across it, at every depth; of a sector, at the
            ``sector_depth_mm`` below its face.
        elevation_waist_mm: w0: the complex correlation of speckle falls to
            exp(-d^2 / w0^2) after an elevational displacement d.
        elevation_focus_mm: Depth below the face at which the slice is thinnest.
        sound_speed_m_per_s: In tissue.
        curvature_radius_mm: Of a convex array's face; ``None`` for a linear array.
    """

    center_frequency_hz: float = 6.6e6
    axial_fwhm_mm: float = 0.167
    lateral_fwhm_mm: float = 0.343
    elevation_waist_mm: float = 0.60
    elevation_focus_mm: float = 18.0
    sound_speed_m_per_s: float = 1540.0
    curvature_radius_mm: float | None = None
    sector_depth_mm: float = 40.0

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ScanError: If one is not positive and finite.
        """
        for name, value in vars(self).items():
            if value is not None and not (np.isfinite(value) and value > 0):
                raise ScanError(f"{name} of a beam must be above 0, got {value:g}")

    @property
    def wavelength_mm(self) -> float:
        """Wavelength at the center frequency."""
        return self.sound_speed_m_per_s * 1e3 / self.center_frequency_hz
