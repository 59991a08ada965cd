"""Which companions become volumes, and what is done to photoacoustic ones before.

A companion becomes a volume if its frames are images: one real number per pixel, or colour.
Complex frames and pairs of real and imaginary parts (IQ) do not: their phase turns within
a fraction of a voxel, so that a mean over frames would cancel it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from sonosweep.errors import ScanError
from sonosweep.reconstruct.blocks import SUPPORTED
from sonosweep.scan import Companion, LazyFrames, Scan

PHOTOACOUSTIC = "photoacoustic"
MOST_GAIN_DB = 200.0
"""Of a depth compensation: 0.3 per mm over 75 mm; beyond, numbers overflow."""
IMAGE_CHANNELS = (1, 3, 4)  # gray, colour, colour with opacity


def left_out(scan: Scan) -> dict[str, str]:
    """Return the companions that do not become volumes, and for each one why, in words."""
    reasons = {name: _why_not(companion) for name, companion in scan.companions.items()}
    return {name: reason for name, reason in reasons.items() if reason}


def image_companions(scan: Scan) -> dict[str, Companion]:
    """Return the companions that become volumes."""
    others = left_out(scan)
    return {name: one for name, one in scan.companions.items() if name not in others}


def _why_not(companion: Companion) -> str:
    shape, dtype = tuple(companion.frames.shape), np.dtype(companion.frames.dtype)
    if np.issubdtype(dtype, np.complexfloating):
        return "it is complex, and phase cannot be averaged over frames"
    if len(shape) == 4 and shape[3] == 2:
        return "it has two channels, as IQ has, and phase cannot be averaged over frames"
    if len(shape) not in (3, 4) or (len(shape) == 4 and shape[3] not in IMAGE_CHANNELS):
        return f"its frames of shape {shape[1:]} are no images"
    if dtype.name not in SUPPORTED:
        return f"its pixels are of type {dtype.name}, not {', '.join(SUPPORTED)}"
    return ""


@dataclass(frozen=True)
class PhotoacousticCorrection:
    """What is done to photoacoustic frames before they become a volume.

    Depth is measured from the top of the B-mode image.

    Attributes:
        reject_skin_mm: Pixels less deep are set to 0: skin absorbs more light than vessels.
        fading_per_mm: Of the light's fluence with depth (its effective attenuation
            coefficient); pixels are multiplied by exp(fading * depth).
        range_db: Dynamic range between black and white of 8-bit frames, whose gray levels are
            decibels: they are brightened by as many decibels. Pixels of other types are
            amplitudes.
    """

    reject_skin_mm: float = 0.0
    fading_per_mm: float = 0.0
    range_db: float | None = None

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ScanError: If one is negative or not finite.
        """
        for what, value in (
            ("depth of the skin to reject (mm)", self.reject_skin_mm),
            ("fading of light (per mm)", self.fading_per_mm),
        ):
            if not (np.isfinite(value) and value >= 0):
                raise ScanError(f"the {what} must be 0 or above, got {value:g}")
        if self.range_db is not None and not (np.isfinite(self.range_db) and self.range_db > 0):
            raise ScanError(f"the dynamic range (dB) must be above 0, got {self.range_db:g}")


def correct_photoacoustic(scan: Scan, correction: PhotoacousticCorrection) -> Scan:
    """Return the scan with its photoacoustic companions corrected, frame by frame when read.

    Companions whose name begins with ``"photoacoustic"`` are corrected.

    Raises:
        ScanError: If the scan has none of them although something is to be corrected.
    """
    if correction.reject_skin_mm == 0 and correction.fading_per_mm == 0:
        return scan
    found = [name for name in image_companions(scan) if name.startswith(PHOTOACOUSTIC)]
    if not found:
        raise ScanError(
            f"'{scan.name}' has no photoacoustic frames to correct: leave out the rejection of"
            " skin and the depth compensation"
        )
    corrected = {name: _corrected(name, scan.companions[name], correction) for name in found}
    companions: Mapping[str, Companion] = {**scan.companions, **corrected}
    return replace(scan, companions=companions)


def _corrected(name: str, companion: Companion, correction: PhotoacousticCorrection) -> Companion:
    decibels = np.dtype(companion.frames.dtype) == np.uint8
    if decibels and correction.fading_per_mm > 0 and correction.range_db is None:
        raise ScanError(
            f"the {name} frames are gray levels: say how many decibels lie between black and"
            " white (--photoacoustic-range-db) to compensate for depth"
        )
    _check_depth(name, companion, correction)
    return replace(companion, frames=_DepthCorrected(companion, correction, decibels))


def _check_depth(name: str, companion: Companion, correction: PhotoacousticCorrection) -> None:
    """Check that something is left of the frames, and that they do not overflow."""
    deepest_mm = companion.origin_mm[1] + companion.spacing_mm[1] * (companion.frames.shape[1] - 1)
    if correction.reject_skin_mm > deepest_mm:
        raise ScanError(
            f"nothing would be left of the {name} frames: they end {deepest_mm:.4g} mm deep, and"
            f" the skin to reject is {correction.reject_skin_mm:g} mm"
        )
    gain_db = 20 * np.log10(np.e) * correction.fading_per_mm * deepest_mm
    if gain_db > MOST_GAIN_DB:
        raise ScanError(
            f"a depth compensation of {correction.fading_per_mm:g} per mm would brighten the"
            f" {name} frames by {gain_db:.4g} dB where they end: light fades by about 0.1 per mm"
        )


class _DepthCorrected(LazyFrames):
    """Frames whose rows are brightened by their depth, or set to 0."""

    def __init__(
        self, companion: Companion, correction: PhotoacousticCorrection, decibels: bool
    ) -> None:
        super().__init__(companion.frames.shape, companion.frames.dtype)
        self._frames = companion.frames
        rows = companion.frames.shape[1]
        depth_mm = companion.origin_mm[1] + companion.spacing_mm[1] * np.arange(rows)
        depth_mm = depth_mm.reshape((rows,) + (1,) * (len(companion.frames.shape) - 2))
        lost = correction.fading_per_mm * depth_mm
        self._kept = depth_mm >= correction.reject_skin_mm
        self._factor = np.ones_like(lost) if decibels else np.exp(lost)
        white_per_db = 255 / correction.range_db if decibels and correction.range_db else 0.0
        self._added = 20 * np.log10(np.e) * lost * white_per_db

    def _read(self, frame: int) -> np.ndarray:
        pixels = np.asarray(self._frames[frame])
        seen = self._kept & (pixels != 0)  # what was below the range of decibels stays black
        values = np.where(seen, pixels * self._factor + self._added, 0)
        if np.issubdtype(self.dtype, np.integer):
            limits = np.iinfo(self.dtype)
            values = np.rint(np.clip(values, limits.min, limits.max))
        return values.astype(self.dtype)
