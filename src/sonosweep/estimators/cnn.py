"""A plain network on pairs of frames (Prevost et al. 2018).

References:
    Prevost et al., "3D freehand ultrasound without external tracking using deep learning",
    Medical Image Analysis 48, 2018, section 3.2.

Differs:
    The original also reads the optical flow between the two frames, as two more channels, and
    the angles of an inertial sensor, beside the features of its first full layer. Both are
    left out: what is compared here is what a network learns from the frames alone. Of sizes
    the article says nothing; they are those of the public version of Guo et al. 2020, which
    has one full layer (``hidden=0``) where the article draws two.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from pydantic import NonNegativeInt, PositiveInt
from torch import Tensor, nn

from sonosweep.errors import ScanError
from sonosweep.estimators.motion_head import MotionHead
from sonosweep.estimators.network import FrameShape, NetworkOutput, RecurrentNetwork
from sonosweep.estimators.shrink import shrink_frames

REDUCTION = 64
"""Of four strided convolutions and two poolings."""


@dataclass(frozen=True)
class CNNOptions:
    """Sizes of the network.

    Attributes:
        width: Channels of each convolution; 64 in Guo et al.'s version.
        hidden: Units of a full layer before the last, 512 in the article; 0 for none, as in
            Guo et al.'s version.
        normalize: Whether convolutions are followed by batch normalization, which neither
            of the two has and with which training needs far fewer steps.
        shrink: Pixels along each side of a frame that are averaged into one at first.
        log_variance: Whether the variance of each number is predicted as well.
    """

    width: PositiveInt = 64
    hidden: NonNegativeInt = 0
    normalize: bool = False
    shrink: PositiveInt = 1
    log_variance: bool = False


PAPER = CNNOptions()
COMPACT = CNNOptions(width=48, hidden=256, normalize=True)


class CNN(RecurrentNetwork):
    """Pairs of frames to motions, each pair on its own.

    Args:
        shape: Of the frames.
        options: Sizes.
    """

    def __init__(self, shape: FrameShape | None = None, options: CNNOptions | None = None) -> None:
        super().__init__()
        self.frame_shape = shape or FrameShape()
        self.options = o = options or PAPER
        rows = self.frame_shape.rows // o.shrink // REDUCTION
        columns = self.frame_shape.columns // o.shrink // REDUCTION
        if min(rows, columns) < 1:
            least = REDUCTION * o.shrink
            raise ScanError(f"cnn with shrink={o.shrink} reads at least {least} x {least} pixels")
        self.convolutions = nn.Sequential(
            _layer(2 * self.frame_shape.channels, o.width, 5, o.normalize),
            _layer(o.width, o.width, 5, o.normalize),
            nn.MaxPool2d(2),
            _layer(o.width, o.width, 3, o.normalize),
            _layer(o.width, o.width, 3, o.normalize),
            nn.MaxPool2d(2),
        )
        features = o.width * rows * columns
        self.full = nn.Sequential()
        if o.hidden:
            self.full = nn.Sequential(nn.Linear(features, o.hidden), nn.ReLU())
        self.to_motion = MotionHead(o.hidden or features, o.log_variance)

    def encode(self, frames: Float[Tensor, "batch channels rows columns"]) -> tuple[Tensor, ...]:
        """Return the frames: the first convolution already reads two of them."""
        return (shrink_frames(frames, self.options.shrink),)

    def compare(self, first: tuple[Tensor, ...], second: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        """Return what the convolutions say about pairs."""
        pair = torch.cat((first[0], second[0]), 1)
        return (self.full(self.convolutions(pair).flatten(1)),)

    def regress(
        self, pairs: tuple[Tensor, ...], state: tuple[Tensor, ...] | None
    ) -> tuple[NetworkOutput, tuple[Tensor, ...]]:
        """Return the motion of each step; there is no state."""
        motion, log_variance = self.to_motion(pairs[0])
        return NetworkOutput(motion, (motion,), log_variance=log_variance), ()


def _layer(channels_in: int, channels_out: int, size: int, normalize: bool) -> nn.Module:
    """Return a convolution that halves the size (without bias, as in Guo et al.'s version)."""
    convolution = nn.Conv2d(channels_in, channels_out, size, 2, padding=size // 2, bias=False)
    norm = nn.BatchNorm2d(channels_out) if normalize else nn.Identity()
    return nn.Sequential(convolution, norm, nn.ReLU(inplace=True))
