"""Make ``speckle_pymust.npz``: scatterers, and images of them by a simulation of the waves.

PyMUST (https://pypi.org/project/pymust) computes the echoes of 31 plane waves at an L11-5v
and beamforms them; nothing of this project is used. The scatterers are turned in the imaging
plane about the middle of the image, as when the probe turns. Takes five minutes.

    python -m pip install pymust==0.1.9
    python tests/simulate/golden/make_speckle.py
"""

from pathlib import Path

import numpy as np
import pymust
from scipy.signal import hilbert

ANGLES_RAD = np.deg2rad(np.linspace(-15, 15, 31))
MIDDLE_MM = (0.0, 18.0)
HALF_SIZE_MM = 4.2
PER_MM2 = 22
PIXELS = 120
SPACING_MM = 0.05
TURNS_DEG = (0, 2, 5, 10)
F_NUMBER = 1.5


def main() -> None:
    """Write the file beside this script."""
    rng = np.random.default_rng(900_000)
    count = int(PER_MM2 * (2 * HALF_SIZE_MM) ** 2)
    points = rng.uniform(-HALF_SIZE_MM, HALF_SIZE_MM, (count, 2))
    amplitudes = rng.standard_normal(count)
    images = np.array([image(turned(points, degrees), amplitudes) for degrees in TURNS_DEG])
    images /= np.abs(images).max()
    np.savez_compressed(
        Path(__file__).with_name("speckle_pymust.npz"),
        points_mm=points.astype(np.float32),
        amplitudes=amplitudes.astype(np.float32),
        turns_deg=np.array(TURNS_DEG, np.float32),
        echoes=np.stack([np.real(images), np.imag(images)], 1).astype(np.float16),
        middle_mm=np.array(MIDDLE_MM),
        spacing_mm=SPACING_MM,
    )


def turned(points: np.ndarray, degrees: float) -> np.ndarray:
    """Return points after a rotation that takes the lateral axis to the axial one."""
    cosine, sine = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    return points @ np.array([[cosine, sine], [-sine, cosine]])


def image(points: np.ndarray, amplitudes: np.ndarray) -> np.ndarray:
    """Return the beamformed echoes on a grid about the middle; points are relative to it."""
    axis = (np.arange(PIXELS) - (PIXELS - 1) / 2) * SPACING_MM
    x, z = np.meshgrid(MIDDLE_MM[0] + axis, MIDDLE_MM[1] + axis)
    total = np.zeros(x.shape, complex)
    for angle in ANGLES_RAD:
        param = pymust.getparam("L11-5v")
        param.fs = 4 * param.fc
        param.fnumber = F_NUMBER
        delays = pymust.txdelay(param, angle)
        at = (points + MIDDLE_MM) * 1e-3
        rf = pymust.simus(at[:, 0], at[:, 1], amplitudes, delays, param)[0]
        # The analytic signal, mixed down: pymust.rf2iq would narrow the band.
        times_s = np.arange(len(rf))[:, None] / param.fs
        iq = hilbert(rf, axis=0) * np.exp(-2j * np.pi * param.fc * times_s)
        matrix = pymust.dasmtx(1j * np.array(iq.shape), x * 1e-3, z * 1e-3, delays, param)
        total += (matrix @ iq.flatten(order="F")).reshape(x.shape, order="F")
    return total


if __name__ == "__main__":
    main()
