"""What is particular to photoacoustic samples: a wide band, with drift below it.

Their image is the envelope of a one-way delay-and-sum, see
:mod:`sonosweep.imaging.beamform`.
"""

import numpy as np
from jaxtyping import Float32, Shaped

from sonosweep.errors import ScanError

ORDER = 4


def band_pass(
    rf: Shaped[np.ndarray, "*batch samples"],
    sampling_frequency_hz: float,
    band_hz: tuple[float, float],
) -> Float32[np.ndarray, "*batch samples"]:
    """Return what elements received within a band, without delay.

    A Butterworth filter of 4th order runs forward and backward: 6 dB less at the edges of
    the band, which bounds drift below and noise above it.

    Args:
        rf: Real samples of any number type.
        sampling_frequency_hz: Of the samples.
        band_hz: Lower and upper edge.

    Raises:
        ScanError: If the band is not between 0 and half the sampling frequency, samples
            are not all numbers, or there are too few.
    """
    from scipy import signal  # takes half a second to load, which others need not wait for

    low, high = band_hz
    if not 0 < low < high < sampling_frequency_hz / 2:
        raise ScanError(
            f"the band must lie between 0 and {sampling_frequency_hz / 2:g} Hz, half the sampling"
            f" frequency, got {low:g} to {high:g} Hz"
        )
    sections = signal.butter(
        ORDER, band_hz, "bandpass", fs=sampling_frequency_hz, output="sos"
    ).astype(np.float64)
    padding = 3 * (2 * len(sections) + 1)
    if rf.shape[-1] <= padding:
        raise ScanError(f"a band-pass filter needs more than {padding} samples, got {rf.shape[-1]}")
    samples = rf.astype(np.float64)
    if not np.isfinite(samples).all():
        raise ScanError("samples are not all numbers: NaN or infinity cannot be filtered")
    return signal.sosfiltfilt(sections, samples, padlen=padding).astype(np.float32)
