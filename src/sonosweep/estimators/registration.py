"""How each patch of one frame moved within the plane of another, and how alike they are.

Compiled functions are marked ``no_type_check``: what checks the annotations in the tests
would otherwise wrap them before they are compiled.
"""

import math
from typing import no_type_check

import numpy as np
from jaxtyping import Float, Int
from numba import njit

LOWEST_CORRELATION = 1e-3
"""What a correlation is raised to before its logarithm is taken."""

MOST_OBLIQUE = 0.7
"""Cross term of a hill, relative to its curvatures, that is still believed."""


@njit(cache=True, fastmath=True)
@no_type_check
def moments(texture):
    """Return the sums over all pixels above and left of each, of values and of squares."""
    rows, columns = texture.shape
    sums = np.zeros((rows + 1, columns + 1))
    squares = np.zeros((rows + 1, columns + 1))
    for r in range(rows):
        row_sum = 0.0
        row_square = 0.0
        for c in range(columns):
            value = np.float64(texture[r, c])
            row_sum += value
            row_square += value * value
            sums[r + 1, c + 1] = sums[r, c + 1] + row_sum
            squares[r + 1, c + 1] = squares[r, c + 1] + row_square
    return sums, squares


@njit(cache=True, inline="always")
@no_type_check
def _box(table, top, left, side):
    return (
        table[top + side, left + side]
        - table[top, left + side]
        - table[top + side, left]
        + table[top, left]
    )


@njit(cache=True, fastmath=True)
@no_type_check
def _dot(one, other, top, left, row, column, side):
    """Return the sum over a patch of products.

    Rows are slices: indices into the whole frame could be negative as far as the compiler
    knows, and the loop would not be vectorized.
    """
    total = np.float32(0)
    for r in range(side):
        a = one[top + r, left : left + side]
        b = other[row + r, column : column + side]
        partial = np.float32(0)
        for c in range(side):
            partial += a[c] * b[c]
        total += partial
    return total


@njit(cache=True)
@no_type_check
def correlate(one, one_moments, other, other_moments, corners, side, base, radius):
    """Return the correlation of each patch of one texture with shifted ones of another.

    Zero-mean and normalized for every shift on its own; NaN where the shifted patch leaves
    the image or has no contrast.

    Args:
        one: Texture of the first frame, float32.
        one_moments: Its :func:`moments`.
        other: Texture of the second frame.
        other_moments: Its :func:`moments`.
        corners: First row and column of each patch of ``one``.
        side: Rows and columns of a patch.
        base: Rows and columns by which the search of each patch is centered elsewhere.
        radius: How far the search goes from there, in pixels, in both axes.

    Returns:
        One surface per patch, float64, rows and columns of shift.
    """
    rows, columns = other.shape
    width = 2 * radius + 1
    count = side * side
    surfaces = np.full((len(corners), width, width), np.nan)
    for p in range(len(corners)):
        top, left = corners[p]
        one_mean = _box(one_moments[0], top, left, side) / count
        one_energy = _box(one_moments[1], top, left, side) - count * one_mean**2
        for i in range(width):
            row = top + base[p, 0] + i - radius
            for j in range(width):
                column = left + base[p, 1] + j - radius
                if row < 0 or column < 0 or row + side > rows or column + side > columns:
                    continue
                mean = _box(other_moments[0], row, column, side) / count
                energy = _box(other_moments[1], row, column, side) - count * mean**2
                # Below this a float32 texture is flat but for round-off.
                if min(one_energy, energy) < 1e-6 * count:
                    continue
                product = _dot(one, other, top, left, row, column, side)
                covariance = product - count * one_mean * mean
                surfaces[p, i, j] = covariance / math.sqrt(one_energy * energy)
    return surfaces


