"""Fewer pixels for a network that is too slow with all of them."""

import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor


def shrink_frames(
    frames: Float[Tensor, "*batch channels rows columns"], factor: int
) -> Float[Tensor, "*batch channels rows_out columns_out"]:
    """Return frames of which each pixel is the mean of ``factor`` x ``factor``.

    Speckle should stay at least two pixels wide, or there is no motion left to be seen.
    """
    if factor == 1:
        return frames
    small = F.avg_pool2d(frames.flatten(0, -4), factor)
    return small.unflatten(0, frames.shape[:-3])
