"""How alike two frames of speckle still are when the probe has moved out of plane.

The curve is ``peak * exp(-(distance / width) ** exponent)`` with a width per depth. Theory
gives fully developed speckle an exponent of 2 (Chen et al. 1997, Tuthill et al. 1998). What
a scanner shows decorrelates more slowly and less steeply, because it averages frames over
time, compresses gray levels and shows tissue that is no speckle: a calibration measures all
that together, for one probe and one preset.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from jaxtyping import Float

from sonosweep.errors import ScanError
from sonosweep.scan import Probe

CurveSource = Literal["guess", "probe", "tracked", "length"]

SOUND_SPEED_M_PER_S = 1540.0
"""Of soft tissue, as every scanner assumes."""

GUESSED_WIDTH_MM = 0.42
"""Of the amplitude correlation of a 5 mm high, 7 MHz linear array focused at 18 mm."""

ELEVATIONAL_PER_LATERAL = 2.05
"""How much farther speckle reaches out of the plane than along the rows: 0.60 to 0.29 mm for
the echo of a linear array (L11-5v: 5 mm high, focused at 18 mm, receiving at f/1.5)."""

LOWEST_SHARE = 0.05
"""Part of the peak below which a correlation tells no distance, only "far"."""


@dataclass(frozen=True)
class DecorrelationCurve:
    """Correlation of patches against elevational distance, for one probe and preset.

    Attributes:
        depth_mm: Axial image coordinates at which the width is known, increasing.
        width_mm: Distance at which the correlation has fallen to ``peak / e``, at each of
            these depths; linear between them, constant beyond.
        exponent: Steepness; 2 for fully developed speckle.
        peak: Correlation of two frames at the same place; below 1 because of noise.
        fineness_per_mm2: How fast the tissue it was measured on decorrelates laterally, at
            the same depths; empty takes each scan's own median for that.
        coherence: How much of a patch's lateral coherence is carried over to the elevational
            direction, as a power; see :mod:`sonosweep.estimators.coherence`.
        dynamic_range_db: Echo amplitude from black to white at which it was measured.
        source: Where it comes from; a ``"guess"`` and a ``"probe"`` know nothing of frame
            averaging.
        preset: Probe and scanner setting it holds for.
        quality: How well it was measured, by name with units.
    """

    depth_mm: tuple[float, ...] = (0.0,)
    width_mm: tuple[float, ...] = (GUESSED_WIDTH_MM,)
    exponent: float = 2.0
    peak: float = 1.0
    fineness_per_mm2: tuple[float, ...] = ()
    coherence: float = 0.5
    dynamic_range_db: float = 60.0
    source: CurveSource = "guess"
    preset: str = ""
    quality: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ScanError: If one of them is impossible.
        """
        if len(self.depth_mm) != len(self.width_mm) or not self.depth_mm:
            raise ScanError(
                f"a decorrelation curve needs one width per depth, got {len(self.width_mm)}"
                f" widths and {len(self.depth_mm)} depths"
            )
        if not all(np.isfinite(self.depth_mm)) or any(np.diff(self.depth_mm) <= 0):
            raise ScanError(f"depths of a decorrelation curve must increase: {self.depth_mm}")
        if self.fineness_per_mm2 and len(self.fineness_per_mm2) != len(self.depth_mm):
            raise ScanError(
                f"a decorrelation curve needs one fineness per depth or none, got"
                f" {len(self.fineness_per_mm2)} for {len(self.depth_mm)} depths"
            )
        limits = {
            "exponent": (self.exponent, 0.3, 4.0),
            "peak": (self.peak, 0.1, 1.0),
            "dynamic range (dB)": (self.dynamic_range_db, 5.0, 200.0),
            "coherence": (self.coherence, 0.0, 1.0),
            "smallest fineness (1/mm2)": (min(self.fineness_per_mm2, default=1.0), 1e-6, 1e6),
            "largest fineness (1/mm2)": (max(self.fineness_per_mm2, default=1.0), 1e-6, 1e6),
            "smallest width (mm)": (min(self.width_mm), 1e-3, 1e3),
            "largest width (mm)": (max(self.width_mm), 1e-3, 1e3),
        }
        for what, (value, low, high) in limits.items():
            if not low <= value <= high:
                raise ScanError(
                    f"{what} of a decorrelation curve must be {low:g} to {high:g}, got {value:g}"
                )


def width_at(
    curve: DecorrelationCurve, depth_mm: Float[np.ndarray, "*n"]
) -> Float[np.ndarray, "*n"]:
    """Return the width (mm) of the curve at each depth."""
    return np.interp(depth_mm, curve.depth_mm, curve.width_mm)


def correlation_at(
    curve: DecorrelationCurve,
    distance_mm: Float[np.ndarray, "*n"],
    width_mm: Float[np.ndarray, "*n"],
) -> Float[np.ndarray, "*n"]:
    """Return the correlation of patches this far apart; the sign of a distance is lost."""
    share = np.abs(distance_mm) / width_mm
    return curve.peak * np.exp(-(share**curve.exponent))


