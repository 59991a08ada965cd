"""On a GPU, or on any device, the chain gives the same numbers."""

import numpy as np
import pytest
import torch

from sonosweep.errors import ScanError
from sonosweep.imaging import SectorGrid, bmode, chain_torch, clutter, despeckle, doppler
from sonosweep.imaging.scan_convert import prepare_scan_converter, sector_image_grid
from tests.imaging.test_clutter import tissue_and_blood

DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
SINGLE, DOUBLE = 1e-5, 1e-9  # rounding of some hundred operations
GRAY = 1  # a level exactly between two gray levels can fall to either side


@pytest.fixture(params=DEVICES)
def on(request):
    """Return a function that puts an array on the device."""
    return lambda array: torch.from_numpy(array).to(request.param)


def closeness(tensor, array):
    """Return the largest difference over the largest value."""
    assert str(tensor.dtype).split(".")[1] == str(array.dtype)
    return np.abs(tensor.cpu().numpy() - array).max() / np.abs(array).max()


@pytest.mark.parametrize("rank", ["auto", 1, 3])
def test_clutter_filter(on, rank):
    """Filtered at 60 dB of clutter, in double precision."""
    ensemble, _ = tissue_and_blood()

    filtered = chain_torch.svd_filter(on(ensemble), rank)

    assert closeness(filtered, clutter.svd_filter(ensemble, rank)) < DOUBLE


def test_clutter_filter_of_single_precision_samples(on):
    """Also 32-bit samples are filtered in double precision."""
    ensemble = tissue_and_blood()[0].astype(np.complex64)

    filtered = chain_torch.svd_filter(on(ensemble), 3)

    assert closeness(filtered, clutter.svd_filter(ensemble, 3)) < SINGLE


def test_flow(on):
    """Power and lag-one product."""
    ensemble = tissue_and_blood()[0].astype(np.complex64)

    power, product = chain_torch.power_doppler(on(ensemble)), chain_torch.lag_one(on(ensemble))

    assert closeness(power, doppler.power_doppler(ensemble)) < SINGLE
    assert closeness(product, doppler.lag_one(ensemble)) < SINGLE


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_gray_levels(on, dtype):
    """Log compression with a gain for each row."""
    amplitude = np.random.default_rng(0).rayleigh(size=(2, 30, 20)).astype(dtype)
    gain_db = np.linspace(0, 10, 30).astype(dtype)
    expected = bmode.log_compress(amplitude, 2.5, 50.0, gain_db)

    gray = chain_torch.log_compress(on(amplitude), 2.5, 50.0, on(gain_db))

    difference = np.abs(gray.cpu().numpy().astype(int) - expected)
    assert difference.max() <= GRAY
    assert (difference > 0).mean() < 1e-2


@pytest.mark.parametrize("window", [1, 5, 41])
def test_lee_filters(on, window):
    """Both forms, up to the edge, also with a window larger than the image."""
    amplitude = np.random.default_rng(0).rayleigh(size=(32, 27)) * np.linspace(1, 4, 27)
    gray = bmode.log_compress(amplitude, 8.0, 50.0)

    smooth = chain_torch.lee_filter(on(amplitude), window)
    smooth_gray = chain_torch.lee_filter_gray(on(gray), 50.0, window).cpu().numpy()

    assert closeness(smooth, despeckle.lee_filter(amplitude, window)) < DOUBLE
    expected = despeckle.lee_filter_gray(gray, 50.0, window)
    assert np.abs(smooth_gray.astype(int) - expected).max() <= GRAY


def test_constant_image(on):
    """Where nothing varies, 0 / 0 is nobody's gain."""
    assert bool((chain_torch.lee_filter(on(np.zeros((5, 5)))) == 0).all())


@pytest.mark.parametrize("dtype", [np.uint8, np.float32, np.float64])
def test_scan_conversion(on, dtype):
    """Of gray levels and amplitudes, several frames at once."""
    sector = SectorGrid(48, 90, 0.02, 0.7, 2.0, 60.0)
    converter = prepare_scan_converter(sector, sector_image_grid(sector, 80, 60))
    frames = (255 * np.random.default_rng(0).random((3, 90, 48))).astype(dtype)
    expected = converter.apply(frames)

    converted = chain_torch.ScanConverter(converter).to(on(frames).device)(on(frames))

    assert closeness(converted.double(), expected.astype(np.float64)) < SINGLE
    assert str(converted.dtype).endswith(np.dtype(dtype).name)


def test_the_same_is_refused(on):
    """One pulse, samples that are not numbers, frames of another sector."""
    amplitude = np.full((4, 4), np.nan)
    sector = SectorGrid(48, 90, 0.02, 0.7, 2.0, 60.0)
    converter = prepare_scan_converter(sector, sector_image_grid(sector, 8, 6))

    with pytest.raises(ScanError, match="at least 2 pulses, got 1"):
        chain_torch.svd_filter(on(np.ones((1, 2, 2), complex)))
    with pytest.raises(ScanError, match="at least 2 pulses, got 1"):
        chain_torch.lag_one(on(np.ones((1, 2, 2), complex)))
    with pytest.raises(ScanError, match="not numbers"):
        chain_torch.svd_filter(on(amplitude[None].repeat(3, 0).astype(complex)))
    with pytest.raises(ScanError, match="not numbers"):
        chain_torch.log_compress(on(amplitude), 1.0)
    with pytest.raises(ScanError, match="prepared for 90 x 48 samples"):
        chain_torch.ScanConverter(converter)(torch.zeros(48, 90))
