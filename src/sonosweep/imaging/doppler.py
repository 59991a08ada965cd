"""Flow from an ensemble: how much moves, and how fast along the beam."""

from itertools import pairwise

import numpy as np
from jaxtyping import Complex, Float
from scipy import ndimage

from sonosweep.errors import ScanError


def power_doppler(
    ensemble: Complex[np.ndarray, "pulses rows columns"],
) -> Float[np.ndarray, "rows columns"]:
    """Return the mean power of the pulses; of blood, if clutter was filtered out before."""
    power = np.zeros(ensemble.shape[1:], ensemble.real.dtype)
    for pulse in ensemble:
        power += pulse.real**2
        power += pulse.imag**2
    power /= len(ensemble)
    return power


def lag_one(
    ensemble: Complex[np.ndarray, "pulses rows columns"],
) -> Complex[np.ndarray, "rows columns"]:
    """Return the mean product of each pulse and the conjugate of the one before.

    Raises:
        ScanError: If there are fewer than two pulses.
    """
    if len(ensemble) < 2:
        raise ScanError(f"an ensemble needs at least 2 pulses, got {len(ensemble)}")
    correlation = np.zeros(ensemble.shape[1:], ensemble.dtype)
    for before, after in pairwise(ensemble):
        correlation += after * before.conj()
    correlation /= len(ensemble) - 1
    return correlation


def axial_velocity(
    ensemble: Complex[np.ndarray, "pulses rows columns"],
    center_frequency_hz: float,
    pulse_repetition_hz: float,
    sound_speed_m_per_s: float = 1540.0,
    window: tuple[int, int] = (1, 1),
) -> Float[np.ndarray, "rows columns"]:
    """Return the velocity along the beam in mm/s, positive away from the probe.

    Only velocities up to c PRF / (4 f0) can be told from each other; faster ones alias.

    Args:
        ensemble: IQ; the phase of an echo falls as its depth grows.
        center_frequency_hz: Of the echoes.
        pulse_repetition_hz: Rate of the pulses of the ensemble.
        sound_speed_m_per_s: In tissue.
        window: Rows and columns over which the lag-one product is averaged before its
            phase is taken.

    Raises:
        ScanError: If there are fewer than two pulses.

    References:
        Kasai et al., "Real-time two-dimensional blood flow imaging using an autocorrelation
        technique", IEEE Trans. Sonics Ultrason. 1985, equation 12.
    """
    correlation = lag_one(ensemble)
    if max(window) > 1:
        smooth = [
            ndimage.uniform_filter(part, window) for part in (correlation.real, correlation.imag)
        ]
        correlation = smooth[0] + 1j * smooth[1]
    scale = sound_speed_m_per_s * 1e3 * pulse_repetition_hz / (4 * np.pi * center_frequency_hz)
    return -scale * np.angle(correlation)
