"""What a network looked at in single steps, beside what it looked at it in."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from torch import Tensor

from sonosweep.estimators.correlation import (
    CorrelationGeometry,
    correlation_volume,
    subtract_local_mean,
)
from sonosweep.estimators.fit_scan import FittedScan
from sonosweep.estimators.moglo import MoGLo
from sonosweep.estimators.network import MotionNetwork
from sonosweep.estimators.network_input import unit_frames


@dataclass(frozen=True, eq=False)
class StepMaps:
    """What a network showed of one step.

    Attributes:
        words: Which step it is.
        frame: B-mode of the step's end, as the network saw it.
        mm_per_pixel: Lateral and axial.
        attention: How much each part of the frame counts.
        features: Mean correlation of features for every shift (rows, columns).
        frames: The same of the frames.
    """

    words: str
    frame: UInt8[np.ndarray, "rows columns"]
    mm_per_pixel: tuple[float, float]
    attention: Float[np.ndarray, "blocks_down blocks_across"] | None = None
    features: Float[np.ndarray, "shift_rows shift_columns"] | None = None
    frames: Float[np.ndarray, "shift_rows shift_columns"] | None = None


def step_maps(
    fitted: FittedScan,
    network: MotionNetwork,
    maps: Mapping[str, Float[Tensor, "..."]],
    step: int,
    words: str,
) -> StepMaps:
    """Return what a network showed of a step with the frame, and the frames' own correlation.

    Args:
        fitted: What it read.
        network: That read it.
        maps: What it showed of the step.
        step: Number of the step.
        words: Which step it is.
    """
    before, after = unit_frames(torch.from_numpy(fitted.frames[step : step + 2]))[:, 0]
    attention, features = maps.get("attention"), maps.get("correlation")
    frames = None
    if isinstance(network, MoGLo) and features is not None:
        options = network.options
        frames = frame_correlation(
            before, after, options.geometry, options.e1_reduction, options.zero_mean
        ).numpy()
    return StepMaps(
        words=words,
        frame=(255 * after).round().to(torch.uint8).numpy(),
        mm_per_pixel=fitted.spacing_mm,
        attention=None if attention is None else attention.numpy(),
        features=None if features is None else features.numpy(),
        frames=frames,
    )


def frame_correlation(
    first: Float[Tensor, "rows columns"],
    second: Float[Tensor, "rows columns"],
    geometry: CorrelationGeometry,
    reduction: int,
    zero_mean: bool,
) -> Float[Tensor, "shift_rows shift_columns"]:
    """Return the correlation of two frames for every shift, as ``moglo`` does of E1.

    The frames are brought to the size of E1, and everything else is the same, so that what
    differs is what encoder block 1 learned.

    Args:
        first: B-mode, values within 0 and 1.
        second: The next frame.
        geometry: Of the network's correlation.
        reduction: Pixels of the frame per pixel of E1, along each side.
        zero_mean: Whether the local mean is taken off, as the network does with E1.

    References:
        Lee et al. 2025, section "Discussion" and its figure of correlation maps.
    """
    small = F.avg_pool2d(torch.stack((first, second))[:, None], reduction)
    if zero_mean:
        small = subtract_local_mean(small)
    return correlation_volume(small[:1], small[1:], geometry)[0].mean((0, 1))
