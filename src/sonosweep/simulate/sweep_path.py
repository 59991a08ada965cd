"""The line that the middle of the probe's face draws on the skin, seen from above."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d
from scipy.optimize import brentq

from sonosweep.errors import ScanError

SweepShape = Literal["straight", "C", "L", "S"]

POINTS = 2001
CORNER_MM = 10.0  # radius of the bend of an L
SLOW_TURN_MM = 12.0  # a hand begins to turn before a bend and goes on after it


@dataclass(frozen=True, eq=False)
class SweepPath:
    """A line on the skin, by its length.

    Attributes:
        lengths_mm: Along the line, from 0.
        across_mm: Position across the arm (body x) there.
        along_mm: Position along the arm (body z) there.
        heading_rad: How far a hand that follows the line has turned there from along the
            arm toward across it.
    """

    lengths_mm: Float[np.ndarray, " points"]
    across_mm: Float[np.ndarray, " points"]
    along_mm: Float[np.ndarray, " points"]
    heading_rad: Float[np.ndarray, " points"]

    def at(
        self, length_mm: Float[np.ndarray, " places"]
    ) -> tuple[Float[np.ndarray, " places"], ...]:
        """Return the positions across and along the arm, and the heading, at these lengths."""
        values = (self.across_mm, self.along_mm, self.heading_rad)
        return tuple(np.interp(length_mm, self.lengths_mm, value) for value in values)

    @property
    def sharpest_rad_per_mm(self) -> float:
        """Largest turn per length."""
        return float(np.abs(np.gradient(self.heading_rad, self.lengths_mm)).max())


def sweep_path(shape: SweepShape, length_mm: float, excursion_mm: float) -> SweepPath:
    """Return a line of this shape that begins at (0, 0).

    Args:
        shape: ``"S"`` swings to one side and then to the other, ``"C"`` bows to one side,
            ``"L"`` goes along the arm and then turns to one side.
        length_mm: Of the line, along its bends.
        excursion_mm: How far it leaves the straight line; negative to the other side.

    Raises:
        ScanError: If the excursion is too large for the length.
    """
    if shape == "L":
        across, along = _corner(length_mm, excursion_mm)
    else:
        across, along = _wave(shape, length_mm, excursion_mm)
    lengths = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(across), np.diff(along)))])
    heading = np.arctan2(np.gradient(across, lengths), np.gradient(along, lengths))
    slow = min(SLOW_TURN_MM / lengths[-1], 0.5) * POINTS
    return SweepPath(lengths, across, along, gaussian_filter1d(heading, slow, mode="nearest"))


def _wave(
    shape: SweepShape, length_mm: float, excursion_mm: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return a sine of half a period (C) or one (S), or none."""
    u = np.linspace(0, 1, POINTS)
    turns = {"straight": 0.0, "C": 1.0, "S": 2.0}[shape]
    across = excursion_mm * np.sin(np.pi * turns * u)

    def excess(extent_mm: float) -> float:
        return float(np.hypot(np.diff(across), extent_mm * np.diff(u)).sum()) - length_mm

    if excess(length_mm / 4) > 0:
        raise ScanError(
            f"an excursion of {abs(excursion_mm):g} mm is too wide for a sweep of"
            f" {length_mm:g} mm in the shape of {shape}: make it longer or straighter"
        )
    return across, u * brentq(excess, length_mm / 4, length_mm * 1.001, xtol=1e-9)


def _corner(length_mm: float, excursion_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """Return two legs with a quarter of a circle between them."""
    side = abs(excursion_mm)
    radius = min(CORNER_MM, side)
    arc = radius * np.pi / 2
    first = length_mm - arc - (side - radius)
    if first < length_mm / 4:
        raise ScanError(
            f"an excursion of {side:g} mm is too wide for a sweep of {length_mm:g} mm in the"
            " shape of L: make it longer or straighter"
        )
    s = np.linspace(0, length_mm, POINTS)
    angle = np.clip((s - first) / max(radius, 1e-9), 0, np.pi / 2)
    across = radius * (1 - np.cos(angle)) + np.clip(s - first - arc, 0, None)
    along = np.clip(s, None, first) + radius * np.sin(angle)
    return np.copysign(1.0, excursion_mm) * across, along