def distance_at(
    curve: DecorrelationCurve,
    correlation: Float[np.ndarray, "*n"],
    width_mm: Float[np.ndarray, "*n"],
) -> Float[np.ndarray, "*n"]:
    """Return the distance (mm) at which patches correlate so; undoes :func:`correlation_at`.

    Zero above the peak; correlations below 5 % of it all give the distance of 5 %.
    """
    share = np.clip(correlation / curve.peak, LOWEST_SHARE, 1.0)
    return width_mm * (-np.log(share)) ** (1 / curve.exponent)


def slope_at(
    curve: DecorrelationCurve,
    distance_mm: Float[np.ndarray, "*n"],
    width_mm: Float[np.ndarray, "*n"],
) -> Float[np.ndarray, "*n"]:
    """Return by how much the correlation falls per mm at a distance above zero."""
    steepness = curve.exponent / width_mm * (distance_mm / width_mm) ** (curve.exponent - 1)
    return correlation_at(curve, distance_mm, width_mm) * steepness


def scaled_curve(curve: DecorrelationCurve, factor: float) -> DecorrelationCurve:
    """Return the curve with all distances multiplied by a factor."""
    return replace(curve, width_mm=tuple(width * factor for width in curve.width_mm))


def curve_from_speckle(
    depth_mm: Float[np.ndarray, " patches"], fineness_per_mm2: Float[np.ndarray, " patches"]
) -> DecorrelationCurve:
    """Guess a curve from the size of the speckle in the frames themselves.

    How far a patch stays like itself along its rows knows of the probe's frequency, of
    speckle reduction and of gray-level compression; how high the elements are, and that
    scanners average frames over time, it does not. So this remains a guess.

    Args:
        depth_mm: Of each patch.
        fineness_per_mm2: How fast speckle usually decorrelates laterally at that depth; NaN
            where it is not known.
    """
    known = np.isfinite(fineness_per_mm2)
    depths = np.unique(depth_mm[known])
    if len(depths) == 0:
        return DecorrelationCurve()
    fineness = [float(np.median(fineness_per_mm2[known & (depth_mm == d)])) for d in depths]
    # Laterally the correlation is exp(-fineness * distance ** 2 / 2).
    widths = ELEVATIONAL_PER_LATERAL * np.sqrt(2 / np.array(fineness))
    return DecorrelationCurve(tuple(depths.tolist()), tuple(widths.tolist()))


def curve_from_probe(
    probe: Probe, depth_mm: tuple[float, ...] = (5.0, 10.0, 15.0, 20.0, 30.0, 40.0, 60.0)
) -> DecorrelationCurve:
    """Return the curve of fully developed speckle from the height of a probe's elements.

    The elevational beam of a uniform aperture behind a lens is propagated to each depth
    (Fresnel), squared for the two ways, and correlated with its shifted self: that is the
    correlation of the echoes of many independent scatterers. Amplitudes correlate as its
    square.

    Raises:
        ScanError: If the probe's height or focus is not known.
    """
    aperture_mm, focus_mm = probe.elevation_aperture_mm, probe.elevation_focus_mm
    if aperture_mm is None or focus_mm is None:
        raise ScanError(
            f"the decorrelation curve of probe '{probe.name}' needs elevation_aperture_mm and"
            " elevation_focus_mm"
        )
    wavelength_mm = SOUND_SPEED_M_PER_S * 1e3 / probe.center_frequency_hz
    widths = tuple(_beam_width(aperture_mm, focus_mm, wavelength_mm, d) for d in depth_mm)
    return DecorrelationCurve(depth_mm, widths, source="probe", preset=probe.name)


def _beam_width(aperture_mm: float, focus_mm: float, wavelength_mm: float, at_mm: float) -> float:
    """Return where the squared echo correlation has fallen to 1/e at one depth."""
    source_mm = np.linspace(-aperture_mm / 2, aperture_mm / 2, 257)
    reach_mm = aperture_mm + 2 * wavelength_mm * at_mm / aperture_mm
    x_mm = np.linspace(-reach_mm, reach_mm, 1025)
    defocus = source_mm**2 * (1 / at_mm - 1 / focus_mm) - 2 * x_mm[:, None] * source_mm / at_mm
    one_way = np.exp(1j * math.pi / wavelength_mm * defocus).sum(axis=1)
    one_way *= np.exp(1j * math.pi / wavelength_mm * x_mm**2 / at_mm)
    echo = np.abs(np.correlate(one_way**2, one_way**2, mode="full"))[len(x_mm) - 1 :]
    squared = (echo / echo[0]) ** 2
    first_below = int(np.argmax(squared < math.exp(-1)))
    return float(
        np.interp(
            -math.exp(-1),
            -squared[first_below - 1 : first_below + 1],
            x_mm[first_below - 1 : first_below + 1] - x_mm[0],
        )
    )
