"""The patch-wise correlation volume (Lee et al. 2025, "Correlation Operation" and figure 3).

A patch of the first feature map stays at the center of a region of interest; a patch of the
second moves over that region. The cosine of the two, for every displacement, is one array;
the arrays of all regions are the volume.
"""

from dataclasses import dataclass
from typing import Literal

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
    take: Literal["unfold", "gather"] = "unfold",
) -> Float[Tensor, "batch region_rows region_columns shift_rows shift_columns"]:
    """Return the cosine of every patch of the first map with its neighborhood in the second.

    One matrix product per region multiplies all pixels of the patch with all pixels of the
    region; sums along its diagonals are the products of whole patches. Nothing outside the
    maps correlates. Differentiable in both maps; always in single precision.

    Args:
        first: Features of the frame, whose patches stay.
        second: Features of the next frame, whose patches move.
        geometry: Sizes of patch, region and stride.
        take: How regions are cut out: by a view, or by index, which exports to ONNX as
            Gather and MatMul. The numbers are the same.

    References:
        Lee et al. 2025, section "Correlation Operation".

    Differs:
        The released code puts the middle of the first region on the first pixel, so that a
        quarter of it lies outside; here regions lie symmetrically.
    """
    with full_precision(first.device):
        cut = _view if take == "unfold" else _gather
        first, second = first.float(), second.float()
        patches = cut(first, geometry.patch, geometry.patch // 2, geometry)
        windows = cut(second, geometry.window, geometry.window // 2, geometry)
        dots = _patch_products(torch.bmm(patches, windows.transpose(1, 2)), geometry)
        energy = second.square().sum(1, keepdim=True)
        norms = _moving_norms(
            cut(energy, geometry.window, geometry.window // 2, geometry), geometry
        )
        still = patches.square().sum((1, 2)).add(EPSILON**2).sqrt()[:, None, None]
        rows, columns = (geometry.regions(size) for size in first.shape[-2:])
        volume = dots / (still * norms + EPSILON)
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
    half = size // 2
    mean = F.avg_pool2d(features, (size, 1), 1, (half, 0), count_include_pad=False)
    return features - F.avg_pool2d(mean, (1, size), 1, (0, half), count_include_pad=False)


def _patch_products(
    products: Float[Tensor, "regions patch_pixels window_pixels"], geometry: CorrelationGeometry
) -> Float[Tensor, "regions shift_rows shift_columns"]:
    """Return sums over the patch from products of single pixels, first along its rows."""
    patch, window = geometry.patch, geometry.window
    rows = sum_diagonals(products.unflatten(1, (patch, patch)).flatten(0, 1), 1)
    both = sum_diagonals(rows.unflatten(0, (-1, patch)), window).unflatten(1, (window, window))
    return both[:, : geometry.side, : geometry.side]


def _moving_norms(
    energy: Float[Tensor, "regions window_pixels 1"], geometry: CorrelationGeometry
) -> Float[Tensor, "regions shift_rows shift_columns"]:
    """Return the norm of the moving patch at each displacement."""
    box = box_matrix(geometry.window, geometry.patch, energy.device)
    squares = energy.reshape(-1, geometry.window, geometry.window)
    return (box @ squares @ box.T).clamp_min(0).add(EPSILON**2).sqrt()


def _view(
    features: Tensor, side: int, margin: int, geometry: CorrelationGeometry
) -> Float[Tensor, "regions pixels channels"]:
    """Return the pixels of a square at each region."""
    padded = _pad(features, side, margin, geometry)
    squares = padded.unfold(2, side, geometry.stride).unfold(3, side, geometry.stride)
    return squares.permute(0, 2, 3, 4, 5, 1).reshape(-1, side * side, features.shape[1])


def _gather(
    features: Tensor, side: int, margin: int, geometry: CorrelationGeometry
) -> Float[Tensor, "regions pixels channels"]:
    """Return the same as :func:`_view`, by index."""
    padded = _pad(features, side, margin, geometry)
    rows, columns = (
        geometry.stride * torch.arange(geometry.regions(size), device=features.device)[:, None]
        + torch.arange(side, device=features.device)
        for size in features.shape[-2:]
    )
    index = rows[:, None, :, None] * padded.shape[-1] + columns[None, :, None, :]
    pixels = padded.permute(0, 2, 3, 1).flatten(1, 2).index_select(1, index.flatten())
    return pixels.reshape(-1, side * side, features.shape[1])


def _pad(features: Tensor, side: int, margin: int, geometry: CorrelationGeometry) -> Tensor:
    """Return features with zeros around, so that squares begin at multiples of the stride."""
    before = margin - geometry.stride // 2
    after = [
        (geometry.regions(size) - 1) * geometry.stride + side - size - before
        for size in features.shape[-2:]
    ]
    return F.pad(features, (before, after[1], before, after[0]))
