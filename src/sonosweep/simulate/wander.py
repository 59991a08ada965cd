"""Random wandering as a function of continuous time, the same read on any clock."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.special import ndtri

SINUSOIDS = 48
AT_A_TIME = 4096  # times, so that little memory is needed


@dataclass(frozen=True, eq=False)
class Wander:
    """A stationary random signal made of sinusoids; time reversed, it is as likely.

    Attributes:
        rates_rad_per_s: Of each sinusoid.
        phases_rad: Of each sinusoid.
        amplitude: Of all of them.
    """

    rates_rad_per_s: Float[np.ndarray, " sinusoids"]
    phases_rad: Float[np.ndarray, " sinusoids"]
    amplitude: float

    def __call__(self, times_s: Float[np.ndarray, " times"]) -> Float[np.ndarray, " times"]:
        """Return the signal at these times."""
        signal = np.empty(len(times_s))
        for first in range(0, len(times_s), AT_A_TIME):
            some = slice(first, first + AT_A_TIME)
            angles = times_s[some, None] * self.rates_rad_per_s + self.phases_rad
            signal[some] = self.amplitude * np.cos(angles).sum(axis=1)
        return signal


def slow_wander(generator: np.random.Generator, deviation: float, scale_s: float) -> Wander:
    """Return a signal whose correlation is exp(-t^2 / (2 scale^2)), as a hand drifts.

    Args:
        generator: Draws it.
        deviation: Standard deviation; that of its rate of change is deviation / scale.
        scale_s: Time over which it changes.
    """
    # One draw per equal part of the spectrum: each signal has all of its frequencies.
    quantiles = (np.arange(SINUSOIDS) + generator.uniform(size=SINUSOIDS)) / SINUSOIDS
    return _sinusoids(generator, deviation, ndtri(quantiles) / scale_s)


def tremor(
    generator: np.random.Generator, deviation: float, band_hz: tuple[float, float] = (8.0, 12.0)
) -> Wander:
    """Return a signal within a band of frequencies, by default that of physiological tremor.

    References:
        Elble and Koller, "Tremor", 1990: 8 to 12 Hz in the hands of healthy people.
    """
    frequencies_hz = generator.uniform(*band_hz, size=SINUSOIDS)
    return _sinusoids(generator, deviation, 2 * np.pi * frequencies_hz)


def _sinusoids(
    generator: np.random.Generator, deviation: float, rates_rad_per_s: np.ndarray
) -> Wander:
    phases = generator.uniform(0, 2 * np.pi, size=SINUSOIDS)
    return Wander(rates_rad_per_s, phases, deviation * np.sqrt(2 / SINUSOIDS))
