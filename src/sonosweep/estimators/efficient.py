"""EfficientNet on a sequence of frames as channels (Li et al. 2023).

References:
    Li et al., "Trackerless freehand ultrasound with sequence modelling and auxiliary
    transformation over past and future frames", ISBI 2023, and its public code; Tan and Le,
    "EfficientNet: rethinking model scaling for convolutional neural networks", ICML 2019,
    table 1, for the network.

Differs:
    The original reads 10 frames and more, predicts the transformation between every two of
    them (45 of 10 frames) and is trained on the corners of the frame. Here a window of 5
    frames gives its 4 steps, as all networks do; a longer window gives more. Stochastic depth
    is left out: its point is depth far beyond what is needed here, and a step that is
    repeated with the same weights should give the same loss.
    The blocks are written here although torchvision has them: it needs exactly the torch it
    was built with, CPU or CUDA, which plain pip does not see to
    (https://github.com/pytorch/vision/issues/9174).
"""

import math
from dataclasses import dataclass
from typing import Annotated, NamedTuple

from jaxtyping import Float
from pydantic import Field, PositiveInt
from torch import Tensor, nn

from sonosweep.estimators.motion_head import WindowHead
from sonosweep.estimators.network import (
    Frames,
    FrameShape,
    NetworkOutput,
    WindowNetwork,
    check_window,
)
from sonosweep.estimators.shrink import shrink_frames


class _Stage(NamedTuple):
    expand: int
    size: int
    stride: int
    channels: int
    blocks: int


STAGES = (
    _Stage(1, 3, 1, 16, 1),
    _Stage(6, 3, 2, 24, 2),
    _Stage(6, 5, 2, 40, 2),
    _Stage(6, 3, 2, 80, 3),
    _Stage(6, 5, 1, 112, 3),
    _Stage(6, 5, 2, 192, 4),
    _Stage(6, 3, 1, 320, 1),
)
"""Stages 2 to 8 of EfficientNet-b0 (Tan and Le, table 1)."""

STEM_CHANNELS = 32
LAST_CHANNELS = 1280


@dataclass(frozen=True)
class EfficientOptions:
    """Sizes of the network.

    Attributes:
        window: Frames that are read at once.
        width: Of all layers against EfficientNet-b0; 1 in EfficientNet-b1.
        depth: Of all stages against EfficientNet-b0; 1.1 in EfficientNet-b1.
        dropout: Share of the last features that are left out at random in training; 0.2 in
            EfficientNet-b1.
        shrink: Pixels along each side of a frame that are averaged into one at first.
        log_variance: Whether the variance of each number is predicted as well.
    """

    window: Annotated[int, Field(ge=2)] = 5
    width: Annotated[float, Field(gt=0, le=10)] = 1.0
    depth: Annotated[float, Field(gt=0, le=10)] = 1.1
    dropout: Annotated[float, Field(ge=0, lt=1)] = 0.2
    shrink: PositiveInt = 1
    log_variance: bool = False


PAPER = EfficientOptions()
COMPACT = EfficientOptions(width=0.5, depth=0.5, dropout=0.0)


class Efficient(WindowNetwork):
    """Windows of frames, which become channels, to the motion of each step.

    Batch normalization throughout, as in EfficientNet.

    Args:
        shape: Of the frames.
        options: Sizes.
    """

    def __init__(
        self, shape: FrameShape | None = None, options: EfficientOptions | None = None
    ) -> None:
        super().__init__()
        self.frame_shape = shape or FrameShape()
        self.options = o = options or PAPER
        self.window = o.window
        width = _rounded(STEM_CHANNELS * o.width)
        layers = [_layer(o.window * self.frame_shape.channels, width, 3, stride=2)]
        for stage in STAGES:
            channels = _rounded(stage.channels * o.width)
            for block in range(math.ceil(stage.blocks * o.depth)):
                stride = stage.stride if block == 0 else 1
                layers.append(_Block(width, channels, stage.expand, stage.size, stride))
                width = channels
        last = _rounded(LAST_CHANNELS * o.width)
        self.features = nn.Sequential(*layers, _layer(width, last, 1))
        self.dropout = nn.Dropout(o.dropout)
        self.to_motion = WindowHead(last, o.window - 1, mean=False, log_variance=o.log_variance)

    def forward(self, frames: Frames) -> NetworkOutput:
        """Return the motion of each step."""
        check_window(frames, self.window)
        features = self.features(shrink_frames(frames, self.options.shrink).flatten(1, 2))
        pooled = self.dropout(features.mean((2, 3)))
        motion, log_variance = self.to_motion(pooled)
        return NetworkOutput(motion, (motion,), log_variance=log_variance)


class _Block(nn.Module):
    """An inverted bottleneck: widen, filter each channel, weigh the channels, narrow."""

    def __init__(
        self, channels_in: int, channels_out: int, expand: int, size: int, stride: int
    ) -> None:
        super().__init__()
        inner = channels_in * expand
        self.residual = nn.Sequential(
            _layer(channels_in, inner, 1) if expand > 1 else nn.Identity(),
            _layer(inner, inner, size, stride, groups=inner),
            _ChannelWeights(inner, max(1, channels_in // 4)),
            nn.Conv2d(inner, channels_out, 1, bias=False),
            nn.BatchNorm2d(channels_out),
        )
        self.shortcut = stride == 1 and channels_in == channels_out

    def forward(
        self, features: Float[Tensor, "batch channels rows columns"]
    ) -> Float[Tensor, "batch channels_out rows_out columns_out"]:
        residual = self.residual(features)
        return features + residual if self.shortcut else residual


class _ChannelWeights(nn.Module):
    """Squeeze and excitation: each channel times a weight from the means of all of them."""

    def __init__(self, channels: int, squeezed: int) -> None:
        super().__init__()
        self.weights = nn.Sequential(
            nn.AdaptiveAvgPool2d(1),
            nn.Conv2d(channels, squeezed, 1),
            nn.SiLU(),
            nn.Conv2d(squeezed, channels, 1),
            nn.Sigmoid(),
        )

    def forward(
        self, features: Float[Tensor, "batch channels rows columns"]
    ) -> Float[Tensor, "batch channels rows columns"]:
        return features * self.weights(features)


def _layer(
    channels_in: int, channels_out: int, size: int, stride: int = 1, groups: int = 1
) -> nn.Module:
    """Return a convolution with batch normalization and SiLU."""
    return nn.Sequential(
        nn.Conv2d(channels_in, channels_out, size, stride, size // 2, groups=groups, bias=False),
        nn.BatchNorm2d(channels_out),
        nn.SiLU(inplace=True),
    )


def _rounded(channels: float) -> int:
    """Return the multiple of 8 next to a width, and not more than a tenth below it."""
    nearest = max(8, int(channels + 4) // 8 * 8)
    return nearest + 8 if nearest < 0.9 * channels else nearest
