"""Gray levels are decibels."""

import numpy as np
import pytest

from sonosweep.errors import ScanError
from sonosweep.imaging.bmode import envelope, log_compress


def test_gray_levels_are_linear_in_decibels():
    """At 60 dB of range, a tenth of the amplitude is 85 gray levels darker."""
    amplitude = 7.0 * 10 ** (-np.arange(0, 90, 20)[:, None] / 20.0)

    assert log_compress(amplitude, 7.0).ravel().tolist() == [255, 170, 85, 0, 0]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_levels_are_rounded(dtype):
    """Gray levels are the nearest ones to 255 (1 + dB / range), in either precision."""
    level_db = np.linspace(-62, 5, 1000)
    expected = np.clip(255 * (1 + level_db / 50), 0, 255)

    gray = log_compress((10 ** (level_db / 20))[None].astype(dtype), 1.0, 50.0)

    assert np.abs(gray - expected).max() < 0.501


def test_gain_is_added_for_each_row():
    """A gain of 20 dB at a depth makes up for a tenth of the amplitude there."""
    gain_db = np.array([0.0, 20.0, 40.0])
    amplitude = np.full((3, 4), 5.0) * 10 ** (-gain_db / 20)[:, None]

    assert (log_compress(amplitude, 10.0, 60.0, gain_db) == log_compress(amplitude, 10.0)[0]).all()
    assert (log_compress(amplitude, 10.0, 60.0, 6.0) > log_compress(amplitude, 10.0))[0].all()


def test_silence_is_black():
    """No echo has no logarithm, and is black."""
    assert not log_compress(np.zeros((2, 2, 2), np.float32), 1e-30).any()


def test_envelope_forgets_the_phase():
    """The envelope of IQ is its magnitude."""
    assert envelope(np.full((1, 1), 3 - 4j, np.complex64)).item() == 5


@pytest.mark.parametrize(
    ("amplitude", "reference", "range_db", "sentence"),
    [
        (np.nan, 1.0, 60.0, "not numbers"),
        (1.0, 0.0, 60.0, "reference amplitude .* above 0, got 0"),
        (1.0, 1.0, -5.0, "dynamic range .* above 0, got -5"),
    ],
)
def test_what_cannot_be_compressed(amplitude, reference, range_db, sentence):
    """A NaN would become an arbitrary gray level."""
    with pytest.raises(ScanError, match=sentence):
        log_compress(np.full((2, 2), amplitude), reference, range_db)
