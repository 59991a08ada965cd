"""Global-local attention (Lee et al. 2025, "Global-Local Attention" and figure 4).

Names follow the paper: E2 and E4 are the local and the global features, S the scores, R the
weighted blocks of E2, G the weighted E4, L the blocks added up.
"""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

Features = Float[Tensor, "batch channels rows columns"]
EPSILON = 1e-6
"""Added to the product of norms: a block without features is like nothing."""


@dataclass(frozen=True)
class AttentionReading:
    """How to read the places where the paper and its released code differ.

    The defaults are the code's.

    Attributes:
        spatial_kernel: Of the spatial scores: 1 in the paper, 3 in the code.
        parallel: Whether spatial and channel scores both come from E4 (paper), or the
            spatial ones from features that the channel scores have weighted (code).
        pooling: What the channel scores are read from: the mean (paper: "adaptive
            pooling"), or the mean and the maximum, whose two scores are added (code).
        similarity: The cosine itself (paper), which may turn a block's sign, or
            (cosine + 1) / 2 (code), which may not.
        normalize: Whether batch normalization follows the spatial convolution and, with
            SiLU, the two projections (code). The paper's equations have neither.
        reduction: Channels per hidden unit of the perceptrons; 16 in both. The paper prints
            two matrices and calls them a perceptron; the SiLU between them is the code's.
    """

    spatial_kernel: Literal[1, 3] = 3
    parallel: bool = False
    pooling: Literal["mean", "mean_and_maximum"] = "mean_and_maximum"
    similarity: Literal["cosine", "half_cosine"] = "half_cosine"
    normalize: bool = True
    reduction: int = 16


PAPER_READING = AttentionReading(1, True, "mean", "cosine", normalize=False)


class ChannelScores(nn.Module):
    """One score for each channel: S_c = sigma(W_2 W_1 P_c)."""

    def __init__(self, channels: int, reading: AttentionReading) -> None:
        super().__init__()
        hidden = max(channels // reading.reduction, 1)
        self.perceptron = nn.Sequential(
            nn.Linear(channels, hidden, bias=False),
            nn.SiLU(),
            nn.Linear(hidden, channels, bias=False),
        )
        self._use_maximum = reading.pooling == "mean_and_maximum"

    def forward(
        self, pixels: Float[Tensor, "batch pixels channels"]
    ) -> Float[Tensor, "batch 1 channels"]:
        """Return the scores: within 0 and 1, or 0 and 2 with the maximum."""
        scores = torch.sigmoid(self.perceptron(pixels.mean(1, keepdim=True)))
        if self._use_maximum:
            scores = scores + torch.sigmoid(self.perceptron(pixels.amax(1, keepdim=True)))
        return scores


class SpatialScores(nn.Module):
    """One score for each place: S_s = sigma(W * P_s), P_s the channels' maximum and mean."""

    def __init__(self, reading: AttentionReading) -> None:
        super().__init__()
        size = reading.spatial_kernel
        self.convolution = nn.Conv2d(2, 1, size, padding=size // 2, bias=False)
        self.norm = nn.BatchNorm2d(1) if reading.normalize else nn.Identity()

    def forward(self, features: Features) -> Float[Tensor, "batch 1 rows columns"]:
        """Return the scores, within 0 and 1."""
        pooled = torch.cat((features.amax(1, keepdim=True), features.mean(1, keepdim=True)), 1)
        return torch.sigmoid(self.norm(self.convolution(pooled)))


class GlobalLocalAttention(nn.Module):
    """Weighs blocks of local features by their likeness to the global ones.

    Args:
        local_channels: Of E2.
        global_channels: Of E4; a multiple of the local ones.
        blocks: Number of local blocks.
        size: Side of E4 and of a local block.
        reading: Where paper and code differ.
    """

    def __init__(
        self,
        local_channels: int,
        global_channels: int,
        blocks: int,
        size: int,
        reading: AttentionReading,
    ) -> None:
        super().__init__()
        self._size, self._half = size, reading.similarity == "half_cosine"
        self._parallel = reading.parallel
        mixtures = global_channels // local_channels
        self.local_scores = ChannelScores(local_channels, reading)
        self.global_scores = ChannelScores(global_channels, reading)
        self.spatial_scores = SpatialScores(reading)
        self.to_local = nn.Conv2d(global_channels, local_channels, 1, bias=False)
        self.mixing = nn.Linear(blocks, mixtures, bias=False)
        self.after_local: nn.Module = nn.Identity()
        self.after_mixing: nn.Module = nn.Identity()
        if reading.normalize:
            self.after_local = nn.Sequential(nn.BatchNorm2d(local_channels), nn.SiLU())
            self.after_mixing = nn.Sequential(nn.BatchNorm1d(mixtures), nn.SiLU())

    def forward(
        self,
        local: Float[Tensor, "batch local_channels rows columns"],
        whole: Float[Tensor, "batch global_channels size size"],
    ) -> tuple[
        Float[Tensor, "batch global_channels size size"],
        Float[Tensor, "batch global_channels size size"],
        Float[Tensor, "batch blocks"],
    ]:
        """Return the local features L, the global ones G, and the weight of each block.

        Args:
            local: E2, which is cut into blocks of ``size`` x ``size``.
            whole: E4.
        """
        rows, columns = whole.shape[-2:]
        pixels = whole.permute(0, 2, 3, 1).flatten(1, 2)
        weighted = (self.global_scores(pixels) * pixels).unflatten(1, (rows, columns))
        weighted = weighted.permute(0, 3, 1, 2)
        refined = self.spatial_scores(whole if self._parallel else weighted) * weighted
        pixels = local.permute(0, 2, 3, 1).flatten(1, 2)
        recalibrated = (self.local_scores(pixels) * pixels).unflatten(1, local.shape[-2:])
        blocks = cut_blocks(recalibrated, self._size)
        summary = self.after_local(self.to_local(refined)).permute(0, 2, 3, 1).flatten(1)
        weights = _cosine(blocks, summary)
        if self._half:
            weights = (weights + 1) / 2
        # The projection of the weighted blocks, with the weights taken into the projection.
        mixed = self.after_mixing((self.mixing.weight * weights[:, None]) @ blocks)
        places = mixed.unflatten(2, (*whole.shape[-2:], -1)).permute(0, 1, 4, 2, 3)
        return places.flatten(1, 2), refined, weights


def cut_blocks(
    pixels: Float[Tensor, "batch rows columns channels"], size: int
) -> Float[Tensor, "batch blocks numbers"]:
    """Return the squares of a feature map side by side, row by row.

    The numbers of a square go over its rows, columns and channels, as they lie in memory.
    """
    cut = pixels.unflatten(2, (-1, size)).unflatten(1, (-1, size))
    return cut.transpose(2, 3).flatten(1, 2).flatten(2)


def _cosine(
    blocks: Float[Tensor, "batch blocks numbers"], summary: Float[Tensor, "batch numbers"]
) -> Float[Tensor, "batch blocks"]:
    """Return the cosine of each block with the summary."""
    dots = (blocks @ summary[..., None])[..., 0]
    norms = blocks.square().sum(-1) * summary.square().sum(-1, keepdim=True)
    return dots / (norms + EPSILON**2).sqrt()
