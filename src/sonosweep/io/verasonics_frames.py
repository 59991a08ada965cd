"""Samples cut out of Verasonics' receive buffers: one shot after the other, by element."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Complex64

from sonosweep.errors import FormatError
from sonosweep.scan import Frames, LazyFrames

Sampling = Literal["rf", "quadrature", "interleaved"]
"""How a row of the buffer is to be understood: samples of the signal; pairs that are a
quarter of the carrier's period apart; or every other sample, of two acquisitions."""


@dataclass(frozen=True)
class Cut:
    """Where the samples of some elements are in a frame of the buffer.

    Attributes:
        elements: Which elements of the array.
        channels: The column of each.
        row: The first row.
        step: 0 or 1, if it is the first or the second of two interleaved acquisitions.
    """

    elements: np.ndarray
    channels: np.ndarray
    row: int
    step: int = 0


class BufferFrames(LazyFrames):
    """Samples ``(frames, transmits, elements, samples)`` of some shots of a receive buffer.

    Elements that did not receive in a shot hold zeros.

    Args:
        buffer: ``(frames, 1, channels, rows)``.
        places: Which of its frames, in the order of time.
        cuts: The pieces of each shot.
        elements: Of the array.
        rows: That a shot takes in the buffer.
        sampling: What these are.
        carriers: For pairs, what turns their analytic signal into baseband samples,
            ``(transmits, samples)``.
        lag: By how much of the interval between pairs the second of a pair is later.
    """

    def __init__(
        self,
        buffer: Frames,
        places: np.ndarray,
        cuts: list[list[Cut]],
        elements: int,
        rows: int,
        sampling: Sampling,
        carriers: Complex64[np.ndarray, "transmits samples"] | None = None,
        lag: float = 0.0,
    ) -> None:
        samples = {"rf": rows, "quadrature": rows // 2, "interleaved": 2 * rows}[sampling]
        dtype = np.dtype(np.complex64) if sampling == "quadrature" else buffer.dtype
        super().__init__((len(places), len(cuts), elements, samples), dtype)
        self._buffer, self._places, self._cuts = buffer, places, cuts
        self._rows, self._sampling, self._carriers = rows, sampling, carriers
        self._lag = lag

    def _read(self, frame: int) -> np.ndarray:
        stored = np.asarray(self._buffer[int(self._places[frame])])[0]
        if stored.shape != tuple(self._buffer.shape[2:]):
            raise FormatError("the receive buffer changed after it was opened: open it again")
        samples = np.zeros(self._shape[1:], self._dtype)
        for transmit, cuts in enumerate(self._cuts):
            for cut in cuts:
                rows = stored[cut.channels, cut.row : cut.row + self._rows]
                self._put(samples[transmit], cut, rows)
        if self._carriers is not None:
            samples *= self._carriers[:, None]
        return samples

    def _put(self, shot: np.ndarray, cut: Cut, rows: np.ndarray) -> None:
        if self._sampling == "interleaved":
            shot[cut.elements, cut.step :: 2] = rows
        elif self._sampling == "quadrature":
            # A quarter of a period later, the signal is minus its analytic signal's imaginary
            # part.
            pairs = rows[:, : 2 * self._shape[3]].astype(np.float32)
            shot[cut.elements] = pairs[:, 0::2] - 1j * _earlier(pairs[:, 1::2], self._lag)
        else:
            shot[cut.elements] = rows


def _earlier(values: np.ndarray, lag: float) -> np.ndarray:
    """Return values as they were a part of a sampling interval earlier, by a cubic."""
    places = np.arange(-2, 2) + lag
    count = values.shape[1]
    padded = np.pad(values, ((0, 0), (2, 1)), mode="edge")
    found = np.zeros_like(values)
    for k, place in enumerate(places):
        others = np.delete(places, k)
        weight = np.float32(np.prod(-others / (place - others)))
        found += weight * padded[:, k : k + count]
    return found
