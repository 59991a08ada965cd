"""Resolution, contrast and speckle of images that are known."""

import numpy as np
import pytest

from sonosweep.errors import ScanError
from sonosweep.metrics import image

FWHM = 2 * np.sqrt(2 * np.log(2))  # of a Gaussian of standard deviation 1


def gaussian_point(place_mm, sigma_mm, spacing_mm=(0.1, 0.05), shape=(80, 60)):
    """Return the image of a point at a lateral and axial place."""
    row, column = np.indices(shape)
    lateral = (column * spacing_mm[0] - place_mm[0]) / sigma_mm[0]
    axial = (row * spacing_mm[1] - place_mm[1]) / sigma_mm[1]
    return 3.0 * np.exp(-(lateral**2 + axial**2) / 2)


@pytest.mark.parametrize("shift", [0.0, 0.021, 0.05])
def test_a_point_between_pixels(shift):
    """Place within 2 % of a pixel and width within 1 %, wherever the point lies between them."""
    place, sigma = (3.0 + shift, 2.0 + shift / 2), (0.15, 0.08)
    amplitude = gaussian_point(place, sigma)

    found = image.point_resolution(amplitude, (0.1, 0.05), (3.2, 2.1))

    assert found.place_mm == pytest.approx(place, abs=2e-3)
    assert found.lateral_fwhm_mm == pytest.approx(FWHM * sigma[0], rel=0.01)
    assert found.axial_fwhm_mm == pytest.approx(FWHM * sigma[1], rel=0.01)


def test_the_nearest_of_two_points():
    """A brighter point out of reach does not count."""
    amplitude = gaussian_point((2.0, 2.0), (0.1, 0.1)) + 5 * gaussian_point((5.0, 2.0), (0.1, 0.1))

    found = image.point_resolution(amplitude, (0.1, 0.05), (2.1, 2.1))

    assert found.place_mm == pytest.approx((2.0, 2.0), abs=2e-3)


def test_width_of_a_triangle():
    """A triangle that falls to zero over 4 mm is 4 mm wide at half its height."""
    profile = np.maximum(0, 1 - np.abs(np.arange(-10, 11)) * 0.5 / 4)

    assert image.full_width_half_maximum(profile, 0.5) == pytest.approx(4.0)


def test_contrast_is_a_ratio_of_powers():
    """A disk of a tenth of the amplitude has -20 dB."""
    disk = np.hypot(*(np.indices((40, 40)) - 20)) < 10
    amplitude = np.where(disk, 0.2, 2.0)

    assert image.contrast_db(amplitude, disk, ~disk) == pytest.approx(-20.0)


def test_contrast_to_noise_counts_standard_deviations():
    """Means 3 apart, with variances 2 and 2, are 1.5 apart in units of their joint spread."""
    random = np.random.default_rng(0)
    left = np.zeros((500, 400), bool)
    left[:, :200] = True
    amplitude = np.where(left, 10.0, 13.0) + np.sqrt(2) * random.standard_normal(left.shape)

    assert image.contrast_to_noise(amplitude, left, ~left) == pytest.approx(1.5, rel=0.01)


def test_speckle_of_many_scatterers():
    """The amplitude of fully developed speckle has a signal-to-noise ratio of 1.91."""
    amplitude = np.random.default_rng(0).rayleigh(size=(600, 600))

    ratio = image.speckle_snr(amplitude, np.ones_like(amplitude, bool))

    assert ratio == pytest.approx(np.sqrt(np.pi / (4 - np.pi)), rel=0.01)


def test_a_blurred_image_is_less_sharp():
    """The same energy on more pixels varies less about its mean, whatever the gain."""
    sharp, blurred = gaussian_point((3, 2), (0.1, 0.1)), gaussian_point((3, 2), (0.2, 0.2))

    assert image.normalized_variance(sharp) > 2 * image.normalized_variance(blurred)
    assert image.normalized_variance(7 * sharp) == pytest.approx(image.normalized_variance(sharp))


@pytest.mark.parametrize(
    ("measure", "sentence"),
    [
        (lambda a, r: image.point_resolution(a, (0.1, 0.1), (50.0, 1.0)), "no echo within 1 mm"),
        (lambda a, r: image.point_resolution(0 * a, (0.1, 0.1), (1.0, 1.0)), "no echo within 1 mm"),
        (lambda a, r: image.point_resolution(a, (0.1, 0.1), (1.0, 1.0)), "fall to half"),
        (lambda a, r: image.contrast_db(a, r, ~r), "without pixels"),
        (lambda a, r: image.contrast_db(0 * a, r, r), "without any echo"),
        (lambda a, r: image.contrast_to_noise(a, r, r), "nothing varies"),
        (lambda a, r: image.speckle_snr(a, r), "nothing varies"),
        (lambda a, r: image.normalized_variance(0 * a), "black image"),
    ],
)
def test_what_has_no_measure(measure, sentence):
    """A flat image has no point, no noise and no speckle."""
    with pytest.raises(ScanError, match=sentence):
        measure(np.ones((20, 30)), np.ones((20, 30), bool))
