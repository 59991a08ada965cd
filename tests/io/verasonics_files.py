"""Workspaces of a small Verasonics machine: 8 elements, frames of data set 2's kind."""

from typing import Any

import numpy as np

ELEMENTS = 8
FREQUENCY_MHZ = 5.0
SPEED = 1500.0
WAVELENGTH_MM = 0.3
ROWS = 64
START_DEPTH = 2.0  # wavelengths
PEAK = 1.5
LENS_MM = 0.6
ANGLES = (-0.2, 0.0, 0.2)
PULSES = 4
FRAMES = 3
# Element k is on this channel, counted from 1.
CONNECTOR = np.array([3, 1, 2, 4, 8, 7, 6, 5])


def positions_mm() -> np.ndarray:
    """Lateral position of each element."""
    return (np.arange(ELEMENTS) - (ELEMENTS - 1) / 2) * 0.3


def trans(units: str = "mm") -> dict[str, Any]:
    """The probe."""
    unit_mm = 1.0 if units == "mm" else WAVELENGTH_MM
    place = np.zeros((ELEMENTS, 5))
    place[:, 0] = positions_mm() / unit_mm
    return {
        "name": "L11-5v",
        "units": units,
        "frequency": FREQUENCY_MHZ,
        "ElementPos": place,
        "elementWidth": 0.27 / unit_mm,
        "lensCorrection": LENS_MM / unit_mm,
        "Connector": CONNECTOR.astype(np.float64)[:, None],
        "elevationApertureMm": 5.0,
        "elevationFocusMm": 18.0,
    }


def plane_wave(angle_rad: float) -> dict[str, Any]:
    """A TX that sends a plane wave; the first element to fire does so at time zero."""
    delays = positions_mm() * np.sin(angle_rad) / WAVELENGTH_MM
    return {"waveform": 1.0, "Apod": np.ones(ELEMENTS), "Delay": delays - delays.min()}


def laser() -> dict[str, Any]:
    """A TX in which nothing fires."""
    return {"waveform": 1.0, "Apod": np.zeros(ELEMENTS), "Delay": np.zeros(ELEMENTS)}


def receive(frame: int, acquisition: int, **other: Any) -> dict[str, Any]:
    """A Receive, all counted from 1."""
    return {
        "Apod": np.ones(ELEMENTS),
        "startDepth": START_DEPTH,
        "endDepth": START_DEPTH + ROWS / 8,
        "bufnum": 1.0,
        "framenum": float(frame),
        "acqNum": float(acquisition),
        "mode": 0.0,
        "sampleMode": "NS200BW",
        "decimSampleRate": 4 * FREQUENCY_MHZ,
        "demodFrequency": FREQUENCY_MHZ,
        "samplesPerWave": 4.0,
        "startSample": float((acquisition - 1) * ROWS + 1),
        "endSample": float(acquisition * ROWS),
        **other,
    }


def workspace(
    sent: list[dict[str, Any]],
    transmits: list[int],
    samples: np.ndarray,
    **receive_fields: Any,
) -> dict[str, Any]:
    """A workspace whose frame consists of these acquisitions.

    Args:
        sent: TX.
        transmits: For each acquisition of a frame, which TX, counted from 0.
        samples: ``(frames, acquisitions, elements, rows)``.
        receive_fields: Of every Receive.
    """
    frames, count = samples.shape[:2]
    receives = [
        receive(frame + 1, k + 1, **receive_fields) for frame in range(frames) for k in range(count)
    ]
    events = []
    for frame in range(frames):
        for k, transmit in enumerate(transmits):
            number = frame * count + k + 1
            events.append(
                {
                    "tx": float(transmit + 1),
                    "rcv": float(number),
                    "seqControl": np.array([2.0, 1.0]),
                }
            )
        events.append({"tx": 0.0, "rcv": 0.0, "seqControl": np.array([0.0])})
    buffer = np.zeros((count * ROWS, ELEMENTS, frames), np.int16)
    for frame in range(frames):
        rows = samples[frame].transpose(0, 2, 1).reshape(count * ROWS, ELEMENTS)
        buffer[:, CONNECTOR - 1, frame] = rows
    return {
        "RcvData": (buffer,),
        "Receive": receives,
        "TX": sent,
        "TW": {"type": "parametric", "peak": PEAK},
        "Trans": trans(),
        "Resource": {
            "Parameters": {"speedOfSound": SPEED, "numTransmit": 8.0},
            "RcvBuffer": {"numFrames": float(frames), "lastFrame": 0.0},
        },
        "Event": events,
        "SeqControl": [
            {"command": "timeToNextAcq", "argument": 200.0},
            {"command": "transferToHost", "argument": np.zeros((0, 0))},
        ],
        "P": {"startDepth": START_DEPTH},
    }


def interleaved() -> tuple[dict[str, Any], np.ndarray]:
    """Three angles, an ensemble of four pulses and a laser shot; the samples beside it."""
    count = len(ANGLES) + PULSES + 1
    generator = np.random.default_rng(5)
    samples = generator.integers(-(2**13), 2**13, (FRAMES, count, ELEMENTS, ROWS), np.int16)
    sent = [*map(plane_wave, ANGLES), {**plane_wave(0.0), "waveform": 1.0}, laser()]
    sent[3] = plane_wave(0.05)
    transmits = [0, 1, 2, *[3] * PULSES, 4]
    return workspace(sent, transmits, samples), samples
