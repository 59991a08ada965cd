"""Baseband samples: their envelope, their phase, and band-pass sampling."""

import numpy as np
import pytest
from numpy.typing import NDArray

from sonosweep.errors import ScanError
from sonosweep.imaging import analytic_signal, demodulate

CARRIER_HZ = 6e6
FILTER = 2e-3
"""What the filter's skirts and the pulse's tails leave, as part of the envelope."""


def echoes(times_s: NDArray, offset_hz: float = 0.0) -> tuple[NDArray, NDArray]:
    """Return the RF of two echoes off the carrier by some frequency, and its baseband."""
    envelope = np.exp(-0.5 * ((times_s - 8e-6) / 0.8e-6) ** 2)
    envelope += 0.5 * np.exp(-0.5 * ((times_s - 11e-6) / 0.6e-6) ** 2)
    baseband = envelope * np.exp(2j * np.pi * offset_hz * times_s + 0.7j)
    return (baseband * np.exp(2j * np.pi * CARRIER_HZ * times_s)).real, baseband


@pytest.mark.parametrize("offset_hz", [0.0, 0.4e6, -0.6e6])
@pytest.mark.parametrize("rate_hz", [CARRIER_HZ * 4, CARRIER_HZ * 4 / 3, 40e6, 18.3e6])
def test_baseband_samples_are_the_echo_without_its_carrier(rate_hz, offset_hz):
    """Envelope and phase survive, even with four samples in three periods."""
    times = 2e-6 + np.arange(500) / rate_hz
    rf, baseband = echoes(times, offset_hz)

    iq = demodulate(rf, rate_hz, CARRIER_HZ, start_time_s=2e-6)

    np.testing.assert_allclose(iq, baseband, atol=FILTER)


@pytest.mark.parametrize("decimation", [2, 3])
def test_decimated_samples_are_some_of_all(decimation):
    """A narrow band needs fewer samples; those kept are the same."""
    rate_hz = 48e6
    rf, _ = echoes(np.arange(701) / rate_hz)
    every = demodulate(rf, rate_hz, CARRIER_HZ, bandwidth_hz=6e6)

    some = demodulate(rf, rate_hz, CARRIER_HZ, bandwidth_hz=6e6, decimation=decimation)

    np.testing.assert_allclose(some, every[::decimation], atol=1e-4)


def test_the_band_is_what_was_asked_for():
    """A tone inside the band passes whole, one outside not at all."""
    rate_hz = 40e6
    times = np.arange(4000) / rate_hz
    inside, outside = (
        demodulate(np.cos(2 * np.pi * f * times), rate_hz, CARRIER_HZ, bandwidth_hz=2e6)
        for f in (6.7e6, 7.4e6)
    )

    np.testing.assert_allclose(np.abs(inside[500:3500]), 1, atol=FILTER)
    np.testing.assert_allclose(np.abs(outside[500:3500]), 0, atol=FILTER)


def test_the_analytic_signal_has_the_echo_as_its_real_part():
    """Putting the carrier back undoes the demodulation."""
    times = 3e-6 + np.arange(512) / 24e6
    rf, _ = echoes(times)
    iq = demodulate(rf, 24e6, CARRIER_HZ, start_time_s=3e-6)

    analytic = analytic_signal(iq, 24e6, CARRIER_HZ, start_time_s=3e-6)

    np.testing.assert_allclose(analytic.real, rf, atol=FILTER)


def test_each_transmit_has_its_own_start():
    """Recordings that start later keep the phase of the same time zero."""
    starts = np.array([1e-6, 2.37e-6])
    times = starts[:, None] + np.arange(400) / 24e6
    rf, baseband = echoes(times)
    counts = np.rint(rf[:, None] * [[1000], [-1000]]).astype(np.int16)

    iq = demodulate(counts, 24e6, CARRIER_HZ, start_time_s=starts[:, None])

    assert iq.shape == (2, 2, 400)
    np.testing.assert_allclose(iq[:, 0] / 1000, baseband, atol=2 * FILTER)
    np.testing.assert_allclose(iq[:, 1], -iq[:, 0], atol=1e-2)


def test_the_end_does_not_reach_the_beginning():
    """An echo at the end of a recording leaves nothing at its start."""
    times = np.arange(1000) / 24e6
    rf = np.where(times > times[-30], np.cos(2 * np.pi * CARRIER_HZ * times), 0)

    iq = demodulate(rf, 24e6, CARRIER_HZ)

    assert np.abs(iq[:400]).max() < FILTER


@pytest.mark.parametrize(
    ("samples", "arguments", "message"),
    [
        (np.ones(9) * 1j, (24e6, 6e6), "IQ already"),
        (np.ones((3, 0)), (24e6, 6e6), "no samples"),
        (np.full(9, np.nan), (24e6, 6e6), "not all numbers"),
        (np.ones(9), (0.0, 6e6), "sampling frequency must be above 0"),
        (np.ones(9), (24e6, -1.0), "demodulation frequency must be above 0"),
        (np.ones(9), (12e6, 6e6), "mirror image, which lies 0 Hz away"),
    ],
)
def test_samples_that_cannot_be_demodulated_are_refused(samples, arguments, message):
    """One sentence says why."""
    with pytest.raises(ScanError, match=message):
        demodulate(samples, *arguments)


def test_too_few_samples_are_refused():
    """Decimation keeps the band, or nothing."""
    with pytest.raises(ScanError, match=r"decimation by 4 leaves 6e\+06 samples"):
        demodulate(np.ones(9), 24e6, 6e6, bandwidth_hz=6e6, decimation=4)
