"""Where the muscles of a forearm are in each slice, and how they taper to tendons.

Compartments are cells of a weighted diagram of ellipses: a place belongs to the muscle
whose ellipse is the nearest, and septa are the borders. Ellipses move and change smoothly
along the arm, so a muscle that ends gives way to its neighbors.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32

from sonosweep.simulate.forearm_shape import ArmShape
from sonosweep.simulate.smooth_noise import draw_noise

# Columns of the table of muscles, in body coordinates: q = A x^2 + B x y + C y^2 around the
# middle is 1 on the ellipse.
X, Y, A, B, C, WEIGHT, TENDON, FILL, TEXTURE_X, TEXTURE_Y, LEVEL_DB, GAIN_DB, COS, SIN = range(14)
COLUMNS = 14
_GONE = 5.0  # how much farther off a muscle counts where it is absent


class Muscle(NamedTuple):
    """A muscle in the middle of the forearm.

    Attributes:
        across: Of its middle, in half widths of the arm, toward the thumb.
        depth: Of its middle, in thicknesses of the arm beneath its fascia.
        half_width_mm: Of its ellipse.
        half_height_mm: Of its ellipse.
        tendon_mm: How far from the wrist its tendon reaches.
        begins_mm: Where along the arm it begins.
        ends_mm: Where along the arm it ends.
        share: Of people who have it as one muscle of its own.
    """

    across: float
    depth: float
    half_width_mm: float
    half_height_mm: float
    tendon_mm: float
    begins_mm: float = -100.0
    ends_mm: float = 400.0
    share: float = 1.0


MUSCLES = {
    "flexor carpi radialis": Muscle(0.15, 0.13, 9.0, 5.0, 110.0),
    "palmaris longus": Muscle(-0.12, 0.08, 6.0, 3.5, 130.0, share=0.85),
    "flexor digitorum superficialis": Muscle(-0.10, 0.27, 13.0, 5.0, 60.0),
    "flexor carpi ulnaris": Muscle(-0.50, 0.22, 9.0, 6.0, 40.0),
    "brachioradialis": Muscle(0.58, 0.26, 8.0, 8.0, 110.0),
    "pronator teres": Muscle(0.34, 0.17, 8.0, 6.0, -99.0, begins_mm=140.0, share=0.8),
    "flexor pollicis longus": Muscle(0.24, 0.37, 8.0, 5.0, 35.0),
    "flexor digitorum profundus": Muscle(-0.28, 0.41, 11.0, 6.0, 45.0),
    "pronator quadratus": Muscle(0.0, 0.45, 13.0, 3.0, -99.0, ends_mm=45.0, share=0.8),
    "extensor digitorum": Muscle(0.02, 0.82, 13.0, 6.0, 70.0),
    "extensor carpi ulnaris": Muscle(-0.46, 0.80, 9.0, 6.0, 60.0),
    "extensores carpi radiales": Muscle(0.56, 0.64, 9.0, 7.0, 100.0),
    "abductor pollicis longus": Muscle(0.10, 0.66, 10.0, 4.0, 50.0, share=0.7),
}


def muscle_table(
    generator: np.random.Generator,
    shape: ArmShape,
    along_mm: Float[np.ndarray, " slices"],
    mirror: float,
) -> Float32[np.ndarray, "slices muscles columns=14"]:
    """Return the muscles of a new arm in each slice.

    Args:
        generator: Draws which muscles there are, their places, sizes and textures.
        shape: The arm that they are in.
        along_mm: Of the slices, from the wrist.
        mirror: -1 turns the arm into the other one: x is mirror * across.
    """
    rows = []
    for muscle in MUSCLES.values():
        present = generator.random() < muscle.share
        row = _one_muscle(generator, muscle, shape, along_mm)
        if present:
            rows.append(row)
    table = np.stack(rows, axis=1)
    table[..., (X, B, SIN)] *= mirror
    return table.astype(np.float32)


def _one_muscle(
    generator: np.random.Generator,
    muscle: Muscle,
    shape: ArmShape,
    along: Float[np.ndarray, " slices"],
) -> Float[np.ndarray, "slices columns=14"]:
    row = np.empty((len(along), COLUMNS))
    wander = [draw_noise(generator, 40.0)(along) for _ in range(4)]
    across, depth = muscle.across + generator.normal(0, 0.03), muscle.depth
    layer = shape.skin_mm + shape.fat_mm
    inside = shape.thickness_mm(along) - 2 * layer
    row[:, X] = across * shape.half_width_mm(along) + 0.8 * wander[0]
    top = shape.skin_y(np.zeros_like(along), along) + layer
    row[:, Y] = top + (depth + generator.normal(0, 0.012)) * inside + 0.5 * wander[1]

    size = shape.half_width_mm(along) / 43 * np.exp(generator.normal(0, 0.08))
    wide = size * muscle.half_width_mm * np.exp(0.06 * wander[2])
    high = size * muscle.half_height_mm * np.exp(0.06 * wander[3])
    turn = generator.normal(0, np.deg2rad(8)) + np.deg2rad(4) * wander[0]
    cos, sin = np.cos(turn), np.sin(turn)
    row[:, A] = (cos / wide) ** 2 + (sin / high) ** 2
    row[:, B] = 2 * cos * sin * (1 / wide**2 - 1 / high**2)
    row[:, C] = (sin / wide) ** 2 + (cos / high) ** 2
    row[:, COS], row[:, SIN] = cos, sin

    here = _step(along, muscle.begins_mm, 50.0) * _step(-along, -muscle.ends_mm, 40.0)
    row[:, WEIGHT] = generator.normal(0, 0.15) - _GONE * (1 - here)
    _taper(generator, row, muscle, along)
    _texture(generator, row, along)
    return row


def _taper(
    generator: np.random.Generator,
    row: Float[np.ndarray, "slices columns=14"],
    muscle: Muscle,
    along: Float[np.ndarray, " slices"],
) -> None:
    """Fill how much of a muscle is tendon, and how much of its compartment it fills."""
    reach = muscle.tendon_mm * generator.uniform(0.8, 1.2)
    toward_wrist = _step(-along, -reach, 60.0)
    thick = generator.uniform(0.28, 0.40)
    row[:, TENDON] = (thick * toward_wrist) ** 2
    row[:, FILL] = 0.45 + 4.0 * (1 - toward_wrist)


def _texture(
    generator: np.random.Generator,
    row: Float[np.ndarray, "slices columns=14"],
    along: Float[np.ndarray, " slices"],
) -> None:
    """Fill how fibres run: through the middle of the muscle, at an angle to its course."""
    pennation = np.tan(np.deg2rad(generator.uniform(2, 13))) * generator.choice((-1, 1))
    aside = np.tan(np.deg2rad(generator.normal(0, 3)))
    start = generator.uniform(0, 30, 2)
    row[:, TEXTURE_X] = start[0] + aside * along
    row[:, TEXTURE_Y] = start[1] + pennation * along
    row[:, LEVEL_DB] = generator.normal(0, 1.2)
    row[:, GAIN_DB] = generator.uniform(14, 20)


def _step(
    places: Float[np.ndarray, " places"], middle: float, width: float
) -> Float[np.ndarray, " places"]:
    """Return a smooth step from 0 to 1 around ``middle``."""
    share = np.clip((places - middle) / width + 0.5, 0, 1)
    return share * share * (3 - 2 * share)
