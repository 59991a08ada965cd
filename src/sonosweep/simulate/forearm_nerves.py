"""Median and ulnar nerve: courses between the muscles and bundles within."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from sonosweep.simulate.body import Vessel
from sonosweep.simulate.forearm_paths import Points, path_through, settle
from sonosweep.simulate.forearm_shape import ARM_LENGTH_MM, ArmShape
from sonosweep.simulate.smooth_noise import draw_noise

STEP_MM = 1.0  # between points
ULNAR_GAP_MM = 1.6  # from the artery beside it
BUNDLE_DB, NERVE_DB = -11.0, -1.0  # of bundles, and of what is between them


@dataclass(frozen=True, eq=False)
class Nerve:
    """A nerve in arm coordinates (see :mod:`sonosweep.simulate.forearm_shape`).

    Attributes:
        along_mm: Where its cross-sections are, from the wrist.
        ellipses: Across and y of the middle, half width, half height, turn of the ellipse
            in the plane across the arm (rad), and of the bundles within (rad), at each.
        fascicles: Middle (aside, down) and radius of each bundle, as shares of the ellipse.
    """

    along_mm: Float[np.ndarray, " points"]
    ellipses: Float[np.ndarray, "points 6"]
    fascicles: Float[np.ndarray, "bundles 3"]

    def at(
        self, along_mm: Float[np.ndarray, " slices"], mirror: float
    ) -> Float[np.ndarray, "slices 6"]:
        """Return the ellipses at other places, as x = mirror * across shows them."""
        columns = [np.interp(along_mm, self.along_mm, column) for column in self.ellipses.T]
        return np.column_stack(columns) * np.array([mirror, 1, 1, 1, mirror, mirror])


def draw_nerves(
    generator: np.random.Generator,
    arm: ArmShape,
    vessels: tuple[Vessel, ...],
) -> tuple[Nerve, ...]:
    """Return the nerves of a new arm, beside its vessels.

    Args:
        generator: Draws them.
        arm: The arm that they are in.
        vessels: In arm coordinates.
    """
    along_mm = np.arange(-20.0, ARM_LENGTH_MM + 20, STEP_MM)
    arteries = [vessel for vessel in vessels if vessel.kind == "artery"]
    aside = generator.normal(0, 0.03, 3)
    # It lies beneath the finger flexor and crosses over the arteries at the elbow.
    median = (
        (-20.0, 0.05, 1.2),
        (60.0, aside[0], 6.0),
        (140.0, aside[1], 9.5),
        (185.0, aside[2], 3.0),
        (270.0, aside[2] - 0.1, 3.0),
    )
    ulnar = next(v for v in vessels if v.name == "ulnar artery").centerline_mm[::-1]
    beside = np.stack([np.interp(along_mm, ulnar[:, 2], ulnar[:, k]) for k in (0, 1)], axis=1)
    size = generator.uniform(0.85, 1.15)
    apart = 1.6 + size * 1.8 + ULNAR_GAP_MM + 0.06 * np.maximum(along_mm - 120, 0)
    paths = (
        path_through(arm, along_mm, np.array(median)),
        np.column_stack((beside[:, 0] - apart, beside[:, 1] + 0.5, along_mm)),
    )
    sizes = (generator.uniform(2.2, 3.0), 1.8 * size)
    return tuple(
        _draw_nerve(generator, arm, path, half, arteries)
        for path, half in zip(paths, sizes, strict=True)
    )


def _draw_nerve(
    generator: np.random.Generator,
    arm: ArmShape,
    path: Points,
    half_width_mm: float,
    arteries: list[Vessel],
) -> Nerve:
    along = path[:, 2]
    path = path.copy()
    path[:, 0] += 1.0 * draw_noise(generator, 30.0)(along)
    path[:, 1] += 0.5 * draw_noise(generator, 30.0)(along)
    reach = np.full(len(along), half_width_mm)
    path = settle(arm, path, reach, arteries)
    wide = half_width_mm * np.exp(0.08 * draw_noise(generator, 30.0)(along))
    turn = 0.25 * draw_noise(generator, 40.0)(along) + generator.normal(0, 0.2)
    twist = 0.5 * draw_noise(generator, 30.0)(along)
    high = wide * generator.uniform(0.55, 0.75)
    ellipses = np.column_stack((path[:, 0], path[:, 1], wide, high, turn, twist))
    return Nerve(along, ellipses, _draw_fascicles(generator))


def _draw_fascicles(generator: np.random.Generator) -> Float[np.ndarray, "bundles 3"]:
    """Return bundles in a ring around a few in the middle, unequal."""
    angles = 2 * np.pi * np.arange(7) / 7 + generator.uniform(0, 6.3)
    ring = np.stack((0.66 * np.cos(angles), 0.66 * np.sin(angles)), axis=1)
    places = np.concatenate((ring, [[-0.18, 0.05], [0.2, -0.05]]))
    places += generator.normal(0, 0.03, places.shape)
    return np.column_stack((places, generator.uniform(0.16, 0.24, len(places))))
