"""Delay-and-sum in torch: on GPUs, in batches, and differentiable in the samples."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Complex
from torch import Tensor, nn

from sonosweep.errors import ScanError
from sonosweep.imaging import das_kernels as kernels
from sonosweep.imaging.prepared import Beamformer, DelayTable


class TorchBeamformer(nn.Module):
    """The same numbers as a prepared :class:`Beamformer`, to rounding, on any device.

    Takes baseband samples: ``beamformer.baseband(samples)`` makes them from what was recorded.

    Args:
        beamformer: Of :func:`sonosweep.imaging.prepare_beamformer`.

    Raises:
        ScanError: If the beamformer was not prepared.
    """

    transmit: Tensor
    phases: Tensor
    pixels: Tensor
    delays: Tensor
    weights: Tensor

    def __init__(self, beamformer: Beamformer) -> None:
        super().__init__()
        if beamformer.tables is None:
            raise ScanError("only a prepared beamformer has delays that torch can use")
        self.geometry, self.compound = beamformer.geometry, beamformer.compound
        tables = beamformer.tables
        transmits = self.geometry.transmits
        transmit = np.concatenate([table.transmit for table in tables], axis=1)
        phases = np.concatenate([table.phases for table in tables], axis=1)
        pixels, delays, weights, self._splits = _by_element(tables)
        self.register_buffer("transmit", torch.from_numpy(transmit.reshape(transmits, -1)))
        self.register_buffer("phases", torch.from_numpy(phases.reshape(transmits, -1)))
        self.register_buffer("pixels", torch.from_numpy(pixels))
        self.register_buffer("delays", torch.from_numpy(delays))
        self.register_buffer("weights", torch.from_numpy(weights))

    def forward(
        self, iq: Complex[Tensor, "*frames transmits elements samples"]
    ) -> Complex[Tensor, "..."]:
        """Return the analytic signal at the pixels, as :meth:`Beamformer.apply` does.

        Args:
            iq: Baseband samples of one frame or of several.
        """
        batch = iq.shape[:-3]
        frames = iq.reshape(-1, *iq.shape[-3:])
        padded = nn.functional.pad(frames, (kernels.FRONT, kernels.BACK))
        images = torch.stack([self._image(frame) for frame in padded])
        return images.reshape(*batch, *images.shape[1:])

    def _image(self, padded: Tensor) -> Tensor:
        """Return the image of one frame."""
        total = torch.zeros_like(self.phases)
        for element, (first, last) in enumerate(self._splits):
            if first == last:
                continue
            pixels = self.pixels[first:last]
            positions = self.transmit[:, pixels] + self.delays[first:last]
            values = self._interpolate(padded[:, element], positions)
            total.index_add_(1, pixels, self.weights[first:last] * values)
        columns, rows = self.geometry.points_mm.shape[:2]
        images = (total * self.phases).reshape(-1, columns, rows).transpose(1, 2)
        return images.mean(0) if self.compound else images

    def _interpolate(self, signals: Tensor, positions: Tensor) -> Tensor:
        """Return each transmit's samples at its positions."""
        top = signals.shape[-1]
        if not self.geometry.is_cubic:
            positions = positions.clamp(0, top - 2)
            k = positions.long()
            before = signals.gather(1, k)
            return before + (positions - k) * (signals.gather(1, k + 1) - before)
        positions = positions.clamp(1, top - 3)
        k = positions.long()
        u = positions - k
        a, b = -u * (u - 1) * (u - 2) / 6, (u + 1) * (u - 1) * (u - 2) / 2
        c, d = -(u + 1) * u * (u - 2) / 2, (u + 1) * u * (u - 1) / 6
        return (
            a * signals.gather(1, k - 1)
            + b * signals.gather(1, k)
            + c * signals.gather(1, k + 1)
            + d * signals.gather(1, k + 2)
        )


def _by_element(
    tables: Sequence[DelayTable],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[tuple[int, int]]]:
    """Return pixel, delay and weight of all pairs, element by element, and where each begins."""
    pixels, delays, weights, splits = [], [], [], []
    elements, rows = len(tables[0].first), tables[0].transmit.shape[2]
    begin = 0
    for element in range(elements):
        count, column = 0, 0
        for table in tables:
            for c in range(table.first.shape[1]):
                low, high = int(table.first[element, c]), int(table.last[element, c])
                at = int(table.offset[element, c])
                end = at + high - low
                pixels.append(np.arange(low, high) + column * rows)
                delays.append(table.delays[at:end])
                weights.append(table.cosines[at:end] + 1j * table.sines[at:end])
                count, column = count + high - low, column + 1
        splits.append((begin, begin + count))
        begin += count
    return np.concatenate(pixels), np.concatenate(delays), np.concatenate(weights), splits
