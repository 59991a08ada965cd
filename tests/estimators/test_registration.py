"""Correlation of patches, against the plain definition."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sonosweep.estimators.registration import correlate, height_at, highest, moments, refine

FLOAT32 = 1e-4  # sums of some hundred single precision products
ROUND_OFF = 1e-6


@given(seed=st.integers(0, 1000), side=st.integers(8, 20), radius=st.integers(0, 3))
def test_patches_correlate_as_pearson_says(seed, side, radius):
    """The correlation of a patch at a shift is Pearson's, and NaN beyond the border."""
    rng = np.random.default_rng(seed)
    one, other = rng.normal(1, 1, (2, 40, 36)).astype(np.float32)
    corners = rng.integers(0, 36 - side, (3, 2))
    base = rng.integers(-2, 3, (3, 2))

    found = correlate(one, moments(one), other, moments(other), corners, side, base, radius)

    for p, (top, left) in enumerate(corners):
        patch = one[top : top + side, left : left + side]
        for i in range(2 * radius + 1):
            for j in range(2 * radius + 1):
                row, column = top + base[p, 0] + i - radius, left + base[p, 1] + j - radius
                inside = 0 <= row <= 40 - side and 0 <= column <= 36 - side
                assert inside == np.isfinite(found[p, i, j])
                if inside:
                    like = other[row : row + side, column : column + side]
                    pearson = np.corrcoef(patch.ravel(), like.ravel())[0, 1]
                    assert abs(found[p, i, j] - pearson) < FLOAT32


def hills(place: np.ndarray, height: float, curvature: np.ndarray, radius: int) -> np.ndarray:
    """Return Gaussian hills over whole-pixel shifts."""
    span = np.arange(-radius, radius + 1)
    down = np.exp(-curvature[0] / 2 * (span - place[:, :1]) ** 2)
    across = np.exp(-curvature[1] / 2 * (span - place[:, 1:]) ** 2)
    return height * down[:, :, None] * across[:, None, :]


@given(
    row=st.floats(-1.9, 1.9),
    column=st.floats(-1.9, 1.9),
    height=st.floats(0.2, 1),
    curvature=st.tuples(st.floats(0.1, 1), st.floats(0.1, 1)),
)
def test_a_gaussian_hill_is_found_exactly(row, column, height, curvature):
    """Place, height and curvature of a Gaussian summit between pixels are its own."""
    place, curvature = np.array([[row, column]]), np.array(curvature)
    surfaces = hills(place, height, curvature, 3)

    found, summit, bend = refine(surfaces, highest(surfaces))

    assert np.abs(found - place).max() < ROUND_OFF
    assert abs(summit[0] - height) < ROUND_OFF
    assert np.abs(bend - curvature).max() < ROUND_OFF
    middle = hills(place / 4, height, curvature, 1)
    assert abs(height_at(middle, place / 4, curvature)[0] - height) < ROUND_OFF


def test_patches_with_nothing_in_common_correlate_to_zero():
    """The mean height over many unlike patches is zero, not that of chance summits."""
    surfaces = np.random.default_rng(0).normal(0, 0.1, (5000, 3, 3))

    heights = height_at(surfaces, np.zeros((5000, 2)), np.ones(2))

    assert abs(heights.mean()) < 0.1 / np.sqrt(5000) * 3


def test_a_flat_surface_has_no_summit():
    """Where nothing stands out there is no shift, rather than a wrong one."""
    shift, summit, _ = refine(np.full((2, 5, 5), 0.3), np.zeros((2, 2), dtype=np.int64))

    assert np.isnan(shift).all()
    assert np.isnan(summit).all()
