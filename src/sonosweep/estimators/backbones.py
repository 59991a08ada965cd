"""Residual blocks in two dimensions, shared by networks."""

from typing import Literal

import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

Shrink = Literal["no", "before", "after"]


class ResidualBlock(nn.Module):
    """Two 3 x 3 convolutions with a shortcut (He et al. 2016), SiLU, batch normalization.

    Args:
        channels_in: Of the input.
        channels_out: Of the output; a 1 x 1 convolution joins the two if they differ.
        shrink: Whether the map is halved, by the maximum, before or after the convolutions.
    """

    def __init__(self, channels_in: int, channels_out: int, shrink: Shrink = "no") -> None:
        super().__init__()
        self.residual = nn.Sequential(
            convolution(channels_in, channels_out),
            nn.SiLU(),
            convolution(channels_out, channels_out),
        )
        same = channels_in == channels_out
        self.shortcut = (
            nn.Identity() if same else nn.Conv2d(channels_in, channels_out, 1, bias=False)
        )
        self._shrink = shrink

    def forward(
        self, features: Float[Tensor, "batch channels rows columns"]
    ) -> Float[Tensor, "batch channels_out rows_out columns_out"]:
        """Return the block's features."""
        if self._shrink == "before":
            features = F.max_pool2d(features, 2)
        features = F.silu(self.residual(features) + self.shortcut(features))
        return F.max_pool2d(features, 2) if self._shrink == "after" else features


def convolution(
    channels_in: int, channels_out: int, size: int = 3, stride: int = 1
) -> nn.Sequential:
    """Return a convolution that keeps the size but for its stride, with normalization."""
    return nn.Sequential(
        nn.Conv2d(channels_in, channels_out, size, stride, padding=size // 2, bias=False),
        nn.BatchNorm2d(channels_out),
    )


def residual_stage(
    channels_in: int, channels_out: int, blocks: int, shrink: Shrink = "no"
) -> nn.Sequential:
    """Return residual blocks, of which the first changes the width.

    Args:
        channels_in: Of the input.
        channels_out: Of the output.
        blocks: How many; none gives back what came in.
        shrink: Whether the first block halves the map before its convolutions or the last
            one after them.
    """
    widths = [channels_in] + [channels_out] * blocks
    last = {"before": 0, "after": blocks - 1, "no": -1}[shrink]
    return nn.Sequential(
        *(
            ResidualBlock(widths[i], widths[i + 1], shrink if i == last else "no")
            for i in range(blocks)
        )
    )
