"""Which elements listen to a pixel, and how much each counts."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from sonosweep.errors import ScanError
from sonosweep.scan import Probe

Window = Literal["boxcar", "hann", "tukey"]
WINDOWS: dict[Window, int] = {"boxcar": 0, "hann": 1, "tukey": 2}
"""The numbers by which the kernels know the windows."""

SHAPE_TOLERANCE = 2e-3
"""Elements are on a line or circle if they are so within this part of the array's size."""


@dataclass(frozen=True, eq=False)
class ArrayShape:
    """Where the elements are in the imaging plane and where they look.

    Attributes:
        elements_mm: Centre of each element: lateral, axial, elevational.
        normals: Unit vector in which each element looks: lateral, axial.
        is_line: Whether all elements look in the same direction.
    """

    elements_mm: Float[np.ndarray, "elements xyz=3"]
    normals: Float[np.ndarray, "elements xy=2"]
    is_line: bool


def array_shape(probe: Probe) -> ArrayShape | None:
    """Return how the elements of a linear, curved or ring array are directed.

    Elements on a line look at right angles to it, into the body. Elements on a circle look
    along its radius: into the body for a curved array, to the middle for one that surrounds
    it by more than half. Returns ``None`` if they lie neither on a line nor on a circle.
    """
    elements = probe.element_positions_mm.detach().cpu().numpy().astype(np.float64)
    plane = elements[:, :2]
    middle = plane.mean(0)
    size = float(np.ptp(plane, axis=0).max())
    _, _, axes = np.linalg.svd(plane - middle, full_matrices=False)
    across = axes[-1] if len(plane) > 1 and size > 0 else np.array([0.0, 1.0])
    across = across if (across[1], across[0]) > (0.0, 0.0) else -across
    if np.abs((plane - middle) @ across).max() <= SHAPE_TOLERANCE * size:
        return ArrayShape(elements, np.tile(across, (len(plane), 1)), True)
    return _circle(elements, size)


def _circle(elements: Float[np.ndarray, "elements 3"], size: float) -> ArrayShape | None:
    """Return the directions of elements on a circle, found by least squares (Kasa)."""
    plane = elements[:, :2]
    system = np.column_stack([2 * plane, np.ones(len(plane))])
    solution = np.linalg.lstsq(system, (plane**2).sum(1), rcond=None)[0]
    inward = solution[:2] - plane
    radii = np.linalg.norm(inward, axis=1)
    if np.ptp(radii) > 2 * SHAPE_TOLERANCE * size:
        return None
    inward /= radii[:, None]
    surrounds = np.linalg.norm(inward.mean(0)) < 2 / np.pi
    looks_inward = surrounds or inward[:, 1].mean() > 0
    return ArrayShape(elements, inward if looks_inward else -inward, False)


def check_aperture(f_number: float | None, window: str, shape: ArrayShape | None) -> None:
    """Check that an f-number and a window can be used with an array.

    Raises:
        ScanError: If not, in one sentence.
    """
    if window not in WINDOWS:
        raise ScanError(f"the window must be one of {', '.join(WINDOWS)}, got '{window}'")
    if f_number is None:
        if window != "boxcar":
            raise ScanError(f"a {window} window needs an f-number: it is as wide as the aperture")
        return
    if not (np.isfinite(f_number) and f_number > 0):
        raise ScanError(
            f"the f-number must be above 0, got {f_number:g}; None, or --f-number all, uses all"
            " elements"
        )
    if shape is None:
        raise ScanError(
            "the elements lie neither on a line nor on a circle, so that an f-number has no"
            " meaning: use all elements (None, or --f-number all)"
        )
