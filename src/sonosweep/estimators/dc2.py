"""DC2-Net: DCL-Net whose features are contrasted by their motion (Guo et al. 2022).

References:
    Guo et al., "Ultrasound volume reconstruction from freehand scans without tracking", IEEE
    Transactions on Biomedical Engineering 70, 2022: "deep contextual-contrastive network".

Differs:
    No code was published. Backbone and attention are taken to be those of DCL-Net
    (:mod:`sonosweep.estimators.dcl`), on which the paper builds, and the contrasted features
    to be those that the last layer reads. What the paper adds is a margin ranking loss (of
    two windows, the one whose motion is more like a third's shall have the nearer features)
    and a case-wise correlation loss; both belong to the recipe, the first takes
    ``embedding``. Where the paper predicts the mean motion of a window
    (``mean_of_window``), each step has its own by default.
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
class DC2Options:
    """Sizes of the network.

    Attributes:
        window: Frames that are read at once; 5, as in DCL-Net.
        size: Of the 3D ResNeXt; that of DCL-Net's code.
        mean_of_window: Whether one motion is predicted for all steps of a window.
        shrink: Pixels along each side of a frame that are averaged into one at first.
        log_variance: Whether the variance of each number is predicted as well.
    """

    window: Annotated[int, Field(ge=2)] = 5
    size: ResNeXtSize = field(default_factory=ResNeXtSize)
    mean_of_window: bool = False
    shrink: PositiveInt = 1
    log_variance: bool = False


PAPER = DC2Options()
COMPACT = DC2Options(size=ResNeXtSize(width=16, blocks=(1, 2, 2, 1), cardinality=4))


class DC2(WindowNetwork):
    """Windows of frames to the motion of each step, and to features that can be contrasted.

    Args:
        shape: Of the frames.
        options: Sizes.
    """

    def __init__(self, shape: FrameShape | None = None, options: DC2Options | None = None) -> None:
        super().__init__()
        self.frame_shape = shape or FrameShape()
        self.options = o = options or PAPER
        self.window = o.window
        self.encoder = AttendingResNeXt(self.frame_shape.channels, o.size, o.shrink)
        self.to_motion = WindowHead(
            self.encoder.features, o.window - 1, o.mean_of_window, o.log_variance
        )

    def forward(self, frames: Frames) -> NetworkOutput:
        """Return the motion of each step, the window's features, and where they come from."""
        check_window(frames, self.window)
        features, attention = self.encoder(frames)
        motion, log_variance = self.to_motion(features)
        return NetworkOutput(
            motion, (motion,), features, log_variance, maps={"attention": attention}
        )
