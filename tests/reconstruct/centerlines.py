"""How far vessels in a volume are from their true center lines."""

import numpy as np

from sonosweep.scan import Volume
from sonosweep.simulate import Vessel

WINDOW_MM = 3.0
"""Around the true place in which a vessel is looked for: much more than a vessel's radius, so
that the window does not pull what is found to the truth."""


def centerline_errors_mm(
    volume: Volume, vessel: Vessel, others: tuple[Vessel, ...] = ()
) -> np.ndarray:
    """Return the distance of the vessel's bright cross-section from its center line, in mm.

    Measured in every slice of the volume across z that the vessel crosses, where the whole
    window was seen and no other vessel comes near: between the true center and the centroid
    of what is brighter than half, above the background. NaN where nothing is.

    Args:
        volume: Along the axes of the body.
        vessel: Whose center line goes along z.
        others: All vessels, which may include this one.
    """
    grid = volume.grid
    np.testing.assert_array_equal(grid.direction, np.eye(3))
    x, y, z = (
        origin + spacing * np.arange(size)
        for origin, spacing, size in zip(grid.origin_mm, grid.spacing_mm, grid.size, strict=True)
    )
    errors = []
    for k in range(grid.size[2]):
        center = crossing_mm(vessel, z[k])
        if center is None or any(_near(center, crossing_mm(o, z[k])) for o in others):
            continue
        window = np.hypot(x - center[0], y[:, None] - center[1]) < WINDOW_MM
        inside = x[0] < center[0] - WINDOW_MM and center[0] + WINDOW_MM < x[-1]
        inside &= y[0] < center[1] - WINDOW_MM and center[1] + WINDOW_MM < y[-1]
        if not inside or volume.coverage is None or volume.coverage[k][window].min() == 0:
            continue
        values = np.asarray(volume.voxels[k], np.float64)
        dark, bright = np.median(values[window]), values[window].max()
        weight = np.where(window, np.clip(values - (dark + bright) / 2, 0, None), 0)
        if bright <= dark:
            errors.append(np.nan)
            continue
        found = np.array([(weight * x).sum(), (weight * y[:, None]).sum()]) / weight.sum()
        errors.append(float(np.hypot(*(found - center))))
    return np.array(errors)


def crossing_mm(vessel: Vessel, z_mm: float) -> np.ndarray | None:
    """Return where (x, y) a vessel crosses a slice; ``None`` if it does not."""
    line = vessel.centerline_mm
    if not line[0, 2] <= z_mm <= line[-1, 2]:
        return None
    return np.array([np.interp(z_mm, line[:, 2], line[:, axis]) for axis in (0, 1)])


def _near(center: np.ndarray, other: np.ndarray | None) -> bool:
    if other is None:
        return False
    apart = float(np.hypot(*(center - other)))
    return 0 < apart < WINDOW_MM + 2.0
