"""MoGLo-Net: motion-based learning with global-local attention.

Names follow the paper: E1 to E4 are the features after the four encoder blocks, C the
correlation volume, G and L the global and local features that the attention makes of E4 and
E2.

References:
    Lee et al., "Enhancing Free-hand 3D Photoacoustic and Ultrasound Reconstruction using Deep
    Learning", IEEE Transactions on Medical Imaging 2025, section "Motion Estimation", and
    its released code, from which the sizes are that the paper leaves open.
"""

from dataclasses import dataclass, field
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float
from pydantic import NonNegativeInt, PositiveInt
from torch import Tensor, nn

from sonosweep.errors import ScanError
from sonosweep.estimators.attention import PAPER_READING, AttentionReading, GlobalLocalAttention
from sonosweep.estimators.backbones import ResidualBlock, convolution, residual_stage
from sonosweep.estimators.correlation import (
    CorrelationGeometry,
    correlation_volume,
    subtract_local_mean,
)
from sonosweep.estimators.diagonals import full_precision
from sonosweep.estimators.image_correlation import ShiftRange, image_correlation
from sonosweep.estimators.motion_head import MotionHead
from sonosweep.estimators.network import FrameShape, NetworkOutput, RecurrentNetwork

SIZE = 4
"""Side of E4 and of a local block; also pixels of E1 and E2 for each of E3."""

LARGEST_CORRELATION = 0.9999
"""Of which an angle is taken: at 1 it has no slope."""


@dataclass(frozen=True)
class MoGLoOptions:
    """Sizes, and how to read the paper.

    Attributes:
        width: Channels of E1; 64 in the paper.
        blocks: Residual blocks in each encoder block. The paper says "ResNet-based";
            (3, 4, 6, 3) is the released code.
        stem_stride: Of the first convolution: 2 with a block that halves after it (code);
            4, which saves most of encoder block 1; or 8, with which E1, E2 and E3 have half
            as many rows and columns.
        halve: Whether encoder block 3 halves the map after the convolutions (code) or
            before, which saves most of them. Block 4 halves it after them in any case: the
            maximum over regions would be taken of correlations that nothing has read yet.
        hidden: Units of each LSTM; 512 in the code, not said in the paper.
        projection: Units of a layer that sees all places of L and G, before each LSTM; 0
            for the mean over places (code; the paper does not say).
        correlation: Whether the frames are correlated (C in the paper's ablation).
        attention: Whether there is global-local attention (G in the paper's ablation);
            without it E4 alone is read.
        zero_mean: Whether the local mean is taken off E1 before it is correlated, and the
            volumes are normalized. Not in the paper, where the cosine of features after a
            rectifier is near 1 everywhere.
        measure: Whether the volumes hold the correlation, or its angle, which is arccos of it.
            Not in the paper. Speckle decorrelates with the square of a small step, so that
            the correlation hardly changes where steps are small; its angle grows in
            proportion to the step.
        image_correlation: Whether the frames themselves are correlated beside E1. Not in
            the paper, where axial steps are an eighth of a pixel of E1.
        layout: What the channels of C are: displacements on the grid of regions; or regions
            on the grid of displacements, resized to E3 (code). The paper stacks arrays and
            leaves it open.
        differentiable: Whether gradients flow through C; not in the code, the paper does
            not say.
        combination: Of what local and global features say: their mean (code; the paper does
            not say); or weights that are learned for each of the six numbers. L is made of
            E2, which the correlation has not reached, and knows less.
        log_variance: Whether the variance of each number is predicted as well.
        geometry: Of the correlation of E1.
        shifts: Of the correlation of frames, whose blocks are the pixels of E3.
        reading: Of the attention.
    """

    width: PositiveInt = 64
    blocks: tuple[PositiveInt, PositiveInt, PositiveInt, PositiveInt] = (3, 4, 6, 3)
    stem_stride: Literal[2, 4, 8] = 2
    halve: Literal["before", "after"] = "after"
    hidden: PositiveInt = 512
    projection: NonNegativeInt = 0
    correlation: bool = True
    attention: bool = True
    zero_mean: bool = True
    measure: Literal["correlation", "angle"] = "angle"
    image_correlation: bool = True
    layout: Literal["displacements", "regions"] = "displacements"
    differentiable: bool = True
    combination: Literal["mean", "learned"] = "learned"
    log_variance: bool = False
    geometry: CorrelationGeometry = field(default_factory=CorrelationGeometry)
    shifts: ShiftRange = field(default_factory=ShiftRange)
    reading: AttentionReading = field(default_factory=AttentionReading)

    def __post_init__(self) -> None:
        """Check what fits together.

        Raises:
            ScanError: If the encoder has too few blocks, or a grid is not that of E3.
        """
        if self.blocks[2] < 2:
            raise ScanError("encoder block 3 of moglo halves the map twice: it needs 2 blocks")
        if self.geometry.stride != SIZE:
            raise ScanError(
                f"the regions of moglo's correlation are pixels of E3: their stride is {SIZE},"
                f" not {self.geometry.stride}"
            )

    @property
    def e1_reduction(self) -> int:
        """Pixels of a frame along each side of a pixel of E1, whose features are correlated."""
        return max(self.stem_stride, 4)

    @property
    def reduction(self) -> int:
        """Pixels of a frame along each side of a pixel of E3."""
        return SIZE * self.e1_reduction


