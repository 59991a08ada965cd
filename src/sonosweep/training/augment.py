"""Other sweeps and other scanners out of the ones at hand.

Two changes of a sweep are exact, and neither needs a new image. Seen in a *lateral mirror*,
the frames are flipped and each step is conjugated by the mirror. Played *backwards in an
elevational mirror*, the frames are the same ones in reverse (the mirror's plane is the
image, which it leaves as it is), and each step is the inverse one conjugated by the mirror,
so that a sweep that went forward still does. Both need steps about the lateral centre of
the frame, as :func:`sonosweep.estimators.network_input.center_poses` gives them, and an
elevational beam that is the same to both sides.

The other changes are of the image alone: what another gain, another gray map, more noise or
another speckle reduction would have made of it.
"""

import numpy as np
import torch
from jaxtyping import Float
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor
from torch.nn import functional

from sonosweep.geometry import invert_pose, motion_from_step, step_from_motion

LOOKS = ("gain", "contrast", "gamma", "noise", "blur")
MIDDLE_GRAY = 0.5


class AugmentSettings(BaseModel):
    """How much to change; each window is changed by itself, all its frames alike.

    Attributes:
        mirror: Whether half of the windows are seen in a lateral mirror.
        reverse: Whether half of them are played backwards in an elevational mirror.
        gain: Largest gray level, of 1, to add or take away.
        contrast: Largest change of the slope about middle gray.
        gamma: Largest change of the logarithm of the gray map's exponent.
        noise: Largest standard deviation of noise, of 1.
        blur: Largest share of a 3 x 3 mean that is mixed in (speckle reduction).
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    mirror: bool = True
    reverse: bool = True
    gain: float = Field(default=0.06, ge=0, le=0.5)
    contrast: float = Field(default=0.15, ge=0, lt=1)
    gamma: float = Field(default=0.15, ge=0, le=1)
    noise: float = Field(default=0.02, ge=0, le=0.5)
    blur: float = Field(default=0.0, ge=0, le=1)


def mirror_lateral(
    motion: Float[Tensor, "*batch motion=6"],
) -> Float[Tensor, "*batch motion=6"]:
    """Return the motions of a sweep seen in a mirror across the lateral axis.

    The step is D step D with D = diag(-1, 1, 1): the lateral motion and the turns about the
    two other axes change sign, exactly and for turns of any size.
    """
    return motion * motion.new_tensor([-1, 1, 1, 1, -1, -1])


def reverse_in_elevational_mirror(
    motion: Float[Tensor, "*batch steps motion=6"],
) -> Float[Tensor, "*batch steps motion=6"]:
    """Return the motions of a sweep played backwards and seen in a mirror across it.

    The step is E inverse(step) E with E = diag(1, 1, -1), and steps come in reversed order.
    """
    back = motion_from_step(invert_pose(step_from_motion(motion.flip(-2).double())))
    return (back * back.new_tensor([1, 1, -1, -1, -1, 1])).to(motion.dtype)


def draw_looks(
    settings: AugmentSettings, draw: np.random.Generator
) -> Float[np.ndarray, " looks=5"]:
    """Return the numbers of :data:`LOOKS` for one window."""
    signed, positive = draw.uniform(-1, 1, 3), draw.uniform(0, 1, 2)
    return np.array(
        [
            settings.gain * signed[0],
            1 + settings.contrast * signed[1],
            np.exp(settings.gamma * signed[2]),
            settings.noise * positive[0],
            settings.blur * positive[1],
        ],
        dtype=np.float32,
    )


def change_looks(
    frames: Float[Tensor, "batch frames channels rows columns"],
    looks: Float[Tensor, "batch looks=5"],
    zeros: tuple[float | None, ...],
) -> Float[Tensor, "batch frames channels rows columns"]:
    """Return frames as another scanner would show them, still from 0 to 1.

    Args:
        frames: From 0 to 1.
        looks: Of each window, as :func:`draw_looks` gives them; its noise is drawn here.
        zeros: Of each channel the value that stands for no echo, or ``None`` if it holds
            gray levels; echoes change in gain and noise alone.
    """
    changed = [
        _gray_looks(frames[:, :, channel], looks)
        if zero is None
        else _echo_looks(frames[:, :, channel], looks, zero)
        for channel, zero in enumerate(zeros)
    ]
    return torch.stack(changed, dim=2)


def _gray_looks(
    frames: Float[Tensor, "batch frames rows columns"], looks: Float[Tensor, "batch looks=5"]
) -> Float[Tensor, "batch frames rows columns"]:
    gain, contrast, gamma, noise, blur = looks[:, :, None, None, None].unbind(1)
    if bool((blur > 0).any()):
        padded = functional.pad(frames, (1, 1, 1, 1), mode="replicate")
        mean = functional.avg_pool2d(padded, 3, stride=1)
        frames = frames + blur * (mean - frames)
    frames = (contrast * (frames - MIDDLE_GRAY) + MIDDLE_GRAY + gain).clamp(0, 1)
    frames = torch.where(frames > 0, frames.clamp(min=1e-6) ** gamma, 0)
    return _with_noise(frames, noise)


def _echo_looks(
    frames: Float[Tensor, "batch frames rows columns"],
    looks: Float[Tensor, "batch looks=5"],
    zero: float,
) -> Float[Tensor, "batch frames rows columns"]:
    gain, _, _, noise, _ = looks[:, :, None, None, None].unbind(1)
    return _with_noise((zero + (frames - zero) * (1 + gain)).clamp(0, 1), noise)


def _with_noise(frames: Tensor, noise: Tensor) -> Tensor:
    if not bool((noise > 0).any()):
        return frames
    return (frames + noise * torch.randn_like(frames)).clamp(0, 1)
