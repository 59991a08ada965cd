"""Channel data for the tests of its readers."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from sonosweep.errors import SonosweepError
from sonosweep.scan import ChannelData, ChannelSweep, Probe, modalities

from .damage import assert_one_sentence


def linear_probe(elements: int = 4) -> Probe:
    """A small straight array."""
    positions = torch.zeros(elements, 3, dtype=torch.float64)
    positions[:, 0] = (torch.arange(elements) - (elements - 1) / 2) * 0.3
    return Probe("L11-5v", positions, 0.27, 7.6e6, 5.0, 18.0)


def full_sweep() -> ChannelSweep:
    """Channel data with something in every field, 3 frames."""
    generator = np.random.default_rng(2)
    times = torch.tensor([0.0, 0.05, 0.11], dtype=torch.float64)
    poses = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    poses[:, 2, 3] = torch.arange(3) * 0.2
    poses[1] = torch.nan

    def data(name: str, samples: np.ndarray, **more: Any) -> ChannelData:
        return ChannelData(name, samples, linear_probe(), 31.25e6, timestamps_s=times, **more)

    iq = generator.standard_normal((3, 2, 4, 6)) + 1j * generator.standard_normal((3, 2, 4, 6))
    return ChannelSweep(
        name="forearm Ü",
        b_mode=data(
            "angles",
            generator.integers(-(2**13), 2**13, (3, 5, 4, 8), dtype=np.int16),
            start_time_s=torch.linspace(1e-6, 2e-6, 5, dtype=torch.float64),
            transmit_delays_s=torch.from_numpy(generator.random((5, 4)) * 1e-6),
            sound_speed_m_per_s=1480.0,
            pulse_repetition_hz=10_000.0,
        ),
        power_doppler=data(
            "ensemble",
            iq.astype(np.complex64),
            transmit_delays_s=torch.zeros(2, 4, dtype=torch.float64),
            demodulation_frequency_hz=7.6e6,
            pulse_repetition_hz=3000.0,
        ),
        photoacoustic=data("laser", generator.random((3, 1, 4, 7), dtype=np.float32)),
        image_to_reference=poses,
        tracked=torch.tensor([True, False, True]),
        subject="007",
        notes={"time": "made up\nin two lines"},
    )


def assert_same_data(again: ChannelData, data: ChannelData) -> None:
    """Check that two pieces of channel data are equal, bit by bit."""
    np.testing.assert_array_equal(again.samples[:], data.samples[:])
    assert again.samples.dtype == data.samples.dtype
    for name, value in vars(data).items():
        if name in ("samples", "probe"):
            continue
        assert_same_value(getattr(again, name), value)
    for name, value in vars(data.probe).items():
        assert_same_value(getattr(again.probe, name), value)


def assert_same_value(again: object, value: object) -> None:
    """Check that two fields are equal, tensors included."""
    if isinstance(value, torch.Tensor):
        np.testing.assert_array_equal(again, value)
    else:
        assert again == value


def assert_opens_or_explains(read: Callable[[], ChannelSweep]) -> None:
    """Run a reader and read samples: either works, or one clear sentence comes out."""
    try:
        for data in modalities(read()).values():
            last = data.samples[len(data.samples) - 1]
            assert last.shape == data.samples.shape[1:]
    except SonosweepError as error:
        assert_one_sentence(error)
