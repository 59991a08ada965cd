"""Make the golden files of the beamforming tests with PyMUST.

Two files, both of an L11-5v sampled at four times its center frequency:

``pymust_points.npz``: RF of 31 plane waves, -15 to 15 degrees, from three points.
``pymust_speckle.npz``: RF of 3 plane waves from 600 scatterers in a band of tissue with a
cyst, and PyMUST's own image of it: ``rf2iq``, ``dasmtx`` with linear interpolation at f-number
1.5, summed over the transmits.

Run it in a virtual environment of its own, which needs nothing else:

    pip install pymust==0.1.9
    python tests/imaging/golden/make_golden.py
"""

from pathlib import Path

import numpy as np
import pymust

FOLDER = Path(__file__).parent
PEAK_OF_POINTS = 127
PEAK_OF_SPECKLE = 2047
"""RF is rounded to 8 and 12 bits, which keeps the files small: less than the noise of a
machine."""
POINTS_MM = np.array([[0.0, 20.0], [-10.0, 20.0], [5.0, 26.0]])
LATERAL_MM = np.linspace(-6, 6, 121)
AXIAL_MM = np.linspace(14, 22, 161)


def main() -> None:
    """Write both files beside this script."""
    probe = pymust.getparam("L11-5v")
    probe.fs, probe.c, probe.fnumber = 4 * probe.fc, 1540.0, 1.5

    angles_deg = np.linspace(-15, 15, 31)
    rf, delays_s, first = simulate(probe, POINTS_MM, np.ones(3), angles_deg, PEAK_OF_POINTS)
    save("pymust_points.npz", probe, rf, delays_s, first, points_mm=POINTS_MM)

    generator = np.random.default_rng(7)
    places = generator.uniform((-7, 13), (7, 23), (600, 2))
    places = places[np.hypot(places[:, 0], places[:, 1] - 18) > 1.5]
    strength = generator.rayleigh(size=len(places))
    angles_deg = np.array([-12.0, 0.0, 9.0])
    rf, delays_s, first = simulate(probe, places, strength, angles_deg, PEAK_OF_SPECKLE)
    image = beamform(probe, rf, delays_s, first)
    save(
        "pymust_speckle.npz",
        probe,
        rf,
        delays_s,
        first,
        lateral_mm=LATERAL_MM,
        axial_mm=AXIAL_MM,
        image=image.astype(np.complex64),
    )


def simulate(probe, places_mm, strength, angles_deg, peak):
    """Return rounded RF ``(transmits, elements, samples)``, delays and the first sample kept."""
    recordings, delays = [], []
    for angle in np.deg2rad(angles_deg):
        delay = pymust.txdelay(probe, float(angle))
        x, z = places_mm.T * 1e-3
        recordings.append(pymust.simus(x, z, strength, delay, probe)[0].T)
        delays.append(delay.ravel())
    longest = max(recording.shape[1] for recording in recordings)
    rf = np.zeros((len(recordings), 128, longest))
    for k, recording in enumerate(recordings):
        rf[k, :, : recording.shape[1]] = recording
    rf = np.rint(rf * (peak / np.abs(rf).max())).astype(np.int16)
    heard = np.flatnonzero(rf.any((0, 1)))
    return rf[..., heard[0] : heard[-1] + 1], np.array(delays), int(heard[0])


def beamform(probe, rf, delays_s, first):
    """Return PyMUST's image, rows axial and columns lateral, summed over the transmits."""
    x, z = np.meshgrid(LATERAL_MM * 1e-3, AXIAL_MM * 1e-3)
    probe.t0 = np.array([first / probe.fs])
    total = np.zeros(x.shape, complex)
    for signals, delay in zip(rf, delays_s, strict=True):
        iq = pymust.rf2iq(signals.T.astype(float), probe.fs, probe.fc)
        probe.TXdelay = delay
        iq = iq * np.exp(-2j * np.pi * probe.fc * first / probe.fs)
        matrix = pymust.dasmtx(1j * np.array(iq.shape), x, z, delay, probe)
        total += (matrix @ iq.ravel(order="F")).reshape(x.shape, order="F")
    return total


def save(name, probe, rf, delays_s, first, **more):
    """Write a compressed file with the RF and what is needed to beamform it."""
    np.savez_compressed(
        FOLDER / name,
        rf=rf,
        transmit_delays_s=delays_s,
        start_time_s=first / probe.fs,
        sampling_frequency_hz=probe.fs,
        center_frequency_hz=probe.fc,
        pitch_mm=probe.pitch * 1e3,
        width_mm=probe.width * 1e3,
        **more,
    )


if __name__ == "__main__":
    main()
