"""Lee's filter smooths speckle and keeps what is there."""

import numpy as np
import pytest
from scipy import ndimage

from sonosweep.errors import ScanError
from sonosweep.imaging.bmode import log_compress
from sonosweep.imaging.despeckle import (
    LOG_SPECKLE_DB,
    RAYLEIGH_VARIATION,
    lee_filter,
    lee_filter_gray,
)


def speckle(rows, columns, seed=0):
    """Return the amplitude of uncorrelated speckle of mean power 1."""
    random = np.random.default_rng(seed)
    return np.hypot(*random.standard_normal((2, rows, columns))) / np.sqrt(2)


def equivalent_looks(amplitude):
    """Return mean squared over variance."""
    return (amplitude.mean() / amplitude.std()) ** 2


def test_constants_are_those_of_rayleigh_statistics():
    """The amplitude of speckle varies by 0.523 of its mean, its logarithm by 5.57 dB."""
    amplitude = speckle(1000, 1000)

    assert pytest.approx(amplitude.std() / amplitude.mean(), rel=3e-3) == RAYLEIGH_VARIATION
    assert pytest.approx((20 * np.log10(amplitude)).std(), rel=3e-3) == LOG_SPECKLE_DB


def test_filter_is_the_formula_of_lee():
    """Away from the edge it is Lee's weighted mean, with SciPy's means and variances."""
    amplitude = speckle(40, 50) * np.linspace(1, 5, 50)
    mean = ndimage.uniform_filter(amplitude, 5)
    variance = ndimage.uniform_filter(amplitude**2, 5) - mean**2
    noise = RAYLEIGH_VARIATION**2 * mean**2
    signal = np.maximum((variance + mean**2) / (1 + RAYLEIGH_VARIATION**2) - mean**2, 0)
    expected = mean + signal / (noise + signal) * (amplitude - mean)

    filtered = lee_filter(amplitude, 5)

    assert np.allclose(filtered[2:-2, 2:-2], expected[2:-2, 2:-2], rtol=1e-9)


def test_speckle_becomes_smooth():
    """49 pixels of Rayleigh speckle, 3.66 looks, become more than 100."""
    amplitude = speckle(256, 256).astype(np.float32)

    filtered = lee_filter(amplitude, 7)

    assert filtered.dtype == np.float32
    assert equivalent_looks(amplitude) == pytest.approx(3.66, abs=0.1)
    assert equivalent_looks(filtered) > 100
    assert filtered.mean() == pytest.approx(amplitude.mean(), rel=0.01)


def test_bright_points_stay():
    """A point 40 times as bright as the speckle around it keeps 90 % of its amplitude."""
    amplitude = speckle(64, 64)
    amplitude[30, 30] = 40 * amplitude.mean()

    assert lee_filter(amplitude, 7)[30, 30] > 0.9 * amplitude[30, 30]


def test_gray_levels_of_speckle_become_smooth():
    """In a log-compressed frame the standard deviation falls to a quarter or less."""
    gray = log_compress(speckle(128, 128), 4.0, 60.0)

    filtered = lee_filter_gray(gray, 60.0, 7)

    assert filtered.dtype == np.uint8
    assert filtered.astype(float).std() < gray.astype(float).std() / 4
    assert filtered.mean() == pytest.approx(gray.mean(), abs=0.6)


def test_an_edge_in_gray_levels_stays():
    """An edge of 30 dB without speckle is left nearly as sharp as it was."""
    gray = np.zeros((32, 32), np.uint8)
    gray[:, 16:] = 128

    filtered = lee_filter_gray(gray, 60.0, 5)

    assert filtered[16, 15] < 16
    assert filtered[16, 16] > 112


def test_a_window_larger_than_the_image():
    """All pixels then count everywhere: the mean of speckle, up to the edge."""
    amplitude = speckle(6, 9)

    assert np.allclose(lee_filter(amplitude, 41, 10.0), amplitude.mean())


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (7, 1), (2, 3)])
def test_constant_images_stay(shape):
    """Where nothing varies there is nothing to smooth, also at the edge."""
    assert np.allclose(lee_filter(np.full(shape, 3.0), 5), 3.0)
    assert (lee_filter_gray(np.full(shape, 77, np.uint8)) == 77).all()


@pytest.mark.parametrize(
    ("window", "variation", "sentence"), [(4, 0.5, "odd"), (0, 0.5, "odd"), (5, -1.0, "negative")]
)
def test_numbers_out_of_range(window, variation, sentence):
    """An even window has no middle."""
    with pytest.raises(ScanError, match=sentence):
        lee_filter(np.ones((4, 4)), window, variation)
