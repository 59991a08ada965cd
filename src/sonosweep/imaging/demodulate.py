"""Baseband samples from what the elements received, and back.

Convention, that of PyMUST: a sample at time t after the transmit's time zero holds
``iq(t) = analytic(t) * exp(-2j * pi * demodulation_frequency_hz * t)``, in which the real part
of ``analytic`` is the received signal. The start time of a recording is part of t.
"""

import math

import numpy as np
from jaxtyping import Complex64, Float, Shaped
from scipy import fft

from sonosweep.errors import ScanError

EDGE = 0.2
"""Part of the pass band over which the filter falls at each end, a raised cosine."""
PADDING = 8.0
"""Zeros after a recording, in periods of the cut-off frequency: the filter would wrap its end
into its beginning."""
CHUNK_SAMPLES = 1 << 17
"""Filtered at once; a megabyte stays in the processor's cache."""


def demodulate(
    rf: Shaped[np.ndarray, "*batch samples"],
    sampling_frequency_hz: float,
    demodulation_frequency_hz: float,
    *,
    start_time_s: float | Float[np.ndarray, "..."] = 0.0,
    bandwidth_hz: float | None = None,
    decimation: int = 1,
) -> Complex64[np.ndarray, "*batch kept"]:
    """Return the baseband (IQ) samples of received (RF) signals.

    Mixed down, low-pass filtered without delay, and decimated. Works for band-pass sampling
    too, such as four samples in three periods: all that counts is that the band and its
    mirror image do not overlap once sampled.

    Args:
        rf: Real samples of any number type.
        sampling_frequency_hz: Of the samples.
        demodulation_frequency_hz: Carrier to remove, usually the centre of the probe's band.
        start_time_s: Time of the first sample after time zero; an array has one for each
            recording and must broadcast against ``batch``.
        bandwidth_hz: Width of the band to keep around the carrier; ``None`` keeps all that
            can be told from the mirror image.
        decimation: Keep every so many-th sample.

    Raises:
        ScanError: If the samples are complex or not all finite, or the rate is too low for
            the band.
    """
    samples, batch = rf.shape[-1], rf.shape[:-1]
    iq = np.empty((math.prod(batch), -(-samples // max(decimation, 1))), np.complex64)
    demodulate_into(
        iq,
        rf.reshape(len(iq), samples),
        sampling_frequency_hz,
        demodulation_frequency_hz,
        np.broadcast_to(start_time_s, batch).reshape(-1),
        bandwidth_hz,
        decimation,
    )
    return iq.reshape(*batch, iq.shape[1])


def demodulate_into(
    iq: Complex64[np.ndarray, "signals kept"],
    rf: Shaped[np.ndarray, "signals samples"],
    sampling_frequency_hz: float,
    demodulation_frequency_hz: float,
    start_times_s: Float[np.ndarray, " signals"],
    bandwidth_hz: float | None = None,
    decimation: int = 1,
) -> None:
    """Fill ``iq`` with the baseband samples of ``rf``, as :func:`demodulate` does."""
    if np.iscomplexobj(rf):
        raise ScanError("these samples are IQ already: only real (RF) samples are demodulated")
    if rf.size == 0:
        raise ScanError("there are no samples to demodulate")
    rate_hz, count = sampling_frequency_hz, rf.shape[-1]
    cutoff = _cutoff(rate_hz, demodulation_frequency_hz, bandwidth_hz)
    _check_decimation(rate_hz, cutoff, decimation)
    zeros = math.ceil(PADDING * rate_hz / cutoff)
    padded = decimation * fft.next_fast_len(-(-(count + zeros) // decimation))
    response = _response(padded, rate_hz, cutoff).astype(np.float32)
    step = max(1, CHUNK_SAMPLES // padded)
    for first in range(0, len(rf), step):
        chunk = slice(first, first + step)
        mixer = _carrier(count, rate_hz, -demodulation_frequency_hz, start_times_s[chunk])
        spectrum = fft.fft(rf[chunk].astype(np.float32) * mixer, padded, overwrite_x=True)
        spectrum *= response
        if decimation > 1:
            spectrum = spectrum.reshape(len(spectrum), decimation, -1).sum(1) / decimation
        iq[chunk] = fft.ifft(spectrum, overwrite_x=True)[:, : iq.shape[1]]
    if not np.isfinite(iq[:, 0]).all():  # the filter spreads NaN over all of a recording
        raise ScanError("samples are not all numbers: NaN or infinity cannot be demodulated")


def analytic_signal(
    iq: Shaped[np.ndarray, "*batch samples"],
    sampling_frequency_hz: float,
    demodulation_frequency_hz: float,
    *,
    start_time_s: float | Float[np.ndarray, "..."] = 0.0,
) -> Complex64[np.ndarray, "*batch samples"]:
    """Return the analytic signal of baseband samples; its real part is the RF signal.

    Args:
        iq: Complex samples.
        sampling_frequency_hz: Of the samples.
        demodulation_frequency_hz: Carrier that was removed.
        start_time_s: As for :func:`demodulate`.
    """
    starts = np.broadcast_to(start_time_s, iq.shape[:-1]).reshape(-1)
    carrier = _carrier(iq.shape[-1], sampling_frequency_hz, demodulation_frequency_hz, starts)
    return (iq.astype(np.complex64).reshape(-1, iq.shape[-1]) * carrier).reshape(iq.shape)


def _cutoff(rate_hz: float, carrier_hz: float, bandwidth_hz: float | None) -> float:
    """Return the half-width of the pass band, at the middle of its edges."""
    for what, value in (("sampling", rate_hz), ("demodulation", carrier_hz)):
        if not (math.isfinite(value) and value > 0):
            raise ScanError(f"the {what} frequency must be above 0 Hz, got {value:g}")
    mirror = abs(math.remainder(2 * carrier_hz, rate_hz))
    widest = mirror / 2 / (1 + EDGE / 2)
    if bandwidth_hz is None and mirror > 0.1 * min(carrier_hz, rate_hz):
        return widest
    wanted = 0.0 if bandwidth_hz is None else bandwidth_hz / 2
    if not 0 < wanted <= mirror / 2 * (1 + 1e-9):
        raise ScanError(
            f"{rate_hz:g} samples per second cannot tell a band of {2 * wanted:g} Hz around"
            f" {carrier_hz:g} Hz from its mirror image, which lies {mirror:g} Hz away"
        )
    return min(wanted, widest)


def _check_decimation(rate_hz: float, cutoff_hz: float, decimation: int) -> None:
    band_hz = 2 * cutoff_hz * (1 + EDGE / 2)
    if decimation < 1 or decimation * band_hz > rate_hz * (1 + 1e-9):
        raise ScanError(
            f"decimation by {decimation} leaves {rate_hz / max(decimation, 1):g} samples per"
            f" second for a band of {band_hz:g} Hz; narrow the band or decimate less"
        )


def _response(count: int, rate_hz: float, cutoff_hz: float) -> Float[np.ndarray, " count"]:
    """Return the low-pass filter, with the factor 2 that keeps the envelope's height."""
    offset = (np.abs(fft.fftfreq(count, 1 / rate_hz)) / cutoff_hz - 1) / EDGE
    return 1 - np.sin(np.pi * np.clip(offset, -0.5, 0.5))


def _carrier(
    samples: int, rate_hz: float, carrier_hz: float, starts_s: Float[np.ndarray, " signals"]
) -> Complex64[np.ndarray, "signals_or_one samples"]:
    """Return the carrier at the time of each sample, phase computed in double precision."""
    cycles = carrier_hz / rate_hz * np.arange(samples)
    wave = np.exp(2j * np.pi * np.remainder(cycles, 1)).astype(np.complex64)
    first = np.exp(2j * np.pi * np.remainder(carrier_hz * starts_s, 1)).astype(np.complex64)
    if len(first) and (first == first[0]).all():
        return wave[None] * first[0]
    return wave * first[:, None]
