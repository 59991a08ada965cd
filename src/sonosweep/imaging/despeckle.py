"""Lee's filter: smooth where an image varies as speckle does, unchanged where it varies more.

Near the edge of the image the window is cut off, so that nothing is made up outside.
"""

import math
from typing import no_type_check

import numpy as np
from jaxtyping import Float, UInt8
from numba import njit

from sonosweep.errors import ScanError

RAYLEIGH_VARIATION = math.sqrt(4 / math.pi - 1)
"""Standard deviation over mean of the amplitude of fully developed speckle: 0.523."""
LOG_SPECKLE_DB = math.sqrt(math.pi**2 / 24) * 20 / math.log(10)
"""Standard deviation of fully developed speckle after log compression: 5.57 dB."""


def lee_filter(
    amplitude: Float[np.ndarray, "rows columns"],
    window: int = 7,
    variation: float = RAYLEIGH_VARIATION,
) -> Float[np.ndarray, "rows columns"]:
    """Return an amplitude image, not yet log-compressed, with less speckle.

    Args:
        amplitude: Envelope: speckle multiplies what the image would be without.
        window: Odd number of rows and columns to take means and variances over.
        variation: Standard deviation over mean of the speckle.

    Raises:
        ScanError: If the window is not odd and positive, or the variation is negative.

    References:
        Lee, "Digital image enhancement and noise filtering by use of local statistics",
        IEEE TPAMI 1980, section IV (multiplicative noise).
    """
    check_lee(window, variation)
    filtered = np.empty_like(amplitude)
    _lee(amplitude, window // 2, 0.0, variation**2, 0.0, filtered)
    return filtered


def lee_filter_gray(
    gray: UInt8[np.ndarray, "rows columns"],
    dynamic_range_db: float = 60.0,
    window: int = 7,
    speckle_db: float = LOG_SPECKLE_DB,
) -> UInt8[np.ndarray, "rows columns"]:
    """Return a log-compressed frame with less speckle.

    After log compression speckle is added to the image, with the same standard deviation
    everywhere.

    Args:
        gray: 8-bit frame.
        dynamic_range_db: Between black and white.
        window: Odd number of rows and columns to take means and variances over.
        speckle_db: Standard deviation of the speckle.

    Raises:
        ScanError: If the window is not odd and positive, or a number is out of range.

    References:
        Lee 1980, see :func:`lee_filter`, section III (additive noise).
    """
    check_lee(window, speckle_db)
    filtered = np.empty_like(gray)
    _lee(gray, window // 2, gray_variance(dynamic_range_db, speckle_db), 0.0, 0.5, filtered)
    return filtered


def gray_variance(dynamic_range_db: float, speckle_db: float) -> float:
    """Return the variance of speckle in gray levels.

    Raises:
        ScanError: If the dynamic range is not positive.
    """
    if not (math.isfinite(dynamic_range_db) and dynamic_range_db > 0):
        raise ScanError(f"the dynamic range must be above 0 dB, got {dynamic_range_db:g}")
    return (speckle_db * 255 / dynamic_range_db) ** 2


def check_lee(window: int, speckle: float) -> None:
    """Check the numbers of a Lee filter.

    Raises:
        ScanError: If the window is not odd and positive, or the speckle is negative.
    """
    if window < 1 or window % 2 == 0:
        raise ScanError(f"the window of a Lee filter must be odd and above 0, got {window}")
    if not (math.isfinite(speckle) and speckle >= 0):
        raise ScanError(f"the speckle of a Lee filter must not be negative, got {speckle:g}")


@njit(cache=True, nogil=True)
@no_type_check
def _lee(image, reach, added, multiplied, rounding, filtered):
    """Filter with noise of variance ``added`` + ``multiplied`` x mean squared.

    Sums over the window are kept for each column and slide down the image; both sums and
    their differences are in double precision.
    """
    rows, columns = image.shape
    total, square = np.zeros(columns), np.zeros(columns)
    for row in range(min(reach, rows)):
        _slide(image[row], 1.0, total, square)
    for row in range(rows):
        if row + reach < rows:
            _slide(image[row + reach], 1.0, total, square)
        if row - reach > 0:
            _slide(image[row - reach - 1], -1.0, total, square)
        height = min(row + reach, rows - 1) - max(row - reach, 0) + 1
        window_total, window_square = 0.0, 0.0
        for column in range(min(reach, columns)):
            window_total += total[column]
            window_square += square[column]
        for column in range(columns):
            if column + reach < columns:
                window_total += total[column + reach]
                window_square += square[column + reach]
            if column - reach > 0:
                window_total -= total[column - reach - 1]
                window_square -= square[column - reach - 1]
            width = min(column + reach, columns - 1) - max(column - reach, 0) + 1
            mean = window_total / (height * width)
            variance = window_square / (height * width) - mean * mean
            noise = added + multiplied * mean * mean
            signal = max((variance - noise) / (1.0 + multiplied), 0.0)
            gain = signal / (signal + noise) if signal > 0.0 else 0.0
            filtered[row, column] = mean + gain * (image[row, column] - mean) + rounding


@njit(cache=True, nogil=True)
@no_type_check
def _slide(line, sign, total, square):
    """Add a row of the image to the sums of the columns, or take it out."""
    for column in range(line.size):
        value = np.float64(line[column])
        total[column] += sign * value
        square[column] += sign * value * value
