"""DCL-Net: a 3D network over a window of frames that learns where to look (Guo et al. 2020).

References:
    Guo et al., "Sensorless freehand 3D ultrasound reconstruction via deep contextual
    learning", MICCAI 2020; sizes that it does not give are those of its public code.

Differs:
    The paper predicts one motion, the mean of the window's: ``mean_of_window``. By default
    each step of the window gets its own six numbers, so that all networks answer the same
    question. Targets are motions seen from the frame, the paper's are in world axes. Its
    case-wise correlation loss belongs to the recipe.
"""

from dataclasses import dataclass, field
from typing import Annotated

from pydantic import Field, PositiveInt

from sonosweep.estimators.motion_head import WindowHead
from sonosweep.estimators.network import (
    Frames,
    FrameShape,
    NetworkOutput,
    WindowNetwork,
    check_window,
)
from sonosweep.estimators.resnext import AttendingResNeXt, ResNeXtSize


@dataclass(frozen=True)
class DCLOptions:
    """Sizes of the network.

    Attributes:
        window: Frames that are read at once; 5 in the paper.
        size: Of the 3D ResNeXt; a "ResNeXt-50" in the public code.
        mean_of_window: Whether one motion is predicted for all steps of a window.
        shrink: Pixels along each side of a frame that are averaged into one at first.
        log_variance: Whether the variance of each number is predicted as well.
    """

    window: Annotated[int, Field(ge=2)] = 5
    size: ResNeXtSize = field(default_factory=ResNeXtSize)
    mean_of_window: bool = False
    shrink: PositiveInt = 1
    log_variance: bool = False


PAPER = DCLOptions()
COMPACT = DCLOptions(size=ResNeXtSize(width=16, blocks=(1, 2, 2, 1), cardinality=4))


class DCL(WindowNetwork):
    """Windows of frames to the motion of each step.

    Args:
        shape: Of the frames.
        options: Sizes.
    """

    def __init__(self, shape: FrameShape | None = None, options: DCLOptions | None = None) -> None:
        super().__init__()
        self.frame_shape = shape or FrameShape()
        self.options = o = options or PAPER
        self.window = o.window
        self.encoder = AttendingResNeXt(self.frame_shape.channels, o.size, o.shrink)
        self.to_motion = WindowHead(
            self.encoder.features, o.window - 1, o.mean_of_window, o.log_variance
        )

    def forward(self, frames: Frames) -> NetworkOutput:
        """Return the motion of each step, and as a map where the network looked."""
        check_window(frames, self.window)
        features, attention = self.encoder(frames)
        motion, log_variance = self.to_motion(features)
        return NetworkOutput(
            motion, (motion,), log_variance=log_variance, maps={"attention": attention}
        )
