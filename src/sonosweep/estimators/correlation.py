"""The patch-wise correlation volume (Lee et al. 2025, "Correlation Operation" and figure 3).

A patch of the first feature map stays at the center of a region of interest; a patch of the
second moves over that region. The cosine of the two, for every displacement, is one array;
the arrays of all regions are the volume.
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from sonosweep.errors import ScanError
from sonosweep.estimators.diagonals import box_matrix, full_precision, sum_diagonals

EPSILON = 1e-6
"""Added to the product of norms: a patch without features correlates with nothing."""


@dataclass(frozen=True)
class CorrelationGeometry:
    """Sizes in pixels of the feature map; the defaults are those of the released code.

    Attributes:
        patch: Side of a patch; odd.
        radius: Largest displacement of the moving patch.
        stride: Distance between neighboring regions of interest.
    """

    patch: int = 3
    radius: int = 7
    stride: int = 4

    def __post_init__(self) -> None:
        """Check the sizes.

        Raises:
            ScanError: If the patch has no middle, or a size is not positive.
        """
        if self.patch < 1 or self.patch % 2 == 0:
            raise ScanError(f"a patch needs an odd side, got {self.patch}")
        if self.radius < 1 or self.stride < 1:
            raise ScanError(
                f"radius and stride must be at least 1, got {self.radius} and {self.stride}"
            )

    @property
    def side(self) -> int:
        """Displacements along each axis."""
        return 2 * self.radius + 1

    @property
    def window(self) -> int:
        """Side of what the moving patch covers on its way."""
        return self.patch + 2 * self.radius

    def regions(self, size: int) -> int:
        """Return how many regions of interest lie along an axis of this many pixels."""
        return max((size - self.stride // 2 - 1) // self.stride + 1, 1)


def correlation_volume(
    first: Float[Tensor, "batch channels rows columns"],
    second: Float[Tensor, "batch channels rows columns"],
    geometry: CorrelationGeometry,
) -> Float[Tensor, "batch region_rows region_columns shift_rows shift_columns"]:
    """Return the cosine of every patch of the first map with its neighborhood in the second.

    One matrix product per region multiplies all pixels of the patch with all pixels of the
    region; sums along its diagonals are the products of whole patches. Regions are cut out by
    index, which trains faster than views (their gradients are slow) and exports to ONNX as
    Gather. Nothing outside the maps correlates. Differentiable in both maps; always in
    single precision.

    Args:
        first: Features of the frame, whose patches stay.
        second: Features of the next frame, whose patches move.
        geometry: Sizes of patch, region and stride.

    References:
        Lee et al. 2025, section "Correlation Operation".

    Differs:
        The released code puts the middle of the first region on the first pixel, so that a
        quarter of it lies outside; here regions lie symmetrically.
    """
    with full_precision(first.device):
        before, after = (maps.float().permute(0, 2, 3, 1) for maps in (first, second))
        patches = _squares(before, geometry.patch, geometry)
        windows = _squares(after, geometry.window, geometry)
        dots = _patch_products(torch.bmm(patches, windows.transpose(1, 2)), geometry)
        energy = _squares(after.square().sum(-1, keepdim=True), geometry.window, geometry)
        still = patches.square().sum((1, 2)).add(EPSILON**2).sqrt()[:, None, None]
        volume = dots / (still * _moving_norms(energy, geometry) + EPSILON)
        rows, columns = (geometry.regions(size) for size in first.shape[-2:])
        return volume.reshape(len(first), rows, columns, geometry.side, geometry.side)


def subtract_local_mean(
    features: Float[Tensor, "batch channels rows columns"], size: int = 7
) -> Float[Tensor, "batch channels rows columns"]:
    """Return features without their mean over a neighborhood, channel by channel.

    Features after a rectifier are nearly all positive, so that their cosine is near 1
    whatever they show; without the mean it is close to a correlation coefficient.

    Args:
        features: Any map.
        size: Side of the neighborhood in pixels; odd. At the edges the part inside counts.
    """
    with full_precision(features.device):
        pixels = features.float().permute(0, 2, 3, 1)
        rows, columns = (_averages(count, size, features.device) for count in pixels.shape[1:3])
        mean = columns @ (rows @ pixels.flatten(2)).reshape(pixels.shape)
        return (pixels - mean).permute(0, 3, 1, 2)


def _averages(count: int, size: int, device: torch.device) -> Float[Tensor, "count count"]:
    """Return the matrix that averages over neighbors along an axis."""
    half = size // 2
    box = box_matrix(count + 2 * half, size, device)[:, half : half + count]
    return box / box.sum(1, keepdim=True)


def _patch_products(
    products: Float[Tensor, "regions patch_pixels window_pixels"], geometry: CorrelationGeometry
) -> Float[Tensor, "regions shift_rows shift_columns"]:
    """Return sums over the patch from products of single pixels, first along its rows."""
    patch, window = geometry.patch, geometry.window
    spare = (0, 0, 0, 1)
    rows = sum_diagonals(F.pad(products.reshape(-1, patch, window**2), spare), 1)
    both = sum_diagonals(F.pad(rows.reshape(-1, patch, window**2), spare), window)
    both = both.unflatten(1, (window, window))
    return both[:, : geometry.side, : geometry.side]


def _moving_norms(
    energy: Float[Tensor, "regions window_pixels 1"], geometry: CorrelationGeometry
) -> Float[Tensor, "regions shift_rows shift_columns"]:
    """Return the norm of the moving patch at each displacement."""
    box = box_matrix(geometry.window, geometry.patch, energy.device)
    squares = energy.reshape(-1, geometry.window, geometry.window)
    return (box @ squares @ box.T).clamp_min(0).add(EPSILON**2).sqrt()


def _squares(
    pixels: Float[Tensor, "batch rows columns channels"], side: int, geometry: CorrelationGeometry
) -> Float[Tensor, "regions pixels channels"]:
    """Return the pixels of a square around each region's middle."""
    padded = _pad(pixels, side, geometry)
    rows, columns = (
        geometry.stride * torch.arange(geometry.regions(size), device=pixels.device)[:, None]
        + torch.arange(side, device=pixels.device)
        for size in pixels.shape[1:3]
    )
    index = rows[:, None, :, None] * padded.shape[2] + columns[None, :, None, :]
    taken = padded.flatten(1, 2).index_select(1, index.flatten())
    return taken.reshape(-1, side * side, pixels.shape[-1])


def _pad(
    pixels: Float[Tensor, "batch rows columns channels"], side: int, geometry: CorrelationGeometry
) -> Tensor:
    """Return pixels with zeros around, so that squares begin at multiples of the stride."""
    before = side // 2 - geometry.stride // 2
    after = [
        (geometry.regions(size) - 1) * geometry.stride + side - size - before
        for size in pixels.shape[1:3]
    ]
    return F.pad(pixels, (0, 0, before, after[1], before, after[0]))
