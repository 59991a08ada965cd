"""Motion of a frame from the motion of its patches, as a robust weighted plane fit.

A point at (x, y) of a frame that turns by small (pitch, yaw, roll) about the middle of the
image moves by

- ``lateral - roll * y``,
- ``axial + roll * x``,
- ``elevational + pitch * y - yaw * x``,

with x and y counted from there: the cross product of the turn and the point. The in-plane
and the out-of-plane numbers are therefore two separate linear fits of three each.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from sonosweep.estimators.decorrelation_curve import (
    DecorrelationCurve,
    correlation_at,
    distance_at,
    slope_at,
)

ROBUST_ROUNDS = 6
"""Reweightings; the weights have settled by then."""

OUTLIER = 2.5
"""Standard deviations at which the weight of a residual has halved (Cauchy)."""

INTERPOLATION = 0.01
"""Error of the height of a correlation summit that falls between pixels."""

SHARED_ERROR = 1.2
"""By how much standard deviations would be too small if neighboring patches, and pairs with
a frame in common, erred independently; measured on simulated speckle."""

LEAST_PATCHES = 6
"""Twice the unknowns of a fit: with fewer, no residual shows an outlier."""


@dataclass(frozen=True, eq=False)
class PlaneFit:
    """Three numbers and how well they are known.

    Attributes:
        value: The numbers, mm and rad.
        information: Inverse of their covariance; zero if nothing could be measured.
    """

    value: Float[np.ndarray, "unknowns=3"]
    information: Float[np.ndarray, "unknowns=3 unknowns=3"]


NOTHING = PlaneFit(np.zeros(3), np.zeros((3, 3)))


def fit_in_plane(
    moved_mm: Float[np.ndarray, "patches xy=2"],
    std_mm: Float[np.ndarray, "patches xy=2"],
    from_middle_mm: Float[np.ndarray, "patches xy=2"],
    redundancy: float,
) -> PlaneFit:
    """Return (lateral, axial, roll) of a rigid motion.

    Args:
        moved_mm: By how much each patch moved; NaN where that is not known.
        std_mm: Standard deviation of that.
        from_middle_mm: Center of each patch from the middle of the image.
        redundancy: How many times over overlapping patches use each pixel.
    """
    x, y = from_middle_mm.T
    zero, one = np.zeros_like(x), np.ones_like(x)
    design = np.concatenate((np.stack((one, zero, -y), axis=-1), np.stack((zero, one, x), axis=-1)))
    target = moved_mm.T.ravel()
    std = std_mm.T.ravel()
    usable = np.isfinite(target) & np.isfinite(std)
    if usable.sum() < 2 * LEAST_PATCHES:
        return NOTHING
    design, target, std = design[usable], target[usable], std[usable]
    lateral = design[:, 0] == 1
    value = np.array([np.median(target[lateral]), np.median(target[~lateral]), 0.0])
    for _ in range(ROBUST_ROUNDS):
        value, information = _reweighted(design, target, std, value, redundancy)
    return PlaneFit(value, information)


def fit_out_of_plane(
    correlation: Float[np.ndarray, " patches"],
    speckles: float,
    curve: DecorrelationCurve,
    width_mm: Float[np.ndarray, " patches"],
    from_middle_mm: Float[np.ndarray, "patches xy=2"],
    redundancy: float,
) -> PlaneFit:
    """Return (elevational, pitch, yaw) with the middle of the image moving forward.

    Correlation tells the size of a distance, not its sign. All patches are taken to move
    forward, except those that the fit itself puts behind the first frame: a probe that
    tilts about a line within the image.

    Args:
        correlation: Of each patch with its like in the other frame; NaN if not known.
        speckles: How many independent speckles a patch holds.
        curve: What tells distance from correlation.
        width_mm: Width of the curve that holds for each patch; NaN if not known.
        from_middle_mm: Center of each patch from the middle of the image.
        redundancy: How many times over overlapping patches use each pixel.
    """
    usable = np.isfinite(correlation) & np.isfinite(width_mm)
    if usable.sum() < LEAST_PATCHES:
        return NOTHING
    x, y = from_middle_mm[usable].T
    width = width_mm[usable]
    design = np.stack((np.ones_like(x), y, -x), axis=-1)
    distance = distance_at(curve, correlation[usable], width)
    # Below this distance the fall of the correlation is lost in its own scatter.
    floor = distance_at(curve, np.full_like(width, curve.peak * (1 - INTERPOLATION)), width)
    value = np.array([np.median(distance), 0.0, 0.0])
    for _ in range(ROBUST_ROUNDS):
        fitted = design @ value
        size = np.clip(np.abs(fitted), floor, distance_at(curve, np.zeros_like(width), width))
        # Weights follow the fit, not the measurement, or low correlations would count less
        # for being low.
        scatter = (1 - correlation_at(curve, size, width) ** 2) / math.sqrt(speckles)
        std = np.hypot(scatter, INTERPOLATION) / slope_at(curve, size, width)
        target = np.where(fitted < 0, -distance, distance)
        value, information = _reweighted(design, target, std, value, redundancy)
    return PlaneFit(value if value[0] >= 0 else -value, information)


def _reweighted(
    design: np.ndarray, target: np.ndarray, std: np.ndarray, value: np.ndarray, redundancy: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return one more round of the fit, and its information."""
    residual = (target - design @ value) / std
    # Real patches scatter more than speckle theory allows: find by how much.
    spread = max(1.0, 1.4826 * float(np.median(np.abs(residual))))
    weight = 1 / (1 + (residual / (OUTLIER * spread)) ** 2) / std**2
    weighted = design * weight[:, None]
    normal = weighted.T @ design
    # A trace of the identity: patches in one line do not tell a turn about it.
    normal += 1e-12 * np.trace(normal) * np.eye(3)
    value = np.linalg.solve(normal, weighted.T @ target)
    return value, normal / (spread**2 * redundancy * SHARED_ERROR**2)
