"""Plain blocks of tissue, and poses, for tests of the speckle."""

import numpy as np
from scipy.spatial.transform import Rotation

from sonosweep.simulate import REFERENCE_CODE, Body, Tissue


def block(
    size_mm: tuple[float, float, float] = (24.0, 26.0, 20.0),
    spacing_mm: float = 0.5,
    code: int = REFERENCE_CODE,
) -> Body:
    """Return uniform tissue; x and z are 0 in its middle, y at its surface."""
    columns, rows, layers = (round(size / spacing_mm) for size in size_mm)
    echo = np.full((layers, rows, columns), code, np.uint8)
    origin = (-size_mm[0] / 2 + spacing_mm / 2, spacing_mm / 2, -size_mm[2] / 2 + spacing_mm / 2)
    skin = np.zeros((layers, columns), np.float32)
    tissue = np.full_like(echo, int(Tissue.MUSCLE))
    return Body("block", "simulated-900002", tissue, echo, spacing_mm, origin, skin)


def pose(
    x: float = 0.0, y: float = 0.0, z: float = 0.0, degrees: tuple[float, float, float] = (0, 0, 0)
) -> np.ndarray:
    """Return a pose at a place, turned about the axes of the plane."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("XYZ", degrees, degrees=True).as_matrix()
    matrix[:3, 3] = x, y, z
    return matrix


def correlation(one: np.ndarray, other: np.ndarray) -> complex:
    """Return the normalized complex correlation of two frames."""
    return complex(np.vdot(one, other) / np.linalg.norm(one) / np.linalg.norm(other))
