"""How well the steps of an estimated trajectory rise and fall with the true ones."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sonosweep.errors import ScanError
from sonosweep.geometry import MOTION_NAMES, motion_from_step, steps_from_poses

STANDS_STILL = 1e-9  # mm or rad: a deviation of steps below this is round-off


def step_correlation(
    estimated: Float[Tensor, "estimated_frames 4 4"],
    true: Float[Tensor, "frames 4 4"],
    center_mm: Float[Tensor, "xyz=3"],
    tracked: Bool[Tensor, " flags"] | None = None,
) -> dict[str, float | None]:
    """Return Pearson's correlation of each number of the steps: lateral ... roll.

    The mean of a number over the sweep does not count, so an estimate that gives every step
    the same motion has no correlation: ``None``.

    Args:
        estimated: ``image_to_reference`` of each frame.
        true: The same from the tracker.
        center_mm: The point of the image whose translation is taken, usually the centre of
            the frame: about a corner, a turn looks like a translation.
        tracked: Which frames have a true pose; steps into and out of the others are left out.

    Raises:
        ScanError: If the counts differ, or fewer than two steps are left.
    """
    if len(estimated) != len(true):
        raise ScanError(f"{len(estimated)} estimated poses but {len(true)} true ones")
    keep = torch.ones(len(true), dtype=torch.bool) if tracked is None else tracked
    both = keep[1:] & keep[:-1]
    if int(both.sum()) < 2:
        raise ScanError(f"a correlation of steps needs 2 of them, got {int(both.sum())}")
    a, b = (
        motion_from_step(steps_from_poses(_about(poses.double(), center_mm.double()))[both])
        for poses in (estimated, true)
    )
    return {name: _pearson(a[:, k], b[:, k]) for k, name in enumerate(MOTION_NAMES)}


def _about(image_to_reference: Tensor, center_mm: Tensor) -> Tensor:
    """Return poses of coordinates whose origin is the centre."""
    center_to_image = torch.eye(4, dtype=torch.float64)
    center_to_image[:3, 3] = center_mm
    return image_to_reference @ center_to_image


def _pearson(a: Tensor, b: Tensor) -> float | None:
    a, b = a - a.mean(), b - b.mean()
    if float(torch.minimum(a.square().mean(), b.square().mean())) < STANDS_STILL**2:
        return None
    return float((a @ b) / (a.norm() * b.norm()))
