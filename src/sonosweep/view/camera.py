"""Looking at millimetres from an oblique direction, without perspective.

The viewer stands before the first frame: its lateral axis runs to the right, its axial axis
down, and its elevational axis away from the viewer, before the turn.
"""

import math

import numpy as np
from jaxtyping import Float

AZIMUTH_DEG = -50.0
ELEVATION_DEG = 24.0


def view_rotation(
    azimuth_deg: float = AZIMUTH_DEG, elevation_deg: float = ELEVATION_DEG
) -> Float[np.ndarray, "3 3"]:
    """Return the turn from the first frame's axes to the screen's (right, down, away).

    Args:
        azimuth_deg: Turn about the axial axis; negative shows the elevational axis
            running to the right.
        elevation_deg: How far the viewer stands above.
    """
    a, e = math.radians(azimuth_deg), math.radians(elevation_deg)
    about_axial = np.array(
        [[math.cos(a), 0, -math.sin(a)], [0, 1, 0], [math.sin(a), 0, math.cos(a)]]
    )
    about_lateral = np.array(
        [[1, 0, 0], [0, math.cos(e), -math.sin(e)], [0, math.sin(e), math.cos(e)]]
    )
    return about_lateral @ about_axial


def project(
    points_mm: Float[np.ndarray, "*batch xyz=3"], rotation: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "*batch screen=3"]:
    """Return where points fall on the screen: right, down and away, in mm."""
    return points_mm @ rotation.T


def box_corners(
    low_mm: Float[np.ndarray, "xyz=3"], high_mm: Float[np.ndarray, "xyz=3"]
) -> Float[np.ndarray, "2 2 2 xyz=3"]:
    """Return the corners of a box, indexed by 0 (low) or 1 (high) along x, y and z."""
    both = np.stack((low_mm, high_mm))
    index = np.indices((2, 2, 2))
    return np.stack([both[index[axis], axis] for axis in range(3)], axis=-1)
