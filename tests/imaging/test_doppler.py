"""How much flows, and how fast."""

import numpy as np
import pytest

from sonosweep.errors import ScanError
from sonosweep.imaging.doppler import axial_velocity, lag_one, power_doppler

F0_HZ, PRF_HZ, SPEED = 5e6, 4e3, 1540.0
NYQUIST_MM_S = SPEED * 1e3 * PRF_HZ / (4 * F0_HZ)


def receding(velocity_mm_s, pulses=12, rows=4, columns=3):
    """Return the IQ of scatterers that move away from the probe: depth grows, phase falls."""
    depth_mm = velocity_mm_s * np.arange(pulses) / PRF_HZ
    turned = np.exp(-4j * np.pi * F0_HZ * depth_mm / (SPEED * 1e3))
    still = np.random.default_rng(1).standard_normal((rows, columns, 2)) @ [1, 1j]
    return turned[:, None, None] * still


@pytest.mark.parametrize("part", [-0.95, -0.3, 0.0, 0.1, 0.95])
def test_velocity_below_the_nyquist_limit(part):
    """Up to c PRF / 4 f0 the velocity is exact, positive away from the probe."""
    velocity = axial_velocity(receding(part * NYQUIST_MM_S), F0_HZ, PRF_HZ, SPEED)

    assert np.allclose(velocity, part * NYQUIST_MM_S, rtol=1e-9, atol=1e-9)


def test_faster_flow_aliases():
    """A little more than the limit away looks like a little less than the limit towards."""
    velocity = axial_velocity(receding(1.1 * NYQUIST_MM_S), F0_HZ, PRF_HZ, SPEED)

    assert np.allclose(velocity, -0.9 * NYQUIST_MM_S)


def test_a_window_averages_before_the_phase_is_taken():
    """A weak pixel with a wrong phase does not disturb its strong neighbors."""
    ensemble = receding(0.5 * NYQUIST_MM_S, rows=9, columns=9)
    ensemble /= np.abs(ensemble)
    ensemble[:, 4, 4] = 0.01 * ensemble[:, 4, 4].conj()

    alone, window = (
        axial_velocity(ensemble, F0_HZ, PRF_HZ, SPEED, (size, size))[4, 4] for size in (1, 3)
    )

    assert alone == pytest.approx(-0.5 * NYQUIST_MM_S)
    assert window == pytest.approx(0.5 * NYQUIST_MM_S, rel=1e-3)


def test_power_is_the_mean_square():
    """The power of pulses is that of their samples, phase or not."""
    ensemble = receding(20.0).astype(np.complex64)

    power = power_doppler(ensemble)

    assert power.dtype == np.float32
    assert np.allclose(power, np.mean(np.abs(ensemble) ** 2, axis=0), rtol=1e-6)


def test_one_pulse_has_no_velocity():
    """Two are needed for a phase between them."""
    with pytest.raises(ScanError, match="at least 2 pulses, got 1"):
        lag_one(np.ones((1, 2, 2), complex))
