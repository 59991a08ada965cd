"""Gray levels from amplitudes: gain and log compression.

Frames of a sweep share one reference amplitude. With the maximum of each frame instead, gray
levels would change from frame to frame with whatever is brightest.
"""

import numpy as np
from jaxtyping import Complex, Float, UInt8

from sonosweep.errors import ScanError


def envelope(
    iq: Complex[np.ndarray, "*frames rows columns"],
) -> Float[np.ndarray, "*frames rows columns"]:
    """Return the amplitude of IQ."""
    return np.abs(iq)


def log_compress(
    amplitude: Float[np.ndarray, "*frames rows columns"],
    reference: float,
    dynamic_range_db: float = 60.0,
    gain_db: float | Float[np.ndarray, " rows"] = 0.0,
) -> UInt8[np.ndarray, "*frames rows columns"]:
    """Return gray levels: 255 at the reference and above, 0 a dynamic range below it.

    Args:
        amplitude: Envelope, or photoacoustic amplitude; the square root of a power.
        reference: Amplitude that is white without gain.
        dynamic_range_db: Between black and white, 20 dB being a factor of 10 in amplitude.
        gain_db: Added before compression, the same everywhere or for each row.

    Raises:
        ScanError: If the reference or range is not positive, or an amplitude is not a
            number.
    """
    check_compression(reference, dynamic_range_db)
    if not np.isfinite(amplitude).all():
        raise ScanError("the image holds amplitudes that are not numbers (NaN or infinite)")
    smallest = np.finfo(amplitude.dtype).tiny
    level = np.log10(np.maximum(amplitude, smallest))
    gain = np.asarray(gain_db, amplitude.dtype)
    offset_db = (gain[:, np.newaxis] if gain.ndim else gain) - 20 * np.log10(reference)
    level *= 20 * 255 / dynamic_range_db
    level += (offset_db * (255 / dynamic_range_db) + 255.5).astype(amplitude.dtype)
    return np.clip(level, 0, 255, out=level).astype(np.uint8)


def check_compression(reference: float, dynamic_range_db: float) -> None:
    """Check the numbers of a log compression.

    Raises:
        ScanError: If the reference or range is not positive and finite.
    """
    for what, value in (("reference amplitude", reference), ("dynamic range", dynamic_range_db)):
        if not (np.isfinite(value) and value > 0):
            raise ScanError(f"the {what} of a log compression must be above 0, got {value:g}")
