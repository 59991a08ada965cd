"""Smooth random fields of place: a place has the same value on every grid."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy import ndimage

NODES = 32  # along each axis; then the field repeats
_MEAN_SQUARE = 0.4794  # sum of a cubic B-spline's squared weights, averaged over places


@dataclass(frozen=True, eq=False)
class SmoothNoise:
    """Random values on a lattice, joined by cubic B-splines; mean 0, deviation about 1.

    Attributes:
        nodes: Random values, periodic.
        scale_mm: Distance of nodes along each axis.
    """

    nodes: Float[np.ndarray, "*axes"]
    scale_mm: tuple[float, ...]

    def __call__(self, *places_mm: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """Return the field at the places that the coordinates, one array per axis, name."""
        places = np.broadcast_arrays(*places_mm)
        indices = [place / scale for place, scale in zip(places, self.scale_mm, strict=True)]
        values = ndimage.map_coordinates(
            self.nodes, indices, order=3, mode="grid-wrap", prefilter=False
        )
        return values / _MEAN_SQUARE ** (self.nodes.ndim / 2)


def draw_noise(generator: np.random.Generator, *scale_mm: float) -> SmoothNoise:
    """Return a new random field with features of about ``scale_mm`` along each axis."""
    return SmoothNoise(generator.standard_normal((NODES,) * len(scale_mm)), scale_mm)
