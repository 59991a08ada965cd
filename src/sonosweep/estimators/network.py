"""What every motion network takes and gives.

A network reads a window of frames and gives the motion of each step in it, in units in which
each of the six numbers varies by about 1 (:class:`sonosweep.estimators.weights.Weights` holds
the scale). Two kinds differ in what may be computed once and kept: a
:class:`RecurrentNetwork` encodes each frame once, compares each pair once and carries a
state; a :class:`WindowNetwork` looks at a whole window at a time.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sonosweep.errors import ScanError

Frames = Float[Tensor, "batch frames channels rows columns"]


@dataclass(frozen=True)
class FrameShape:
    """What a network reads.

    Attributes:
        channels: Per frame: 1 for B-mode, 3 for B-mode and IQ.
        rows: Pixels along the axial axis.
        columns: Pixels along the lateral axis.
    """

    channels: int = 1
    rows: int = 256
    columns: int = 256

    def __post_init__(self) -> None:
        """Check that there are pixels enough for a network to look at.

        Raises:
            ScanError: If not.
        """
        if self.channels < 1 or min(self.rows, self.columns) < 32:
            raise ScanError(
                f"a network reads at least 1 channel of 32 x 32 pixels, got {self.channels} of"
                f" {self.rows} x {self.columns}"
            )


@dataclass(frozen=True, eq=False)
class NetworkOutput:
    """What a network says about a window.

    Attributes:
        motion: Of each step, in scaled units.
        heads: Each prediction that is trained against the truth; the mean of them, or one
            of them, is ``motion``.
        embedding: Features of the last step, for the triplet loss; ``None`` if the paper
            of this network contrasts none.
        log_variance: Of each number of ``motion``; ``None`` unless asked for.
        maps: What can be looked at, by name, such as ``"attention"``. The first axes are
            batch and steps; of a network that reads windows the batch, one map a window.
    """

    motion: Float[Tensor, "batch steps motion=6"]
    heads: tuple[Float[Tensor, "batch steps motion=6"], ...]
    embedding: Float[Tensor, "batch features"] | None = None
    log_variance: Float[Tensor, "batch steps motion=6"] | None = None
    maps: Mapping[str, Tensor] = field(default_factory=dict)


class MotionNetwork(nn.Module, ABC):
    """Frames to motions."""

    frame_shape: FrameShape

    @abstractmethod
    def forward(self, frames: Frames) -> NetworkOutput:
        """Return the motion of each step of windows of frames, values within 0 and 1."""


class WindowNetwork(MotionNetwork):
    """A network that looks at ``window`` frames at once, and at nothing before them."""

    window: int


def check_window(frames: Frames, window: int) -> None:
    """Check that a window network gets as many frames as it reads.

    Raises:
        ScanError: If not.
    """
    if frames.shape[1] != window:
        raise ScanError(f"the network reads {window} frames at once, got {frames.shape[1]}")


def check_frames(frames: Float[Tensor, "*batch channels rows columns"], shape: FrameShape) -> None:
    """Check that a network gets the frames that it reads.

    Raises:
        ScanError: If they have other channels or pixels.
    """
    channels, rows, columns = frames.shape[-3:]
    if (channels, rows, columns) != (shape.channels, shape.rows, shape.columns):
        raise ScanError(
            f"the network reads {shape.channels} channels of {shape.rows} x {shape.columns}"
            f" pixels, got {channels} of {rows} x {columns}"
        )


class RecurrentNetwork(MotionNetwork):
    """A network whose answer about a step depends on it and on what came before.

    ``forward`` is what the three parts give on a window, so that frame by frame and the
    whole window at once are the same.
    """

    @abstractmethod
    def encode(self, frames: Float[Tensor, "batch channels rows columns"]) -> tuple[Tensor, ...]:
        """Return the features of single frames, the batch first in each."""

    @abstractmethod
    def compare(
        self,
        first: tuple[Tensor, ...],
        second: tuple[Tensor, ...],
    ) -> tuple[Tensor, ...]:
        """Return what is known about steps from the features of their two frames."""

    @abstractmethod
    def regress(
        self, pairs: tuple[Tensor, ...], state: tuple[Tensor, ...] | None
    ) -> tuple[NetworkOutput, tuple[Tensor, ...]]:
        """Return motions from what is known about steps, ``(batch, steps, ...)`` each.

        Args:
            pairs: What ``compare`` gave, with an axis for steps.
            state: What the last call gave; ``None`` at the start of a sweep.
        """

    def forward(self, frames: Frames) -> NetworkOutput:
        """Return the motion of each step of windows of frames, values within 0 and 1."""
        check_frames(frames, self.frame_shape)
        batch, count = frames.shape[:2]
        # Time first, so that the frames before and after every step are slices, not copies.
        features = self.encode(frames.transpose(0, 1).flatten(0, 1))
        pairs = self.compare(
            tuple(_frames(part, slice(None, -batch)) for part in features),
            tuple(_frames(part, slice(batch, None)) for part in features),
        )
        steps = tuple(part.unflatten(0, (count - 1, batch)).transpose(0, 1) for part in pairs)
        return self.regress(steps, None)[0]


def _frames(part: Tensor, chosen: slice) -> Tensor:
    """Return the features of some frames; maps keep the channels last, and so do gradients.

    A plain slice's gradient has the channels first, whatever the slice had, and everything
    before it then trains several times more slowly.
    """
    if part.ndim != 4:
        return part[chosen]
    return part.permute(0, 2, 3, 1)[chosen].permute(0, 3, 1, 2)


class Stepper:
    """Runs a network over a sweep of any length; memory does not grow with it.

    However the frames come, one by one or many at a time, the motions are the same but for
    rounding.

    Args:
        network: In evaluation mode.
    """

    def __init__(self, network: MotionNetwork) -> None:
        self._network = network
        self._features: tuple[Tensor, ...] | None = None
        self._state: tuple[Tensor, ...] | None = None
        self._before: Tensor | None = None

    def push(self, frame: Float[Tensor, "channels rows columns"]) -> NetworkOutput | None:
        """Return what the network says about the step to this frame; ``None`` for the first."""
        return self.push_many(frame[None])

    @torch.inference_mode()
    def push_many(
        self, frames: Float[Tensor, "frames channels rows columns"]
    ) -> NetworkOutput | None:
        """Return what the network says about the steps to these frames, as a batch of one.

        The first frame of a sweep has no step; ``None`` if it comes alone.
        """
        check_frames(frames, self._network.frame_shape)
        if isinstance(self._network, RecurrentNetwork):
            return self._push_recurrent(self._network, frames)
        assert isinstance(self._network, WindowNetwork)
        return self._push_window(self._network, frames)

    def _push_recurrent(self, network: RecurrentNetwork, frames: Tensor) -> NetworkOutput | None:
        features = network.encode(frames)
        before, self._features = self._features, tuple(part[-1:].clone() for part in features)
        first = tuple(part[:-1] for part in features)
        if before is None:
            features = tuple(part[1:] for part in features)
        elif len(frames) == 1:
            first = before
        else:
            first = tuple(torch.cat(parts) for parts in zip(before, first, strict=True))
        if len(features[0]) == 0:
            return None
        pairs = tuple(part[None] for part in network.compare(first, features))
        output, self._state = network.regress(pairs, self._state)
        return output

    def _push_window(self, network: WindowNetwork, frames: Tensor) -> NetworkOutput | None:
        if self._before is None:
            # As the released code does, the first frame stands for those before the sweep.
            self._before = frames[:1].expand(network.window - 1, -1, -1, -1)
            frames = frames[1:]
        stack = torch.cat((self._before, frames))
        self._before = stack[1 - network.window :].clone()
        if len(frames) == 0:
            return None
        return _last_steps(network(stack.unfold(0, network.window, 1).movedim(-1, 1)))


def _last_steps(output: NetworkOutput) -> NetworkOutput:
    """Return the last step of each of many windows as the steps of one sweep."""

    def last(values: Tensor) -> Tensor:
        return values[:, -1:].transpose(0, 1)

    return NetworkOutput(
        motion=last(output.motion),
        heads=tuple(last(head) for head in output.heads),
        log_variance=None if output.log_variance is None else last(output.log_variance),
        maps={name: values[None] for name, values in output.maps.items()},
    )
