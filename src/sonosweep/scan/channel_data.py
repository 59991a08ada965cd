"""What the elements received, before beamforming."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from torch import Tensor

from sonosweep.errors import ScanError
from sonosweep.scan.frames import Frames
from sonosweep.scan.probe import Probe


@dataclass(frozen=True, eq=False)
class ChannelData:
    """Samples of one acquisition, per frame, transmit and element.

    Attributes:
        name: What to call it.
        samples: ``(frames, transmits, elements, samples)``, real (RF) or complex (IQ); read
            when indexed by frame.
        probe: Where the elements are.
        sampling_frequency_hz: Of the samples.
        demodulation_frequency_hz: Carrier removed from IQ; 0 for RF.
        start_time_s: Time of the first sample after each transmit's time zero.
        transmit_delays_s: When each element fires, ``(transmits, elements)``; ``None`` for
            one-way (photoacoustic) data, whose time zero is the laser pulse.
        sound_speed_m_per_s: Speed assumed by the machine.
        timestamps_s: Time of each frame; ``None`` if not known.
        pulse_repetition_hz: Rate of the transmits within a frame; ``None`` if not known.
    """

    name: str
    samples: Frames
    probe: Probe
    sampling_frequency_hz: float
    demodulation_frequency_hz: float = 0.0
    start_time_s: Float[Tensor, " transmits"] | None = None
    transmit_delays_s: Float[Tensor, "transmits elements"] | None = None
    sound_speed_m_per_s: float = 1540.0
    timestamps_s: Float[Tensor, " frames"] | None = None
    pulse_repetition_hz: float | None = None

    def __post_init__(self) -> None:
        """Check that the geometry fits the samples.

        Raises:
            ScanError: If counts differ or a frequency or speed is not positive.
        """
        shape = self.samples.shape
        if len(shape) != 4:
            raise ScanError(
                "channel data must have frames, transmits, elements and samples, got shape"
                f" {shape} in '{self.name}'"
            )
        elements = len(self.probe.element_positions_mm)
        if shape[2] != elements:
            raise ScanError(
                f"{shape[2]} channels but probe '{self.probe.name}' has {elements} elements"
            )
        for what, value in (
            ("sampling frequency", self.sampling_frequency_hz),
            ("sound speed", self.sound_speed_m_per_s),
        ):
            if not (np.isfinite(value) and value > 0):
                raise ScanError(f"{what} must be above 0, got {value:g} in '{self.name}'")
        self._check_transmits()

    def _check_transmits(self) -> None:
        transmits, elements = self.samples.shape[1:3]
        if self.transmit_delays_s is not None and self.transmit_delays_s.shape != (
            transmits,
            elements,
        ):
            raise ScanError(
                f"transmit delays of shape {tuple(self.transmit_delays_s.shape)} for"
                f" {transmits} transmits of {elements} elements in '{self.name}'"
            )
        if self.start_time_s is not None and len(self.start_time_s) != transmits:
            raise ScanError(
                f"{len(self.start_time_s)} start times for {transmits} transmits in '{self.name}'"
            )
