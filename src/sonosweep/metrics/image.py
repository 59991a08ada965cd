"""How good a beamformed image is: resolution, contrast, speckle. Before log compression."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from sonosweep.errors import ScanError

STEP = 0.02
"""Of the profiles, in pixels."""
SIMPLEX = np.array([[0.0, 0.0], [0.5, 0.0], [0.0, 0.5]])
"""Where the search for a maximum begins, in pixels around the largest one."""


@dataclass(frozen=True)
class PointResolution:
    """The image of a point.

    Attributes:
        place_mm: Of the maximum, between pixels: lateral, axial, from the first pixel's
            centre.
        lateral_fwhm_mm: Full width at half the maximum along the row through it.
        axial_fwhm_mm: The same along the column through it.
    """

    place_mm: tuple[float, float]
    lateral_fwhm_mm: float
    axial_fwhm_mm: float


def point_resolution(
    amplitude: Float[np.ndarray, "rows columns"],
    spacing_mm: tuple[float, float],
    near_mm: tuple[float, float],
    reach_mm: float = 1.0,
) -> PointResolution:
    """Return where a point is and how wide it looks.

    Between pixels the image is a cubic spline, which follows a band-limited envelope if
    there are at least two pixels within the width.

    Args:
        amplitude: Envelope.
        spacing_mm: Between columns and rows.
        near_mm: About where the point is, lateral and axial from the first pixel's centre.
        reach_mm: How far from there its maximum may be.

    Raises:
        ScanError: If there is no maximum within reach, or it does not fall to half within
            the image.
    """
    from scipy import optimize  # slow to load

    scale = np.array([spacing_mm[1], spacing_mm[0]])
    rows, columns = np.indices(amplitude.shape)
    away = np.hypot(rows * scale[0] - near_mm[1], columns * scale[1] - near_mm[0])
    close = away <= reach_mm
    if not close.any() or not amplitude[close].max() > 0:
        raise ScanError(f"there is no echo within {reach_mm:g} mm of {near_mm}")
    first = np.unravel_index(np.argmax(np.where(close, amplitude, -1)), amplitude.shape)
    spline = ndimage.spline_filter(amplitude.astype(np.float64), 3, mode="nearest")

    def value(place: np.ndarray) -> float:
        return float(_along(spline, place[:, np.newaxis])[0])

    found = optimize.minimize(
        lambda place: -value(place) / amplitude[first],
        np.array(first, np.float64),
        method="Nelder-Mead",
        options={"xatol": 1e-5, "fatol": 1e-12, "initial_simplex": first + SIMPLEX},
    )
    row, column = found.x
    steps = [np.arange(0, size, STEP) for size in amplitude.shape]
    down = _along(spline, np.stack([steps[0], np.full_like(steps[0], column)]))
    across = _along(spline, np.stack([np.full_like(steps[1], row), steps[1]]))
    return PointResolution(
        (float(column * scale[1]), float(row * scale[0])),
        full_width_half_maximum(across, STEP * spacing_mm[0], column / STEP),
        full_width_half_maximum(down, STEP * spacing_mm[1], row / STEP),
    )


def full_width_half_maximum(
    profile: Float[np.ndarray, " samples"], spacing_mm: float, near: float | None = None
) -> float:
    """Return the width in mm between the two places where a profile is half its maximum.

    Args:
        profile: Amplitude; linear between samples.
        spacing_mm: Between samples.
        near: Index near which the maximum is; the largest sample if ``None``.

    Raises:
        ScanError: If the profile does not fall to half on both sides.
    """
    peak = int(np.argmax(profile)) if near is None else round(near)
    half = profile[peak] / 2
    left = np.flatnonzero(profile[:peak] <= half)
    right = np.flatnonzero(profile[peak + 1 :] <= half) + peak + 1
    if not (half > 0 and len(left) and len(right)):
        raise ScanError("the profile does not fall to half its maximum on both sides")
    before, after = left[-1], right[0]
    begin = before + (half - profile[before]) / (profile[before + 1] - profile[before])
    end = after - (half - profile[after]) / (profile[after - 1] - profile[after])
    return float((end - begin) * spacing_mm)


def contrast_db(
    amplitude: Float[np.ndarray, "rows columns"],
    inside: Bool[np.ndarray, "rows columns"],
    outside: Bool[np.ndarray, "rows columns"],
) -> float:
    """Return the mean power inside over that outside in dB; a cyst's is negative.

    Raises:
        ScanError: If a region has no pixel or no echo.
    """
    within, around = (_power(amplitude, region) for region in (inside, outside))
    if not (within > 0 and around > 0):
        raise ScanError("a region without any echo has no contrast")
    return float(10 * np.log10(within / around))


def contrast_to_noise(
    amplitude: Float[np.ndarray, "rows columns"],
    inside: Bool[np.ndarray, "rows columns"],
    outside: Bool[np.ndarray, "rows columns"],
) -> float:
    """Return the difference of the mean amplitudes over their joint standard deviation (CNR).

    Raises:
        ScanError: If a region has no pixel, or nothing varies in either.

    References:
        Smith, Wagner, Sandrik, Lopez, "Low contrast detectability and contrast/detail
        analysis in medical ultrasound", IEEE Trans. Sonics Ultrason. 1983.
    """
    within, around = (_values(amplitude, region) for region in (inside, outside))
    spread = np.sqrt(within.var() + around.var())
    if not spread > 0:
        raise ScanError("regions in which nothing varies have no contrast-to-noise ratio")
    return float(abs(within.mean() - around.mean()) / spread)


def speckle_snr(
    amplitude: Float[np.ndarray, "rows columns"], region: Bool[np.ndarray, "rows columns"]
) -> float:
    """Return mean over standard deviation of an amplitude: 1.91 for fully developed speckle.

    Raises:
        ScanError: If the region has no pixel, or nothing varies in it.
    """
    values = _values(amplitude, region)
    if not values.std() > 0:
        raise ScanError("a region in which nothing varies has no speckle")
    return float(values.mean() / values.std())


def normalized_variance(amplitude: Float[np.ndarray, "rows columns"]) -> float:
    """Return how sharp an image is: variance of its amplitude over its mean squared.

    Energy that is out of focus is spread over more pixels, so that of several sound speeds
    the right one gives the largest value.

    Raises:
        ScanError: If the image is black.

    References:
        Treeby, Varslot, Zhang, Laufer, Beard, "Automatic sound speed selection in
        photoacoustic image reconstruction using an autofocus approach", J. Biomed. Opt.
        2011, section 2, which compares measures of sharpness.
    """
    mean = float(np.mean(amplitude, dtype=np.float64))
    if not mean > 0:
        raise ScanError("a black image has no sharpness")
    return float(np.var(amplitude, dtype=np.float64)) / mean**2


def _along(
    spline: Float[np.ndarray, "rows columns"], places: Float[np.ndarray, "axes=2 places"]
) -> Float[np.ndarray, " places"]:
    return ndimage.map_coordinates(spline, places, order=3, prefilter=False, mode="nearest")


def _values(
    amplitude: Float[np.ndarray, "rows columns"], region: Bool[np.ndarray, "rows columns"]
) -> Float[np.ndarray, " pixels"]:
    if not region.any():
        raise ScanError("a region without pixels has no mean")
    return amplitude[region].astype(np.float64)


def _power(
    amplitude: Float[np.ndarray, "rows columns"], region: Bool[np.ndarray, "rows columns"]
) -> float:
    return float(np.mean(_values(amplitude, region) ** 2))
