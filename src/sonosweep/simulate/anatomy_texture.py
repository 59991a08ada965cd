"""Tables of thin bright sheets: the connective tissue around fibre bundles and fat lobules."""

import numpy as np
from jaxtyping import Float, Float32
from scipy import ndimage

TABLE_SHAPE = (32, 256, 64)  # along the arm, in depth, across; powers of two, repeated


def sheet_table(
    generator: np.random.Generator,
    *,
    cell_mm: tuple[float, float, float],
    spread_mm: tuple[float, float, float],
    thickness_mm: float,
    coverage: float,
) -> Float32[np.ndarray, "z y x"]:
    """Return how bright sheets are, from 0 (between them) to about 1.

    Sheets are where smooth noise is zero, which gives closed bundles; they fade where a
    second noise is low, and where they stand upright: a surface along the beam sends
    little back.

    Args:
        generator: Draws the noise.
        cell_mm: Size of a cell of the table along the arm, in depth and across.
        spread_mm: Standard deviation of the noise's smoothing in the same directions;
            sheets are about 4.4 times that apart.
        thickness_mm: Of a sheet, standard deviation of its profile.
        coverage: Share of the sheets that is seen.
    """
    noise = _noise(generator, cell_mm, spread_mm)
    presence = _noise(generator, cell_mm, tuple(1.5 * spread for spread in spread_mm))
    slopes = [
        (np.roll(noise, -1, axis) - np.roll(noise, 1, axis)) / (2 * cell)
        for axis, cell in enumerate(cell_mm)
    ]
    steepness = np.sqrt(sum(slope**2 for slope in slopes)) + 1e-3
    sheets = np.exp(-0.5 * (noise / (steepness * thickness_mm)) ** 2)
    facing = np.abs(slopes[1]) / steepness
    cut = np.quantile(presence, 1 - coverage)
    seen = 1 / (1 + np.exp(-4 * (presence - cut)))
    return (sheets * facing**2 * seen).astype(np.float32)


def _noise(
    generator: np.random.Generator, cell_mm: tuple[float, ...], spread_mm: tuple[float, ...]
) -> Float[np.ndarray, "z y x"]:
    spread = [wide / cell for wide, cell in zip(spread_mm, cell_mm, strict=True)]
    smooth = ndimage.gaussian_filter(
        generator.standard_normal(TABLE_SHAPE, np.float32), spread, mode="wrap"
    )
    return (smooth - smooth.mean()) / smooth.std()
