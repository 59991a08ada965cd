"""The smooth fields, textures and gray levels from which a forearm's voxels are filled."""

import numpy as np
from jaxtyping import Float, Float32

from sonosweep.simulate.anatomy_texture import sheet_table
from sonosweep.simulate.forearm_kernels import (
    BONE,
    BRIGHT,
    FASCIA,
    FIELDS,
    MEMBRANE,
    MIDDLE,
    SKIN,
    WARP_X,
    WARP_Y,
)
from sonosweep.simulate.forearm_shape import ArmShape
from sonosweep.simulate.smooth_noise import SmoothNoise, draw_noise

COARSE_MM = (1.0, 1.0, 5.0)  # grid of the smooth fields along x, y and z
NOISE_MM = (  # features of the warps along x (two) and y (two), and of brightness
    (22.0, 7.0, 7.0),
    (9.0, 3.0, 3.0),
    (22.0, 7.0, 9.0),
    (9.0, 3.0, 4.0),
    (18.0, 5.0, 6.0),
)
CELLS_MM = ((4.0, 0.125, 0.75), (6.0, 0.125, 1.5))  # of the tables, along z, y and x


def coarse_fields(
    generator: np.random.Generator,
    arm: ArmShape,
    across_mm: Float[np.ndarray, " columns"],
    y_mm: Float[np.ndarray, " rows"],
    along_mm: Float[np.ndarray, " slices"],
    mirror: float,
) -> Float32[np.ndarray, "fields slices rows columns"]:
    """Return the fields of :mod:`sonosweep.simulate.forearm_kernels` on a grid of places.

    Args:
        generator: Draws by how much things are not straight.
        arm: The arm.
        across_mm: Places in arm coordinates.
        y_mm: Places in arm coordinates.
        along_mm: Places in arm coordinates.
        mirror: Sign of body x per ``across``.
    """
    noises = [draw_noise(generator, *scale_mm) for scale_mm in NOISE_MM]
    fields = np.empty((FIELDS, along_mm.size, y_mm.size, across_mm.size), np.float32)
    for k in range(along_mm.size):  # one at a time, as all together would need much memory
        _fill_fields(fields[:, k], noises, arm, across_mm, y_mm[:, None], along_mm[k], mirror)
    return fields


def _fill_fields(
    fields: Float32[np.ndarray, "fields rows columns"],
    noises: list[SmoothNoise],
    arm: ArmShape,
    x: Float[np.ndarray, " columns"],
    y: Float[np.ndarray, "rows 1"],
    along: float,
    mirror: float,
) -> None:
    """Fill the fields of one slice."""
    z = np.array([[along]])
    warp_x = 0.8 * noises[0](z, y, x) + 0.25 * noises[1](z, y, x)
    warp_y = 0.7 * noises[2](z, y, x) + 0.2 * noises[3](z, y, x)
    fields[SKIN] = arm.skin_distance(x, y, z)
    fields[FASCIA] = fields[SKIN] - arm.skin_mm - arm.fat_below(x, z) + 0.25 * warp_y
    fields[BONE] = arm.bone_distance(x + 0.3 * warp_x, y + 0.3 * warp_y, z)
    fields[MEMBRANE] = arm.membrane_distance(x, y + 0.5 * warp_y, z)
    fields[WARP_X], fields[WARP_Y] = mirror * warp_x, warp_y
    fields[BRIGHT] = 2.5 * noises[4](z, y, x)
    fields[MIDDLE] = y - arm.middle_y(z)


def draw_tables(generator: np.random.Generator) -> Float32[np.ndarray, "2 z y x"]:
    """Return the sheets around fibre bundles in muscle, and around lobules of fat."""
    muscle = sheet_table(
        generator,
        cell_mm=CELLS_MM[0],
        spread_mm=(9.0, 0.36, 1.4),
        thickness_mm=0.17,
        coverage=0.5,
    )
    fat = sheet_table(
        generator,
        cell_mm=CELLS_MM[1],
        spread_mm=(9.0, 0.42, 3.0),
        thickness_mm=0.16,
        coverage=0.65,
    )
    return np.stack((muscle, fat))


def draw_tones(
    generator: np.random.Generator, arm: ArmShape, spacing_mm: float
) -> Float32[np.ndarray, " tones"]:
    """Return thicknesses and levels as :mod:`sonosweep.simulate.forearm_kernels` wants them."""
    fascia_mm, septum_mm = generator.uniform((0.4, 0.16), (1.1, 0.28))
    thicknesses = (arm.skin_mm, fascia_mm, max(septum_mm, 0.5 * spacing_mm))
    #         entry dermis fat  septa fascia muscle septum tendon bone marrow
    levels = (6.0, 0.0, -18.0, 19.0, 7.0, -15.0, 1.0, 1.0, 11.0, -20.0)
    spread = (1.0, 1.0, 1.5, 1.0, 1.0, 1.5, 1.0, 1.0, 1.0, 0.0)
    return np.array((*thicknesses, *generator.normal(levels, spread)), np.float32)