PAPER = MoGLoOptions(
    zero_mean=False,
    measure="correlation",
    image_correlation=False,
    combination="mean",
    reading=PAPER_READING,
)
"""The paper's equations to the letter."""

RELEASED_CODE = MoGLoOptions(
    zero_mean=False,
    measure="correlation",
    image_correlation=False,
    layout="regions",
    differentiable=False,
    combination="mean",
)
"""What the released code does, but for the mirrored axes of its correlation arrays."""

COMPACT = MoGLoOptions(
    width=32,
    blocks=(1, 1, 2, 1),
    stem_stride=8,
    halve="before",
    hidden=128,
    projection=128,
    geometry=CorrelationGeometry(radius=2),
)
"""Trains on a CPU and runs on one, at 256 x 256 pixels; of 128 x 128 choose a stem of 4."""


class MoGLo(RecurrentNetwork):
    """Frames to motions through correlation and global-local attention.

    Args:
        shape: Of the frames; multiples of 64 pixels.
        options: Sizes and readings.

    Raises:
        ScanError: If the frames are of another size.
    """

    def __init__(
        self, shape: FrameShape | None = None, options: MoGLoOptions | None = None
    ) -> None:
        super().__init__()
        self.frame_shape = shape = shape or FrameShape()
        self.options = o = options or MoGLoOptions()
        if shape.rows % 64 or shape.columns % 64:
            raise ScanError(
                "moglo reads frames whose sides are multiples of 64 pixels, got"
                f" {shape.rows} x {shape.columns}"
            )
        w, regions = o.width, shape.rows * shape.columns // o.reduction**2
        volume = _volume_channels(o, regions)
        self.encoder_1 = _first_encoder(shape.channels, o)
        self.encoder_2 = residual_stage(2 * w, 2 * w, o.blocks[1])
        self.encoder_3 = nn.Sequential(
            ResidualBlock(2 * w, 4 * w, o.halve),
            residual_stage(4 * w, 4 * w, o.blocks[2] - 1, o.halve),
        )
        self.volume_norm = nn.BatchNorm2d(volume) if volume and o.zero_mean else nn.Identity()
        self.encoder_4 = nn.Sequential(
            residual_stage(4 * w + volume, 8 * w, o.blocks[3], "after"),
            nn.AdaptiveAvgPool2d(SIZE),
        )
        if o.attention:
            self.attention = GlobalLocalAttention(2 * w, 8 * w, regions, SIZE, o.reading)
        self.estimators = nn.ModuleList(_MotionEstimator(8 * w, o) for _ in range(1 + o.attention))
        learned = o.attention and o.combination == "learned"
        self.shares = nn.Parameter(torch.zeros(2, 6)) if learned else None
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # torch's stub

    def encode(self, frames: Float[Tensor, "batch channels rows columns"]) -> tuple[Tensor, ...]:
        """Return of single frames E1, and what is correlated: E1 and, if asked for, B-mode."""
        o, e1 = self.options, self.encoder_1(frames)
        if not o.correlation:
            return (e1,)
        correlated = subtract_local_mean(e1) if o.zero_mean else e1
        return (e1, correlated, *((frames[:, :1],) if o.image_correlation else ()))

    def compare(self, first: tuple[Tensor, ...], second: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        """Return L and G of steps (E4 without attention), then maps to look at."""
        e2 = self.encoder_2(torch.cat((first[0], second[0]), 1))
        e3 = self.encoder_3(e2)
        shown: tuple[Tensor, ...] = ()
        if self.options.correlation:
            volume, shown = self._volumes(first[1:], second[1:])
            e3 = torch.cat((e3, self.volume_norm(volume).to(e3.dtype)), 1)
        e4 = self.encoder_4(e3)
        if not self.options.attention:
            return (e4, *shown)
        local, whole, weights = self.attention(e2, e4)
        return (local, whole, *shown, weights.detach().unflatten(1, e3.shape[-2:]))

    def regress(
        self, pairs: tuple[Tensor, ...], state: tuple[Tensor, ...] | None
    ) -> tuple[NetworkOutput, tuple[Tensor, ...]]:
        """Return the motion of steps: what local and global features say, combined."""
        heads, variances, after = [], [], []
        for k, estimator in enumerate(self.estimators):
            before = None if state is None else (state[2 * k], state[2 * k + 1])
            motion, log_variance, last = estimator(pairs[k], before)
            heads.append(motion)
            variances.append(log_variance)
            after.extend(last)
        count, o, motion = len(heads), self.options, self._combined(heads)
        if self.shares is not None:
            heads.append(motion)
        names = ("correlation",) * o.correlation + ("attention",) * o.attention
        output = NetworkOutput(
            motion=motion,
            heads=tuple(heads),
            embedding=torch.cat([part[:, -1].float().flatten(1) for part in pairs[:count]], 1),
            log_variance=self._combined(variances) if o.log_variance else None,
            maps=dict(zip(names, pairs[count:], strict=True)),
        )
        return output, tuple(after)

    def _combined(self, parts: list[Tensor]) -> Tensor:
        """Return the mean, weighted if so learned, of what local and global features say."""
        if self.shares is None:
            return torch.stack(parts).mean(0)
        return (self.shares.softmax(0)[:, None, None] * torch.stack(parts)).sum(0)

    def _volumes(
        self, first: tuple[Tensor, ...], second: tuple[Tensor, ...]
    ) -> tuple[Tensor, tuple[Tensor, ...]]:
        """Return C as channels on E3's grid, and its mean over regions to look at."""
        o = self.options
        with torch.set_grad_enabled(torch.is_grad_enabled() and o.differentiable):
            volume = correlation_volume(first[0], second[0], o.geometry)
        volumes = [_as_channels(volume, o.layout)]
        if o.image_correlation:
            frames = image_correlation(first[1], second[1], o.reduction, o.shifts)
            volumes.append(_as_channels(frames, "displacements"))
        channels = torch.cat(volumes, 1)
        if o.measure == "angle":
            channels = channels.clamp(-LARGEST_CORRELATION, LARGEST_CORRELATION).acos()
        return channels, (volume.detach().mean((1, 2)),)


class _MotionEstimator(nn.Module):
    """Features of steps to their motion, with memory of the steps before.

    Args:
        channels: Of G or L.
        options: Sizes.
    """

    def __init__(self, channels: int, options: MoGLoOptions) -> None:
        super().__init__()
        units = options.projection
        self.projection = nn.Sequential()
        if units:
            self.projection = nn.Sequential(nn.Linear(channels * SIZE**2, units), nn.SiLU())
        self.recurrent = nn.LSTM(units or channels, options.hidden, batch_first=True)
        self.to_motion = MotionHead(options.hidden, options.log_variance)

    def forward(
        self,
        features: Float[Tensor, "batch steps channels size size"],
        state: tuple[Tensor, Tensor] | None,
    ) -> tuple[Tensor, Tensor | None, tuple[Tensor, Tensor]]:
        """Return motion and log variance of steps, and the state after them."""
        with full_precision(features.device):
            features = features.float()
            seen = features.flatten(2) if len(self.projection) else features.mean((-1, -2))
            hidden, last = self.recurrent(self.projection(seen), state)
            return *self.to_motion(hidden), last


def _first_encoder(channels: int, options: MoGLoOptions) -> nn.Module:
    """Return encoder block 1, which makes a frame 4 or 8 times smaller."""
    width, stride = options.width, options.stem_stride
    return nn.Sequential(
        convolution(channels, width, 7, stride),
        nn.SiLU(),
        residual_stage(width, width, options.blocks[0], "after" if stride == 2 else "no"),
    )


def _volume_channels(options: MoGLoOptions, regions: int) -> int:
    """Return how many channels the correlation adds to E3."""
    if not options.correlation:
        return 0
    axial, lateral = options.shifts.count
    features = options.geometry.side**2 if options.layout == "displacements" else regions
    return features + axial * lateral * options.image_correlation


def _as_channels(volume: Tensor, layout: str) -> Tensor:
    """Return a correlation volume as a map on the grid of its regions."""
    if layout == "displacements":
        return volume.flatten(3).permute(0, 3, 1, 2)
    grid = volume.shape[1:3]
    return F.interpolate(volume.flatten(1, 2), size=grid, mode="bilinear", align_corners=True)
