"""Channel data of a few points, computed here and nowhere else: what the chain must find."""

import numpy as np
import torch

from sonosweep.scan import ChannelData, ChannelSweep, Probe

SPEED_MM_S = 1540e3
CARRIER_HZ, RATE_HZ, PRF_HZ = 5e6, 20e6, 4e3
ELEMENTS, SAMPLES, PULSES = 32, 400, 8
TISSUE_MM, BLOOD_MM, ABSORBER_MM = (-1.5, 6.0), (1.5, 8.0), (0.5, 5.0)
"""Lateral and axial place of the points, in front of the middle of the array's face."""
BLOOD_PART = 0.03  # of the tissue's amplitude: 30 dB of clutter
FRAMES = 3


def probe() -> Probe:
    """A straight array."""
    positions = torch.zeros(ELEMENTS, 3, dtype=torch.float64)
    positions[:, 0] = 0.3 * (torch.arange(ELEMENTS) - (ELEMENTS - 1) / 2)
    return Probe("made up", positions, 0.27, CARRIER_HZ)


def echoes(points: list[tuple[float, float, complex]], angle_rad: float | None) -> np.ndarray:
    """Return what the elements receive from points (lateral, axial, amplitude).

    A plane wave passes the middle of the face at time zero; without an angle sound starts
    in the points then.
    """
    lateral = probe().element_positions_mm[:, :1].numpy()
    time_s = np.arange(SAMPLES) / RATE_HZ
    received = np.zeros((ELEMENTS, SAMPLES))
    for x, z, amplitude in points:
        there = 0.0 if angle_rad is None else x * np.sin(angle_rad) + z * np.cos(angle_rad)
        since = time_s - (there + np.hypot(lateral - x, z)) / SPEED_MM_S
        pulse = np.exp(-((since * CARRIER_HZ) ** 2)) * np.exp(2j * np.pi * CARRIER_HZ * since)
        received += (amplitude * pulse).real
    return received


def delays(angles_rad: list[float]) -> torch.Tensor:
    """Return when the elements fire for plane waves that pass the middle at time zero."""
    lateral = probe().element_positions_mm[:, 0]
    return torch.stack([lateral * np.sin(angle) / SPEED_MM_S for angle in angles_rad])


def data(samples: np.ndarray, transmit_delays_s: torch.Tensor | None = None) -> ChannelData:
    """Return channel data of frames at 10 Hz."""
    return ChannelData(
        "points",
        samples.astype(np.float32),
        probe(),
        RATE_HZ,
        transmit_delays_s=transmit_delays_s,
        timestamps_s=torch.arange(len(samples), dtype=torch.float64) / 10,
        pulse_repetition_hz=PRF_HZ,
    )


def sweep() -> ChannelSweep:
    """Still tissue, blood that changes from pulse to pulse, an absorber; tracked, 3 frames.

    Noise is 60 dB below the tissue's echo.
    """
    random = np.random.default_rng(7)
    tissue, absorber = (*TISSUE_MM, 1.0), (*ABSORBER_MM, 1.0)
    angles = [-0.1, 0.0, 0.1]
    waves = np.stack([echoes([tissue], angle) for angle in angles])
    turns = np.exp(2j * np.pi * random.random((FRAMES, PULSES)))
    pulses = np.stack(
        [[echoes([tissue, (*BLOOD_MM, BLOOD_PART * turn)], 0.0) for turn in each] for each in turns]
    )
    pulses += 1e-3 * random.standard_normal(pulses.shape)
    brighter = np.arange(1, FRAMES + 1)[:, None, None, None]
    poses = torch.eye(4, dtype=torch.float64).repeat(FRAMES, 1, 1)
    poses[:, 2, 3] = 0.3 * torch.arange(FRAMES)
    return ChannelSweep(
        "points",
        b_mode=data(waves * brighter, delays(angles)),
        power_doppler=data(pulses, delays([0.0] * PULSES)),
        photoacoustic=data(brighter * echoes([absorber], None)[None]),
        image_to_reference=poses,
        subject="900001",
        notes={"made": "by a test"},
    )
