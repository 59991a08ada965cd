"""How much a patch is tissue structure rather than speckle, and what that does to distances.

Structure (fibers, walls, layers) stays alike over longer distances than speckle does, in all
directions. What it does in the elevational direction shows nowhere, but what it does in the
lateral direction shows in a single frame: a patch that decorrelates slowly along its rows
does so across frames. Distances are corrected by the measured ratio, damped by the power
``coherence`` of the curve: 0 trusts the curve alone, 1 takes tissue to be the same in both
directions.

References:
    Gee et al., "Sensorless freehand 3D ultrasound in real tissue: speckle decorrelation
    without fully developed speckle", 2006, where this idea comes from; our form differs.
"""

import numpy as np
from jaxtyping import Float

from sonosweep.estimators.decorrelation_curve import DecorrelationCurve, width_at

LAG_PX = 2
"""Columns between a patch and itself: within a speckle, beyond what pixels share."""

STEADIEST = 0.98
"""Correlation at that lag above which it is nothing but noise that makes it less."""

WIDEST_STRETCH = 3.0
"""By how much a distance is corrected at most, either way."""


def fineness(
    correlation_at_lag: Float[np.ndarray, " patches"], column_mm: float
) -> Float[np.ndarray, " patches"]:
    """Return how fast patches decorrelate along their rows, per mm squared.

    Args:
        correlation_at_lag: Of each patch with itself :data:`LAG_PX` columns aside.
        column_mm: Distance between columns.
    """
    clipped = np.clip(correlation_at_lag, 0.02, STEADIEST)
    return -2 * np.log(clipped) / (LAG_PX * column_mm) ** 2


def patch_widths(
    curve: DecorrelationCurve,
    depth_mm: Float[np.ndarray, " patches"],
    fineness_per_mm2: Float[np.ndarray, "*pairs patches"],
    usual_per_mm2: Float[np.ndarray, " patches"],
) -> Float[np.ndarray, "*pairs patches"]:
    """Return the width (mm) of the decorrelation curve that holds for each patch.

    Args:
        curve: Of the probe and preset.
        depth_mm: Of each patch.
        fineness_per_mm2: Of each patch; NaN where it is not known.
        usual_per_mm2: What it is at that depth in the tissue the curve holds for.
    """
    ratio = np.where(np.isfinite(fineness_per_mm2), usual_per_mm2 / fineness_per_mm2, 1.0)
    stretch = ratio ** (curve.coherence / curve.exponent)
    return width_at(curve, depth_mm) * np.clip(stretch, 1 / WIDEST_STRETCH, WIDEST_STRETCH)
