"""Options that say how photoacoustic frames are corrected before they become a volume."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

from cyclopts import Group, Parameter

if TYPE_CHECKING:
    from sonosweep.reconstruct import PhotoacousticCorrection

PHOTOACOUSTIC = Group("Photoacoustic", sort_key=2)


@Parameter(name="*", group=PHOTOACOUSTIC)
@dataclass(frozen=True)
class PhotoacousticOptions:
    """How photoacoustic frames are corrected.

    Attributes:
        reject_skin_mm: Set what is less deep below the top of the image to 0: skin absorbs
            more light than vessels.
        depth_compensation_per_mm: Multiply amplitudes by exp(this x depth in mm): how fast
            light fades in the tissue, about 0.1 per mm.
        photoacoustic_range_db: Dynamic range of 8-bit frames, whose gray levels are decibels;
            to compensate for depth it must be known.
    """

    reject_skin_mm: float = 0.0
    depth_compensation_per_mm: float = 0.0
    photoacoustic_range_db: float | None = None


def photoacoustic_correction(options: PhotoacousticOptions) -> "PhotoacousticCorrection":
    """Return the correction that the options ask for.

    Raises:
        ScanError: If a number is out of range, or an option has nothing to act on.
    """
    from sonosweep.errors import ScanError
    from sonosweep.reconstruct import PhotoacousticCorrection

    if options.photoacoustic_range_db is not None and options.depth_compensation_per_mm == 0:
        raise ScanError("--photoacoustic-range-db needs --depth-compensation-per-mm too")
    return PhotoacousticCorrection(
        options.reject_skin_mm,
        options.depth_compensation_per_mm,
        options.photoacoustic_range_db,
    )
