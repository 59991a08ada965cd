"""The chain after beamforming in torch: on GPUs, the same numbers as the NumPy functions.

Each function is the twin of the one of the same name and takes what that one takes, as
tensors on any device. Results differ by rounding alone.
"""

import math

import numpy as np
import torch
from jaxtyping import Complex, Float, UInt8
from torch import Tensor, nn
from torch.nn import functional

from sonosweep.errors import ScanError
from sonosweep.imaging import bmode, clutter, despeckle, scan_convert


def svd_filter(
    ensemble: Complex[Tensor, "pulses rows columns"], rank: clutter.Rank = "auto"
) -> Complex[Tensor, "pulses rows columns"]:
    """Return an ensemble without tissue, see :func:`sonosweep.imaging.clutter.svd_filter`.

    The small matrix is decomposed on the CPU, which is faster there.

    Raises:
        ScanError: As the twin does.
    """
    clutter.check_rank(len(ensemble), rank)
    samples = ensemble.reshape(len(ensemble), -1).to(torch.complex128)
    gram = (samples @ samples.mH).cpu().numpy()
    energies, vectors = clutter.slow_time_vectors(gram)
    count = clutter.clutter_rank(energies) if rank == "auto" else rank
    tissue = torch.from_numpy(np.ascontiguousarray(vectors[:, :count])).to(ensemble.device)
    filtered = samples - tissue @ (tissue.mH @ samples)
    return filtered.to(ensemble.dtype).reshape(ensemble.shape)


def power_doppler(
    ensemble: Complex[Tensor, "pulses rows columns"],
) -> Float[Tensor, "rows columns"]:
    """Return the mean power of the pulses."""
    return (ensemble.real**2 + ensemble.imag**2).mean(0)


def lag_one(
    ensemble: Complex[Tensor, "pulses rows columns"],
) -> Complex[Tensor, "rows columns"]:
    """Return the mean product of each pulse and the conjugate of the one before.

    Raises:
        ScanError: If there are fewer than two pulses.
    """
    if len(ensemble) < 2:
        raise ScanError(f"an ensemble needs at least 2 pulses, got {len(ensemble)}")
    return (ensemble[1:] * ensemble[:-1].conj()).mean(0)


def log_compress(
    amplitude: Float[Tensor, "*frames rows columns"],
    reference: float,
    dynamic_range_db: float = 60.0,
    gain_db: float | Float[Tensor, " rows"] = 0.0,
) -> UInt8[Tensor, "*frames rows columns"]:
    """Return gray levels, see :func:`sonosweep.imaging.bmode.log_compress`.

    Raises:
        ScanError: As the twin does.
    """
    bmode.check_compression(reference, dynamic_range_db)
    if not bool(torch.isfinite(amplitude).all()):
        raise ScanError("the image holds amplitudes that are not numbers (NaN or infinite)")
    level_db = 20 * amplitude.clamp(min=torch.finfo(amplitude.dtype).tiny).log10()
    gain = gain_db[:, None] if isinstance(gain_db, Tensor) else gain_db
    level_db += gain - 20 * math.log10(reference)
    level = level_db * (255 / dynamic_range_db) + 255.5
    return level.clamp(0, 255).to(torch.uint8)


def lee_filter(
    amplitude: Float[Tensor, "rows columns"],
    window: int = 7,
    variation: float = despeckle.RAYLEIGH_VARIATION,
) -> Float[Tensor, "rows columns"]:
    """Return an amplitude image with less speckle.

    Raises:
        ScanError: As the twin does.
    """
    despeckle.check_lee(window, variation)
    return _lee(amplitude.double(), window, 0.0, variation**2).to(amplitude.dtype)


def lee_filter_gray(
    gray: UInt8[Tensor, "rows columns"],
    dynamic_range_db: float = 60.0,
    window: int = 7,
    speckle_db: float = despeckle.LOG_SPECKLE_DB,
) -> UInt8[Tensor, "rows columns"]:
    """Return a log-compressed frame with less speckle.

    Raises:
        ScanError: As the twin does.
    """
    despeckle.check_lee(window, speckle_db)
    noise = despeckle.gray_variance(dynamic_range_db, speckle_db)
    return (_lee(gray.double(), window, noise, 0.0) + 0.5).to(torch.uint8)


class ScanConverter(nn.Module):
    """A scan conversion whose tables are on a device.

    Args:
        converter: Of :func:`sonosweep.imaging.scan_convert.prepare_scan_converter`.
    """

    cell: Tensor
    down: Tensor
    across: Tensor

    def __init__(self, converter: scan_convert.ScanConverter) -> None:
        super().__init__()
        self._converter = converter
        self.register_buffer("cell", torch.from_numpy(converter.cell.astype(np.int64)))
        self.register_buffer("down", torch.from_numpy(converter.down.astype(np.float64)))
        self.register_buffer("across", torch.from_numpy(converter.across.astype(np.float64)))

    def forward(self, frames: Tensor) -> Tensor:
        """Return frames resampled as :meth:`scan_convert.ScanConverter.apply` does.

        Raises:
            ScanError: If the frames have another shape than the conversion was made for.
        """
        scan_convert.check_source(self._converter, tuple(frames.shape))
        source, width = frames.flatten(-2).double(), self._converter.source_shape[1]
        first = self.cell.clamp(min=0)
        upper = (1 - self.across) * source[..., first] + self.across * source[..., first + 1]
        first = first + width
        lower = (1 - self.across) * source[..., first] + self.across * source[..., first + 1]
        pixels = (1 - self.down) * upper + self.down * lower
        if not frames.is_floating_point():
            pixels = pixels + 0.5
        pixels = torch.where(self.cell == scan_convert.OUTSIDE, 0.0, pixels)
        return pixels.to(frames.dtype).unflatten(-1, self._converter.shape)


def _lee(
    image: Float[Tensor, "rows columns"], window: int, added: float, multiplied: float
) -> Float[Tensor, "rows columns"]:
    """Filter with noise of variance ``added`` + ``multiplied`` x mean squared."""
    mean = _window_mean(image, window)
    variance = _window_mean(image**2, window) - mean**2
    noise = added + multiplied * mean**2
    signal = ((variance - noise) / (1 + multiplied)).clamp(min=0)
    gain = torch.where(signal > 0, signal / (signal + noise), 0.0)
    return mean + gain * (image - mean)


def _window_mean(image: Tensor, window: int) -> Tensor:
    """Return means over windows that are cut off at the edge of the image."""
    rows, columns = image.shape
    reach = min(window // 2, max(rows, columns))
    box = torch.ones(1, 1, 2 * reach + 1, dtype=image.dtype, device=image.device)
    total = functional.conv1d(image[:, None], box, padding=reach)[:, 0]
    total = functional.conv1d(total.T[:, None], box, padding=reach)[:, 0].T
    return total / torch.outer(_counts(rows, reach, image), _counts(columns, reach, image))


def _counts(size: int, reach: int, like: Tensor) -> Tensor:
    """Return how many pixels of a line are in the window around each."""
    place = torch.arange(size, dtype=like.dtype, device=like.device)
    return (place + reach).clamp(max=size - 1) - (place - reach).clamp(min=0) + 1
