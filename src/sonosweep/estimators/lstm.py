"""ResNet-18 on pairs of frames, then a convolutional LSTM over steps (Luo et al. 2023).

References:
    Luo et al., "RecON: online learning for sensorless freehand 3D ultrasound reconstruction",
    Medical Image Analysis 87, 2023, the backbone, and its public code; He et al., "Deep
    residual learning for image recognition", CVPR 2016, for ResNet-18; Shi et al.,
    "Convolutional LSTM network", NeurIPS 2015, equation 3 without peepholes.

Differs:
    The original reads six channels a pair: both frames, the Canny edges of both, and the
    optical flow between them. Edges can be given as a second channel of each frame
    (``FrameShape(channels=2)``); the flow is left out, as in Lee et al.'s comparison all
    networks read frames. ImageNet's weights, with which the original begins, are not used,
    nor is what RecON learns online, during the sweep.
    ResNet-18 is written here although torchvision has it: it needs exactly the torch it was
    built with, CPU or CUDA, which plain pip does not see to
    (https://github.com/pytorch/vision/issues/9174).
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from pydantic import PositiveInt
from torch import Tensor, nn

from sonosweep.estimators.motion_head import MotionHead
from sonosweep.estimators.network import FrameShape, NetworkOutput, RecurrentNetwork
from sonosweep.estimators.shrink import shrink_frames

FLATTEST = 1e-3
"""Standard deviation below which a frame is called empty and not made brighter."""


@dataclass(frozen=True)
class LSTMOptions:
    """Sizes of the network.

    Attributes:
        width: Channels of the first convolution; 64 in ResNet-18.
        blocks: In each of the four stages; 2 each in ResNet-18.
        hidden: Channels of the convolutional LSTM; 512 in the original.
        standardize: Whether each frame is brought to zero mean and unit deviation, as in
            the original.
        shrink: Pixels along each side of a frame that are averaged into one at first.
        log_variance: Whether the variance of each number is predicted as well.
    """

    width: PositiveInt = 64
    blocks: tuple[PositiveInt, PositiveInt, PositiveInt, PositiveInt] = (2, 2, 2, 2)
    hidden: PositiveInt = 512
    standardize: bool = True
    shrink: PositiveInt = 1
    log_variance: bool = False


PAPER = LSTMOptions()
COMPACT = LSTMOptions(width=16, hidden=128)


class LSTM(RecurrentNetwork):
    """Pairs of frames, and what came before them, to motions.

    Batch normalization in the ResNet, none in the LSTM, as in the originals.

    Args:
        shape: Of the frames.
        options: Sizes.
    """

    def __init__(self, shape: FrameShape | None = None, options: LSTMOptions | None = None) -> None:
        super().__init__()
        self.frame_shape = shape or FrameShape()
        self.options = o = options or PAPER
        self.residual = _resnet(2 * self.frame_shape.channels, o.width, o.blocks)
        features = 8 * o.width
        # The four gates of the LSTM at once: input, forget, output, and the new content.
        self.gates = nn.Conv2d(features + o.hidden, 4 * o.hidden, 3, padding=1)
        self.to_motion = MotionHead(o.hidden, o.log_variance)

    def encode(self, frames: Float[Tensor, "batch channels rows columns"]) -> tuple[Tensor, ...]:
        """Return the frames, standardized: the first convolution already reads two of them."""
        small = shrink_frames(frames, self.options.shrink)
        if self.options.standardize:
            deviation, mean = torch.std_mean(small, (-2, -1), keepdim=True)
            small = (small - mean) / deviation.clamp_min(FLATTEST)
        return (small,)

    def compare(self, first: tuple[Tensor, ...], second: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        """Return what ResNet says about pairs, 32 times smaller in the plane."""
        return (self.residual(torch.cat((first[0], second[0]), 1)),)

    def regress(
        self, pairs: tuple[Tensor, ...], state: tuple[Tensor, ...] | None
    ) -> tuple[NetworkOutput, tuple[Tensor, ...]]:
        """Return the motion of each step from it and the steps before it."""
        features = pairs[0]  # batch, steps, features, rows / 32, columns / 32
        if state is None:
            batch, _, _, rows, columns = features.shape
            empty = features.new_zeros(batch, self.options.hidden, rows, columns)
            state = (empty, empty)
        hidden, cell = state
        pooled = []
        for step in features.unbind(1):
            gates = self.gates(torch.cat((step, hidden.to(step)), 1))
            let_in, keep, show, new = gates.chunk(4, 1)
            cell = keep.sigmoid() * cell + let_in.sigmoid() * new.tanh()
            hidden = show.sigmoid() * cell.tanh()
            pooled.append(hidden.mean((-1, -2)))
        motion, log_variance = self.to_motion(torch.stack(pooled, 1))
        return NetworkOutput(motion, (motion,), log_variance=log_variance), (hidden, cell)


def _resnet(channels: int, width: int, blocks: tuple[int, ...]) -> nn.Module:
    """Return a residual network of basic blocks without its last layer."""
    layers: list[nn.Module] = [
        nn.Conv2d(channels, width, 7, 2, 3, bias=False),
        nn.BatchNorm2d(width),
        nn.ReLU(inplace=True),
        nn.MaxPool2d(3, 2, 1),
    ]
    channels = width
    for stage, count in enumerate(blocks):
        for block in range(count):
            stride = 2 if block == 0 and stage > 0 else 1
            layers.append(_Block(channels, width * 2**stage, stride))
            channels = width * 2**stage
    return nn.Sequential(*layers)


class _Block(nn.Module):
    """Two 3 x 3 convolutions with a shortcut."""

    def __init__(self, channels_in: int, channels_out: int, stride: int) -> None:
        super().__init__()
        self.residual = nn.Sequential(
            nn.Conv2d(channels_in, channels_out, 3, stride, 1, bias=False),
            nn.BatchNorm2d(channels_out),
            nn.ReLU(inplace=True),
            nn.Conv2d(channels_out, channels_out, 3, padding=1, bias=False),
            nn.BatchNorm2d(channels_out),
        )
        self.shortcut: nn.Module = nn.Identity()
        if channels_in != channels_out or stride > 1:
            self.shortcut = nn.Sequential(
                nn.Conv2d(channels_in, channels_out, 1, stride, bias=False),
                nn.BatchNorm2d(channels_out),
            )

    def forward(
        self, features: Float[Tensor, "batch channels rows columns"]
    ) -> Float[Tensor, "batch channels_out rows_out columns_out"]:
        return (self.residual(features) + self.shortcut(features)).relu_()
