"""Blood: random cells in the lumens of vessels near the image, flowing along them."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int64

from sonosweep.imaging import PixelGrid
from sonosweep.simulate.beam import Beam
from sonosweep.simulate.body import Body
from sonosweep.simulate.deformation import STILL, Deformation
from sonosweep.simulate.point_spread import point_spread, slice_width_mm
from sonosweep.simulate.tissue_motion import body_to_plane

CELLS_PER_RESOLUTION_CELL = 2.0
SLICE_WIDTHS = 1.4  # to either side of the plane; an echo has fallen to 2 % there
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


def blood_per_mm3(beam: Beam) -> float:
    """Return how many cells to draw: as many per resolution cell of any beam, about two."""
    cell = beam.axial_fwhm_mm * beam.lateral_fwhm_mm * beam.elevation_waist_mm
    return CELLS_PER_RESOLUTION_CELL / cell


def draw_blood(
    body: Body,
    plane_to_body: Float[np.ndarray, "4 4"],
    grid: PixelGrid,
    beam: Beam,
    generator: np.random.Generator,
    deformation: Deformation = STILL,
    speed_factors: Mapping[str, float] | None = None,
    around_s: float = 0.0,
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
        around_s: Cells that flow by within this time before or after now are drawn too.
    """
    if not body.vessels:
        return Blood(np.zeros((0, 3)), np.zeros((0, 3)))
    affine = body_to_plane(plane_to_body, deformation)
    tubes = _tubes(body, speed_factors or {})
    near = _near(tubes, affine, grid, beam, around_s)
    places, velocities = _cells(tubes, near, beam, generator)
    places = places @ affine[:3, :3].T + affine[:3, 3]
    return Blood(push_aside(places, deformation), velocities @ affine[:3, :3].T)


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
    level_db: float, depths_mm: Float[np.ndarray, " cells"], grid: PixelGrid, beam: Beam
) -> Float[np.ndarray, " cells"]:
    """Return amplitudes of cells of blood such that the mean power of their echoes is a level."""
    gain = np.interp(depths_mm, grid.axial_mm, point_spread(grid, beam).row_gain)
    return gain * 10 ** (level_db / 20) / np.sqrt(blood_per_mm3(beam))


@dataclass(frozen=True, eq=False)
class _Tubes:
    """Straight pieces of all vessels, in body coordinates.

    Attributes:
        start_mm: Of each piece.
        step_mm: From its start to its end.
        radius_mm: Of its lumen.
        speed_mm_per_s: Mean over its cross-section.
    """

    start_mm: Float[np.ndarray, "pieces xyz=3"]
    step_mm: Float[np.ndarray, "pieces xyz=3"]
    radius_mm: Float[np.ndarray, " pieces"]
    speed_mm_per_s: Float[np.ndarray, " pieces"]


def _tubes(body: Body, speed_factors: Mapping[str, float]) -> _Tubes:
    lines = [vessel.centerline_mm for vessel in body.vessels]
    speeds = [
        np.full(len(line) - 1, vessel.mean_speed_mm_per_s * speed_factors.get(vessel.kind, 1.0))
        for vessel, line in zip(body.vessels, lines, strict=True)
    ]
    return _Tubes(
        np.concatenate([line[:-1] for line in lines]),
        np.concatenate([line[1:] - line[:-1] for line in lines]),
        np.concatenate([vessel.radius_mm[:-1] for vessel in body.vessels]),
        np.concatenate(speeds),
    )


def _cells(
    tubes: _Tubes,
    near: Int64[np.ndarray, " near"],
    beam: Beam,
    generator: np.random.Generator,
) -> tuple[Float[np.ndarray, "cells xyz=3"], Float[np.ndarray, "cells xyz=3"]]:
    """Return places and velocities of random cells in these pieces, in body coordinates."""
    steps, radii = tubes.step_mm[near], tubes.radius_mm[near]
    lengths = np.linalg.norm(steps, axis=1)
    counts = generator.poisson(blood_per_mm3(beam) * np.pi * radii**2 * lengths)
    along, turn, share = generator.random((3, counts.sum()))
    outward, angle = np.sqrt(share), 2 * np.pi * turn
    ahead = steps / np.maximum(lengths, 1e-9)[:, np.newaxis]
    first, second = _upright(ahead)
    owner = np.repeat(np.arange(len(counts)), counts)
    reach = (radii[owner] * outward)[:, np.newaxis]
    places = tubes.start_mm[near][owner] + along[:, np.newaxis] * steps[owner]
    places += reach * np.cos(angle)[:, np.newaxis] * first[owner]
    places += reach * np.sin(angle)[:, np.newaxis] * second[owner]
    speed = 2 * tubes.speed_mm_per_s[near][owner] * (1 - share)
    return places, speed[:, np.newaxis] * ahead[owner]


def _near(
    tubes: _Tubes,
    affine: Float[np.ndarray, "4 4"],
    grid: PixelGrid,
    beam: Beam,
    around_s: float,
) -> Int64[np.ndarray, " near"]:
    """Return which pieces hold blood that is in the slice that is imaged, or soon is or was."""
    first = tubes.start_mm @ affine[:3, :3].T + affine[:3, 3]
    last = first + tubes.step_mm @ affine[:3, :3].T
    low, high = np.minimum(first, last), np.maximum(first, last)
    # In the middle of a vessel blood flows twice as fast as on average.
    reach = tubes.radius_mm + 2 * np.abs(tubes.speed_mm_per_s) * around_s
    thick = SLICE_WIDTHS * slice_width_mm(beam, np.maximum(low[:, 1], 0.0)) + reach
    lateral, axial, margin = grid.lateral_mm, grid.axial_mm, reach + MARGIN_MM
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
