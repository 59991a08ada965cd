"""Blood: random cells in the lumens of vessels near the image, flowing along them."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from sonosweep.imaging import PixelGrid
from sonosweep.simulate.beam import Beam
from sonosweep.simulate.body import Body, Vessel
from sonosweep.simulate.deformation import STILL, Deformation
from sonosweep.simulate.point_spread import point_spread, slice_width_mm
from sonosweep.simulate.tissue_motion import body_to_plane

BLOOD_PER_MM3 = 60.0
SLICE_WIDTHS = 1.5  # to either side of the plane; an echo has fallen to exp(-4.5) there
FASTEST_EDDY_MM_PER_S = 50.0
MARGIN_MM = 1.0  # beside the image, wider than a beam


@dataclass(frozen=True, eq=False)
class Blood:
    """Cells in plane coordinates.

    Attributes:
        places_mm: Lateral, axial and elevational.
        velocities_mm_per_s: Along the same axes.
    """

    places_mm: Float[np.ndarray, "cells xyz=3"]
    velocities_mm_per_s: Float[np.ndarray, "cells xyz=3"]


def draw_blood(
    body: Body,
    plane_to_body: Float[np.ndarray, "4 4"],
    grid: PixelGrid,
    beam: Beam,
    generator: np.random.Generator,
    deformation: Deformation = STILL,
    speed_factors: Mapping[str, float] | None = None,
) -> Blood:
    """Return the cells near an image plane; their speed falls parabolically to the wall.

    Args:
        body: Its vessels say where blood is and how fast it flows.
        plane_to_body: Of the image.
        grid: Vessels beside and below it are left out.
        beam: Says how thick the slice is.
        generator: Draws the cells: others in each frame, as blood flows on.
        deformation: How tissue is displaced now.
        speed_factors: By kind of vessel, how much faster than on average blood flows now.
    """
    affine = body_to_plane(plane_to_body, deformation)
    places, velocities = [np.zeros((0, 3))], [np.zeros((0, 3))]
    for vessel in body.vessels:
        place, velocity = _cells(vessel, affine, grid, beam, generator)
        places.append(place @ affine[:3, :3].T + affine[:3, 3])
        factor = (speed_factors or {}).get(vessel.kind, 1.0)
        velocities.append(factor * velocity @ affine[:3, :3].T)
    return Blood(push_aside(np.concatenate(places), deformation), np.concatenate(velocities))


def disturbed(
    velocities_mm_per_s: Float[np.ndarray, "cells xyz=3"],
    deviation: float,
    generator: np.random.Generator,
) -> Float[np.ndarray, "cells xyz=3"]:
    """Return velocities with a random part, of this deviation in parts of each cell's speed.

    It stays below 50 mm/s, so that no cell leaves its vessel within an ensemble.
    """
    speeds = deviation * np.linalg.norm(velocities_mm_per_s, axis=1, keepdims=True)
    limited = speeds / np.hypot(1, speeds / FASTEST_EDDY_MM_PER_S)
    return velocities_mm_per_s + limited * generator.standard_normal(velocities_mm_per_s.shape)


def push_aside(
    places_mm: Float[np.ndarray, "points xyz=3"], deformation: Deformation
) -> Float[np.ndarray, "points xyz=3"]:
    """Return where points of the plane's surroundings are when arteries swell."""
    moved = places_mm.copy()
    for artery in deformation.arteries:
        away = places_mm[:, :2] - artery.center_mm
        radius = artery.radius_mm
        share = artery.dilation_mm * radius / np.maximum((away**2).sum(axis=1), radius**2)
        moved[:, :2] += share[:, np.newaxis] * away
    return moved


def amplitudes_for_level(
    level_db: float,
    depths_mm: Float[np.ndarray, " points"],
    grid: PixelGrid,
    beam: Beam,
    density_per_mm3: float = BLOOD_PER_MM3,
) -> Float[np.ndarray, " points"]:
    """Return amplitudes of points so dense that the mean power of their echoes is a level."""
    gain = np.interp(depths_mm, grid.axial_mm, point_spread(grid, beam).row_gain)
    return gain * 10 ** (level_db / 20) / np.sqrt(density_per_mm3)


def _cells(
    vessel: Vessel,
    affine: Float[np.ndarray, "4 4"],
    grid: PixelGrid,
    beam: Beam,
    generator: np.random.Generator,
) -> tuple[Float[np.ndarray, "cells xyz=3"], Float[np.ndarray, "cells xyz=3"]]:
    """Return places and velocities of the cells of one vessel, in body coordinates."""
    seen = vessel.centerline_mm @ affine[:3, :3].T + affine[:3, 3]
    near = _near(seen, vessel.radius_mm, grid, beam)
    steps = np.diff(vessel.centerline_mm, axis=0)[near]
    lengths = np.linalg.norm(steps, axis=1)
    radii = vessel.radius_mm[:-1][near]
    counts = generator.poisson(BLOOD_PER_MM3 * np.pi * radii**2 * lengths)
    along, turn, share = generator.random((3, counts.sum()))
    outward, angle = np.sqrt(share), 2 * np.pi * turn
    ahead = steps / np.maximum(lengths, 1e-9)[:, np.newaxis]
    first, second = _upright(ahead)
    owner = np.repeat(np.arange(len(counts)), counts)
    reach = (radii[owner] * outward)[:, np.newaxis]
    places = vessel.centerline_mm[:-1][near][owner] + along[:, np.newaxis] * steps[owner]
    places += reach * np.cos(angle)[:, np.newaxis] * first[owner]
    places += reach * np.sin(angle)[:, np.newaxis] * second[owner]
    speed = 2 * vessel.mean_speed_mm_per_s * (1 - outward**2)
    return places, speed[:, np.newaxis] * ahead[owner]


def _near(
    line_mm: Float[np.ndarray, "points xyz=3"],
    radius_mm: Float[np.ndarray, " points"],
    grid: PixelGrid,
    beam: Beam,
) -> np.ndarray:
    """Return which steps of a center line come into the slice that is imaged."""
    low = np.minimum(line_mm[:-1], line_mm[1:])
    high = np.maximum(line_mm[:-1], line_mm[1:])
    radius = np.maximum(radius_mm[:-1], radius_mm[1:])
    thick = SLICE_WIDTHS * slice_width_mm(beam, np.maximum(low[:, 1], 0.0)) + radius
    lateral, axial, margin = grid.lateral_mm, grid.axial_mm, radius + MARGIN_MM
    return np.flatnonzero(
        (low[:, 2] < thick)
        & (high[:, 2] > -thick)
        & (low[:, 0] < lateral[-1] + margin)
        & (high[:, 0] > lateral[0] - margin)
        & (low[:, 1] < axial[-1] + margin)
        & (high[:, 1] > axial[0] - margin)
    )


def _upright(
    ahead: Float[np.ndarray, "steps xyz=3"],
) -> tuple[Float[np.ndarray, "steps xyz=3"], Float[np.ndarray, "steps xyz=3"]]:
    """Return two unit vectors upright to each direction and to each other."""
    axis = np.zeros_like(ahead)
    axis[np.arange(len(ahead)), np.abs(ahead).argmin(axis=1)] = 1.0
    first = np.cross(ahead, axis)
    first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-9)
    return first, np.cross(ahead, first)
