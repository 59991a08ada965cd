"""Paths of vessels and nerves through an arm, kept off bones, skin and one another.

Points are in arm coordinates (see :mod:`sonosweep.simulate.forearm_shape`): across, y, along.
"""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float
from scipy import ndimage
from scipy.interpolate import PchipInterpolator
from scipy.spatial import cKDTree

from sonosweep.simulate.body import Vessel
from sonosweep.simulate.forearm_shape import ArmShape

Points = Float[np.ndarray, "points xyz=3"]
Stations = Float[np.ndarray, "stations 3"]

BONE_GAP_MM = 1.0  # between a bone and the lumen of a vessel
WALLS_MM = 0.7  # between two lumens: their walls and what is between them
PUSHES = 12
SMOOTHINGS = (3.0, 3.0, 2.0, 2.0, 1.5, 1.0)  # less and less, points


def path_through(
    arm: ArmShape, along_mm: Float[np.ndarray, " points"], stations: Stations
) -> Points:
    """Return a smooth path.

    Args:
        arm: The arm that it is in.
        along_mm: Where its points are, from the wrist.
        stations: What it passes, in ascending order: mm from the wrist, half widths of the
            arm toward the thumb, and mm beneath the deep fascia.
    """
    places, across, depth = stations.T
    x = PchipInterpolator(places, across)(along_mm) * arm.half_width_mm(along_mm)
    y = fascia_y(arm, x, along_mm) + PchipInterpolator(places, depth)(along_mm)
    return np.stack((x, y, along_mm), axis=1)


def fascia_y(
    arm: ArmShape, across_mm: Float[np.ndarray, " points"], along_mm: Float[np.ndarray, " points"]
) -> Float[np.ndarray, " points"]:
    """Return y of the deep fascia, where fat ends."""
    return under_skin_y(arm, across_mm, along_mm, arm.skin_mm + arm.fat_below(across_mm, along_mm))


def under_skin_y(
    arm: ArmShape,
    across_mm: Float[np.ndarray, " points"],
    along_mm: Float[np.ndarray, " points"],
    depth_mm: Float[np.ndarray, " points"],
) -> Float[np.ndarray, " points"]:
    """Return y at a distance beneath the skin."""
    step = 0.5
    slope = arm.skin_y(across_mm + step, along_mm) - arm.skin_y(across_mm - step, along_mm)
    steepness = np.minimum(np.hypot(1, slope / (2 * step)), 2.5)
    return arm.skin_y(across_mm, along_mm) + depth_mm * steepness


def keep_inside(arm: ArmShape, points: Points, radius_mm: Float[np.ndarray, " points"]) -> Points:
    """Return the points moved across the arm, off the bones and off the skin."""
    points = points.copy()
    for distance, wall in (
        (arm.bone_distance, radius_mm + BONE_GAP_MM),
        (arm.skin_distance, radius_mm + arm.skin_mm + 0.2),
    ):
        for _ in range(PUSHES):
            missing = wall - distance(*points.T)
            near = missing > 0
            if not near.any():
                break
            points[near, :2] += missing[near, None] * _uphill(distance, points[near])
    return points


def keep_apart(
    points: Points, radius_mm: Float[np.ndarray, " points"], others: Sequence[Vessel]
) -> Points:
    """Return the points moved across the arm until no lumen meets that of another vessel."""
    points = points.copy()
    for vessel in others:
        tree = cKDTree(vessel.centerline_mm)
        for _ in range(3):
            nearest = tree.query(points)[1]
            away = points[:, :2] - vessel.centerline_mm[nearest, :2]
            distance = np.hypot(*away.T) + 1e-6
            wanted = radius_mm + vessel.radius_mm[nearest] + WALLS_MM
            # Neither end of the other vessel pushes what goes on beyond it.
            level = np.abs(points[:, 2] - vessel.centerline_mm[nearest, 2]) < wanted
            push = np.where(level, np.maximum(wanted - distance, 0), 0)
            points[:, :2] += away * (push / distance)[:, None]
    return points


def settle(
    arm: ArmShape, points: Points, radius_mm: Float[np.ndarray, " points"], others: Sequence[Vessel]
) -> Points:
    """Return a smooth path off bones, skin and other vessels; its points are 1 mm apart.

    Pushing alone leaves kinks where a path is pushed to the other side of an obstacle.
    """
    for smoothing in SMOOTHINGS:
        points = keep_inside(arm, keep_apart(points, radius_mm, others), radius_mm)
        inner = ndimage.gaussian_filter1d(points, smoothing, axis=0, mode="nearest")
        points = np.concatenate((points[:1], inner[1:-1], points[-1:]))
    return keep_inside(arm, keep_apart(points, radius_mm, others), radius_mm)


def clearance(
    points: Points, radius_mm: Float[np.ndarray, " points"], others: Sequence[Vessel]
) -> float:
    """Return the smallest distance between lumens; negative if one meets another."""
    free = np.inf
    for vessel in others:
        distance, nearest = cKDTree(vessel.centerline_mm).query(points)
        free = min(free, float((distance - radius_mm - vessel.radius_mm[nearest]).min()))
    return free


def _uphill(
    distance: Callable[..., Float[np.ndarray, "..."]], points: Points
) -> Float[np.ndarray, "points 2"]:
    """Return the direction across the arm in which a distance grows."""
    step = np.array([[0.2, 0, 0], [-0.2, 0, 0], [0, 0.2, 0], [0, -0.2, 0]])
    right, left, down, up = distance(*(points + step[:, None]).transpose(2, 0, 1))
    slope = np.stack((right - left, down - up), axis=1)
    return slope / (np.linalg.norm(slope, axis=1, keepdims=True) + 1e-9)
