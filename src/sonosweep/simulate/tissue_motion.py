"""Where points of the body are in the imaging plane, and back, under a deformation."""

from typing import no_type_check

import numpy as np
from jaxtyping import Float
from numba import njit

from sonosweep.errors import ScanError
from sonosweep.simulate.deformation import Deformation

PUSH_TOLERANCE_MM = 1e-4


def body_to_plane(
    plane_to_body: Float[np.ndarray, "4 4"], deformation: Deformation
) -> Float[np.ndarray, "4 4"]:
    """Return the affine part of a deformation: shift of the body, pose, strain.

    Raises:
        ScanError: If the pose is not a rigid one.
    """
    pose = np.asarray(plane_to_body, np.float64)
    rotation = pose[:3, :3]
    rigid = np.isfinite(pose).all() and np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
    if not (rigid and np.linalg.det(rotation) > 0):
        raise ScanError(f"the pose of a frame must be a rotation and a shift, got {pose.tolist()}")
    strain = deformation.axial_strain
    stretch = np.array([1 + strain / 2, 1 - strain, 1.0])
    affine = np.eye(4)
    affine[:3, :3] = stretch[:, None] * rotation.T
    affine[:3, 3] = affine[:3, :3] @ (np.asarray(deformation.shift_mm) - pose[:3, 3])
    return affine


def pushes(deformation: Deformation) -> Float[np.ndarray, "arteries 4"]:
    """Return lateral, depth, radius and dilation of the arteries that pulsate."""
    rows = [(*a.center_mm, a.radius_mm, a.dilation_mm) for a in deformation.arteries]
    return np.array([row for row in rows if row[3] != 0], np.float64).reshape(-1, 4)


@njit(cache=True, nogil=True)
@no_type_check
def push(x, y, arteries):
    """Return by how much pulsating arteries move the point (x, y) of the plane."""
    dx, dy = 0.0, 0.0
    for a in range(arteries.shape[0]):
        u, v = x - arteries[a, 0], y - arteries[a, 1]
        radius = arteries[a, 2]
        share = arteries[a, 3] * radius / max(u * u + v * v, radius * radius)
        dx += u * share
        dy += v * share
    return dx, dy


@njit(cache=True, nogil=True)
@no_type_check
def undo_push(x, y, arteries):
    """Return the point that pulsating arteries have moved to (x, y)."""
    x0, y0 = x, y
    if arteries.shape[0] > 0:
        for _ in range(50):
            dx, dy = push(x0, y0, arteries)
            miss = abs(x0 + dx - x) + abs(y0 + dy - y)
            x0, y0 = x - dx, y - dy
            if miss < PUSH_TOLERANCE_MM:
                break
    return x0, y0