def highest(
    surfaces: Float[np.ndarray, "patches rows columns"],
) -> Int[np.ndarray, "patches rc=2"]:
    """Return the shift (rows, columns) of the largest value, counted from the middle.

    The middle itself where there is no value at all.
    """
    width = surfaces.shape[2]
    flat = np.where(np.isfinite(surfaces), surfaces, -2).reshape(len(surfaces), -1)
    flat[(flat == -2).all(axis=1), (flat.shape[1] - 1) // 2] = 0
    index = flat.argmax(axis=1)
    return np.stack((index // width, index % width), axis=-1) - (width - 1) // 2


def refine(
    surfaces: Float[np.ndarray, "patches rows columns"], at: Int[np.ndarray, "patches rc=2"]
) -> tuple[
    Float[np.ndarray, "patches rc=2"],
    Float[np.ndarray, " patches"],
    Float[np.ndarray, "patches rc=2"],
]:
    """Lay a Gaussian hill through the values around a shift.

    Speckle correlates with its shifted self as a Gaussian, so the logarithm is a
    paraboloid and neither the place nor the height of the summit is biased by where it
    falls between pixels; a paraboloid through the values themselves loses up to 0.01 of
    height, which is 0.1 beam widths of elevational distance.

    Args:
        surfaces: Correlations by shift.
        at: Rows and columns from the middle of the surface, away from its border.

    Returns:
        Shift of the summit from the middle of the surface, the height of the summit, and
        the curvature of the logarithm along rows and columns (per pixel squared, positive
        for a hill). NaN where there is no hill within a pixel.
    """
    radius = surfaces.shape[1] // 2
    center = np.clip(at, 1 - radius, radius - 1) + radius
    patch = np.arange(len(surfaces))[:, None, None]
    span = np.arange(-1, 2)
    near = surfaces[
        patch, center[:, 0, None, None] + span[:, None], center[:, 1, None, None] + span
    ]
    log = np.log(np.maximum(near, LOWEST_CORRELATION))
    g_r = (log[:, 2, 1] - log[:, 0, 1]) / 2
    g_c = (log[:, 1, 2] - log[:, 1, 0]) / 2
    h_rr = log[:, 0, 1] + log[:, 2, 1] - 2 * log[:, 1, 1]
    h_cc = log[:, 1, 0] + log[:, 1, 2] - 2 * log[:, 1, 1]
    h_rc = (log[:, 0, 0] + log[:, 2, 2] - log[:, 0, 2] - log[:, 2, 0]) / 4
    with np.errstate(invalid="ignore", divide="ignore"):
        # The corners are noise where speckle is not much wider than a pixel.
        steepest = MOST_OBLIQUE * np.sqrt(np.maximum(h_rr * h_cc, 0))
        h_rc = np.clip(h_rc, -steepest, steepest)
        determinant = h_rr * h_cc - h_rc**2
        hill = (h_rr < 0) & (h_cc < 0) & (determinant > 0)
        row = np.where(hill, (h_rc * g_c - h_cc * g_r) / determinant, np.nan)
        column = np.where(hill, (h_rc * g_r - h_rr * g_c) / determinant, np.nan)
        outside = ~((np.abs(row) <= 1.5) & (np.abs(column) <= 1.5))
        row[outside], column[outside] = np.nan, np.nan
        height = np.exp(log[:, 1, 1] + (g_r * row + g_c * column) / 2)
    summit = np.stack((row, column), axis=-1) + (center - radius)
    return summit, np.minimum(height, 1.0), np.stack((-h_rr, -h_cc), axis=-1)


def height_at(
    surfaces: Float[np.ndarray, "patches rows=3 columns=3"],
    shift: Float[np.ndarray, "patches rc=2"],
    curvature: Float[np.ndarray, "rc=2"],
) -> Float[np.ndarray, " patches"]:
    """Return the height of a Gaussian hill whose place and curvature are known.

    Linear in the correlations, so that of patches which have nothing in common, negative
    ones included, the mean is zero: the summit of whatever hill is there would not be.
    """
    span = np.arange(-1, 2)
    down = np.exp(-curvature[0] / 2 * (span - shift[:, :1]) ** 2)
    across = np.exp(-curvature[1] / 2 * (span - shift[:, 1:]) ** 2)
    hill = down[:, :, None] * across[:, None, :]
    return (hill * surfaces).sum(axis=(1, 2)) / (hill**2).sum(axis=(1, 2))
