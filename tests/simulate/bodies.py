"""Small bodies made by hand, so that tests of what scans them need no other code."""

import numpy as np

from sonosweep.simulate import REFERENCE_CODE, Body, Tissue, Vessel

ECHO_OF_BLOOD_DB = -30.0


def tube(
    start_mm: tuple[float, float, float] = (-1.5, 7.0, -2.0),
    end_mm: tuple[float, float, float] = (1.5, 9.0, 8.0),
    radius_mm: float = 1.2,
    spacing_mm: float = 0.25,
    skin_mm: float = 0.0,
) -> Body:
    """Return tissue of 16 x 15 x 12 mm with one straight vessel, flowing from start to end."""
    x, y, z = (np.arange(low, high, spacing_mm) for low, high in ((-8, 8), (0, 15), (-3, 9)))
    grid = np.stack(np.meshgrid(z, y, x, indexing="ij")[::-1], axis=-1)
    start, end = np.array(start_mm), np.array(end_mm)
    along = (end - start) / np.linalg.norm(end - start)
    apart = grid - start
    aside = apart - (apart @ along)[..., None] * along
    lumen = np.linalg.norm(aside, axis=-1) < radius_mm
    tissue = np.where(lumen, int(Tissue.ARTERY), int(Tissue.MUSCLE)).astype(np.uint8)
    tissue[:, y < skin_mm] = int(Tissue.SKIN)
    blood_code = REFERENCE_CODE + round(ECHO_OF_BLOOD_DB / 0.25)
    echo = np.where(lumen, blood_code, REFERENCE_CODE).astype(np.uint8)
    line = start + np.linspace(0, 1, 41)[:, None] * (end - start)
    vessel = Vessel("tube", "artery", line, np.full(41, radius_mm), 100.0)
    origin = (float(x[0]), float(y[0]), float(z[0]))
    flat = np.zeros((len(z), len(x)), np.float32)
    return Body("tube", "simulated-900001", tissue, echo, spacing_mm, origin, flat, (vessel,))
