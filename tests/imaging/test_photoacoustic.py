"""Photoacoustic samples in the transducer's band."""

import numpy as np
import pytest

from sonosweep.errors import ScanError
from sonosweep.imaging.photoacoustic import band_pass

RATE_HZ = 40e6


def tone(frequency_hz, samples=2000):
    """Return a wave that swells and fades."""
    return np.hanning(samples) * np.sin(2 * np.pi * frequency_hz * np.arange(samples) / RATE_HZ)


def test_tones_in_the_band_pass_unchanged():
    """Neither delayed nor weakened, where drift and noise outside are gone."""
    wave, rest = tone(4e6), 500 * tone(0.05e6) + 3 * tone(17e6)
    rf = np.stack([wave, wave + rest]).reshape(1, 2, -1)

    passed = band_pass(rf, RATE_HZ, (1e6, 8e6))

    assert passed.dtype == np.float32
    assert np.abs(passed - wave).max() < 0.01


def test_edges_of_the_band():
    """6 dB less at either edge: 3 dB forward and 3 dB backward."""
    for edge in (1e6, 8e6):
        assert np.abs(band_pass(tone(edge), RATE_HZ, (1e6, 8e6))).max() == pytest.approx(
            0.5,
            abs=0.03,  # a wave that swells has more than one frequency
        )


def test_integers_as_machines_store_them():
    """Samples of 16 bits, signed or not, are filtered like others."""
    wave = np.rint(1000 * tone(4e6) + 2000)

    passed = [band_pass(wave.astype(t), RATE_HZ, (1e6, 8e6)) for t in (np.uint16, np.int16, float)]

    assert np.array_equal(passed[0], passed[2])
    assert np.array_equal(passed[1], passed[2])


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda: band_pass(tone(1e6), RATE_HZ, (1e6, 30e6)), "between 0 and 2e\\+07 Hz"),
        (lambda: band_pass(tone(1e6), RATE_HZ, (0.0, 3e6)), "got 0 to 3e\\+06 Hz"),
        (lambda: band_pass(np.ones(27), RATE_HZ, (1e6, 3e6)), "more than 27 samples, got 27"),
        (lambda: band_pass(np.full(90, np.nan), RATE_HZ, (1e6, 3e6)), "not all numbers"),
    ],
)
def test_what_cannot_be_filtered(call, sentence):
    """One sentence each."""
    with pytest.raises(ScanError, match=sentence):
        call()
