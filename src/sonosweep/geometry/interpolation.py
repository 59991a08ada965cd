"""The pose at a time between two tracker samples."""

import torch
from jaxtyping import Float
from torch import Tensor

from sonosweep.errors import ScanError
from sonosweep.geometry.pose import pose_from_parts
from sonosweep.geometry.rotation import rotation_from_vector, vector_from_rotation


def interpolate_poses(
    sample_times_s: Float[Tensor, " samples"],
    a_to_b: Float[Tensor, "*batch samples 4 4"],
    times_s: Float[Tensor, " frames"],
) -> Float[Tensor, "*batch frames 4 4"]:
    """Return the poses at ``times_s``: straight-line positions, great-circle turns (slerp).

    Times before the first and after the last sample take the nearest sample.

    Args:
        sample_times_s: Strictly increasing times of the samples, s.
        a_to_b: Pose of each sample, mm; of several tools seen at these times if there are
            leading axes.
        times_s: Where to interpolate, s.

    Raises:
        ScanError: If there is no sample, or the sample times do not increase.

    References:
        Shoemake, "Animating rotation with quaternion curves", 1985.
    """
    if len(sample_times_s) == 0:
        raise ScanError("no poses to interpolate between")
    if len(sample_times_s) == 1:
        return a_to_b.expand(*a_to_b.shape[:-3], len(times_s), 4, 4).clone()
    if not bool((sample_times_s.diff() > 0).all()):
        raise ScanError("the times of the poses must increase from sample to sample")
    after = torch.searchsorted(sample_times_s.contiguous(), times_s.contiguous())
    after = after.clamp(1, len(sample_times_s) - 1)
    before = after - 1
    start, stop = sample_times_s[before], sample_times_s[after]
    fraction = ((times_s - start) / (stop - start)).clamp(0, 1).to(a_to_b.dtype)[:, None]
    rotation_a, rotation_b = a_to_b[..., before, :3, :3], a_to_b[..., after, :3, :3]
    turn = vector_from_rotation(rotation_a.mT @ rotation_b)
    rotation = rotation_a @ rotation_from_vector(fraction * turn)
    translation = torch.lerp(a_to_b[..., before, :3, 3], a_to_b[..., after, :3, 3], fraction)
    return pose_from_parts(rotation, translation)
