"""A 3D ResNeXt over short windows of frames, and the attention that weighs where it looks.

Shared by the two networks of Guo et al. (:mod:`sonosweep.estimators.dcl`,
:mod:`sonosweep.estimators.dc2`). Blocks are written here because no package that is installed
everywhere has a 3D ResNeXt.

References:
    Xie et al., "Aggregated residual transformations for deep neural networks", CVPR 2017, for
    the blocks; Hara et al., "Can spatiotemporal 3D CNNs retrace the history of 2D CNNs and
    ImageNet?", CVPR 2018, for the same with a time axis.
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from pydantic import PositiveInt
from torch import Tensor, nn

from sonosweep.estimators.network import Frames
from sonosweep.estimators.shrink import shrink_frames


@dataclass(frozen=True)
class ResNeXtSize:
    """How large a 3D ResNeXt is.

    Attributes:
        width: Channels of the first convolution; the last block has 32 times as many.
        blocks: In each of the four stages, of which all but the first halve the size and the
            number of frames; (3, 4, 6, 3) is a "ResNeXt-50".
        cardinality: Groups of the grouped convolutions.
    """

    width: PositiveInt = 64
    blocks: tuple[PositiveInt, PositiveInt, PositiveInt, PositiveInt] = (3, 4, 6, 3)
    cardinality: PositiveInt = 32


class AttendingResNeXt(nn.Module):
    """Windows of frames to features, of which those places count that matter.

    The weight of a place is what 1 x 1 x 1 convolutions make of its features, from 0 to 1
    (Guo et al. 2020, "self-attention module"; normalized as in their code).

    Args:
        channels: Of a frame.
        size: Of the 3D ResNeXt.
        shrink: Pixels along each side of a frame that are averaged into one at first.
    """

    def __init__(self, channels: int, size: ResNeXtSize, shrink: int = 1) -> None:
        super().__init__()
        self.shrink = shrink
        self.backbone = ResNeXt3d(channels, size)
        self.features = self.backbone.features
        self.score = nn.Sequential(
            nn.BatchNorm3d(self.features),
            nn.Conv3d(self.features, self.features // 2, 1),
            nn.ReLU(inplace=True),
            nn.Conv3d(self.features // 2, 1, 1),
            nn.BatchNorm3d(1),
            nn.Sigmoid(),
        )

    def forward(
        self, frames: Frames
    ) -> tuple[Float[Tensor, "batch features"], Float[Tensor, "batch rows_out columns_out"]]:
        """Return the features of windows and how much each place counted."""
        features = self.backbone(
            shrink_frames(frames, self.shrink)
        )  # batch, features, depth, rows / 32, columns / 32
        attention = self.score(features)
        pooled = (features * attention).relu().mean((2, 3, 4))
        return pooled, attention.mean((1, 2))


class ResNeXt3d(nn.Module):
    """Windows of frames to features, 32 times smaller in the plane.

    The first convolution, 3 x 7 x 7, is that of frames with their neighbors as further
    channels: the same sums, faster, and oneDNN's bfloat16 gradient of a 3D convolution of one
    channel writes past its memory (torch 2.13 on a CPU with AMX).

    Args:
        channels: Of a frame.
        size: Of the network.
    """

    def __init__(self, channels: int, size: ResNeXtSize) -> None:
        super().__init__()
        self.stem = nn.Sequential(
            nn.Conv2d(3 * channels, size.width, 7, 2, 3, bias=False),
            nn.BatchNorm2d(size.width),
            nn.ReLU(inplace=True),
            nn.MaxPool2d(3, 2, 1),
        )
        blocks, width = [], size.width
        for stage, count in enumerate(size.blocks):
            inner = 2 * size.width * 2**stage
            for block in range(count):
                stride = 2 if block == 0 and stage > 0 else 1
                blocks.append(_Block(width, inner, stride, size.cardinality))
                width = 2 * inner
        self.blocks = nn.Sequential(*blocks)
        self.features = width

    def forward(
        self, frames: Float[Tensor, "batch frames channels rows columns"]
    ) -> Float[Tensor, "batch features depth rows_out columns_out"]:
        """Return features, one depth left of up to eight frames."""
        padded = F.pad(frames, (0, 0, 0, 0, 0, 0, 1, 1))
        triples = torch.cat((padded[:, :-2], padded[:, 1:-1], padded[:, 2:]), 2)
        low = self.stem(triples.flatten(0, 1)).unflatten(0, frames.shape[:2])
        return self.blocks(low.transpose(1, 2))


class _Block(nn.Module):
    """A bottleneck whose middle convolution is in groups, with a shortcut."""

    def __init__(self, channels: int, inner: int, stride: int, cardinality: int) -> None:
        super().__init__()
        self.residual = nn.Sequential(
            nn.Conv3d(channels, inner, 1, bias=False),
            nn.BatchNorm3d(inner),
            nn.ReLU(inplace=True),
            nn.Conv3d(inner, inner, 3, stride, 1, groups=cardinality, bias=False),
            nn.BatchNorm3d(inner),
            nn.ReLU(inplace=True),
            nn.Conv3d(inner, 2 * inner, 1, bias=False),
            nn.BatchNorm3d(2 * inner),
        )
        self.shortcut: nn.Module = nn.Identity()
        if channels != 2 * inner or stride > 1:
            self.shortcut = nn.Sequential(
                nn.Conv3d(channels, 2 * inner, 1, stride, bias=False), nn.BatchNorm3d(2 * inner)
            )

    def forward(self, features: Tensor) -> Tensor:
        return (self.residual(features) + self.shortcut(features)).relu_()
