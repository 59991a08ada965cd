"""The rigid pose that best lays one set of points on another."""

import torch
from jaxtyping import Float
from torch import Tensor

from sonosweep.errors import ScanError
from sonosweep.geometry.pose import pose_from_parts
from sonosweep.geometry.rotation import nearest_rotation


def align_points(
    points_a_mm: Float[Tensor, "*batch points xyz=3"],
    points_b_mm: Float[Tensor, "*batch points xyz=3"],
    weights: Float[Tensor, "*batch points"] | None = None,
) -> Float[Tensor, "*batch 4 4"]:
    """Return the ``a_to_b`` with the least sum of squared distances.

    Points on one line leave a turn about it open; some best pose is then returned.

    Args:
        points_a_mm: Points in system a.
        points_b_mm: The same points in system b.
        weights: How much each pair counts, 0 or more; all the same when ``None``.

    Raises:
        ScanError: If there is no point, or no weight.

    References:
        Kabsch, "A solution for the best rotation to relate two sets of vectors", 1976;
        Umeyama, "Least-squares estimation of transformation parameters between two point
        patterns", 1991 (the guard against reflections).
    """
    if weights is None:
        weights = torch.ones_like(points_a_mm[..., 0])
    total = weights.sum(-1)
    if points_a_mm.shape[-2] == 0 or not bool((total > 0).all()):
        raise ScanError("no points to align: give at least one with a weight above 0")
    share = (weights / total[..., None])[..., None]
    mean_a, mean_b = (share * points_a_mm).sum(-2), (share * points_b_mm).sum(-2)
    covariance = (share * (points_b_mm - mean_b[..., None, :])).mT @ (
        points_a_mm - mean_a[..., None, :]
    )
    rotation = nearest_rotation(covariance)
    translation = mean_b - (rotation @ mean_a[..., None])[..., 0]
    return pose_from_parts(rotation, translation)
