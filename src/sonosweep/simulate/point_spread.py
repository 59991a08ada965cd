"""The point spread function on a grid: how finely scatterers are placed, and its weights."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64

from sonosweep.errors import ScanError
from sonosweep.imaging import PixelGrid, SectorGrid
from sonosweep.simulate.beam import Beam

FINE_STEPS_PER_WIDTH = 4.4
"""Fine pixels per full width at half maximum: fewer decorrelate what moves between pixels."""
REACH = 3.5
"""Standard deviations after which the point spread function is cut off (0.2 % of its peak)."""
WIDEST_RAD = math.radians(70)
"""From a sector's middle to its outermost line."""
MOST_FINE_PIXELS = 64_000_000
REFERENCE_CELL_MM3 = Beam().axial_fwhm_mm * Beam().lateral_fwhm_mm * Beam().elevation_waist_mm
"""Resolution cell of the default beam at its focus, up to a factor."""

_WIDTH_PER_DEVIATION = 2 * math.sqrt(2 * math.log(2))


@dataclass(frozen=True, eq=False)
class PointSpread:
    """A beam on a grid.

    The lateral coordinate is mm from the array's middle, for a sector the angle in rad; the
    axial coordinate is the depth below the face, for a sector along the line.

    Attributes:
        shape: Rows and columns of the fine grid.
        steps: Its lateral and axial step (rad or mm; mm).
        origin: Lateral and axial coordinate of its first pixel.
        decimation: Fine pixels per pixel, lateral and axial.
        lateral_weights: The point spread function across, in fine pixels.
        axial_weights: Along.
        row_gain: Of each row of the frame, so that the mean power of the echoes of a medium
            of one scatterer per mm3 of amplitude 1 is 1 at every depth.
        radius_mm: Of the array's face; 0 if it is flat.
    """

    shape: tuple[int, int]
    steps: tuple[float, float]
    origin: tuple[float, float]
    decimation: tuple[int, int]
    lateral_weights: Float32[np.ndarray, " lateral_taps"]
    axial_weights: Float32[np.ndarray, " axial_taps"]
    row_gain: Float32[np.ndarray, " rows"]
    radius_mm: float


def point_spread(grid: PixelGrid | SectorGrid, beam: Beam) -> PointSpread:
    """Return a beam's point spread function for frames on a grid.

    Raises:
        ScanError: If the radii of grid and beam differ, or the grid is far too large or wide.
    """
    size, spacing, first, radius = _layout(grid)
    _check_radius(beam, radius)
    if radius > 0 and abs(first[0]) > WIDEST_RAD:
        raise ScanError(
            f"a sector of {2 * math.degrees(abs(first[0])):.0f} degrees is wider than"
            f" {2 * math.degrees(WIDEST_RAD):.0f}: use fewer lines or a smaller angle between them"
        )
    lateral_width = beam.lateral_fwhm_mm
    if radius > 0:
        lateral_width /= radius + beam.sector_depth_mm
    columns = _axis(spacing[0], size[0], lateral_width)
    rows = _axis(spacing[1], size[1], beam.axial_fwhm_mm)
    if columns.size * rows.size > MOST_FINE_PIXELS:
        raise ScanError(
            f"a frame of {size[0]} x {size[1]} pixels at this resolution needs"
            f" {columns.size * rows.size} fine pixels, more than {MOST_FINE_PIXELS}: make the"
            " frame smaller"
        )
    depths = first[1] + spacing[1] * np.arange(size[1])
    return PointSpread(
        shape=(rows.size, columns.size),
        steps=(columns.step, rows.step),
        origin=(first[0] - columns.margin, first[1] - rows.margin),
        decimation=(columns.decimation, rows.decimation),
        lateral_weights=columns.weights,
        axial_weights=rows.weights,
        row_gain=_row_gain(beam, radius, depths),
        radius_mm=radius,
    )


def slice_width_mm(beam: Beam, depth_mm: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
    """Return where the two-way amplitude across the slice has fallen to exp(-2)."""
    t = (depth_mm - beam.elevation_focus_mm) / rayleigh_range_mm(beam)
    return beam.elevation_waist_mm * np.sqrt(1 + t * t)


def rayleigh_range_mm(beam: Beam) -> float:
    """Return the distance from the focus at which the slice is wider by sqrt(2)."""
    return math.pi * beam.elevation_waist_mm**2 / beam.wavelength_mm


@dataclass(frozen=True, eq=False)
class _Axis:
    step: float
    size: int
    decimation: int
    margin: float
    weights: np.ndarray


def _axis(spacing: float, pixels: int, width: float) -> _Axis:
    decimation = max(1, math.ceil(FINE_STEPS_PER_WIDTH * spacing / width))
    step = spacing / decimation
    deviation = width / _WIDTH_PER_DEVIATION
    # Sharing a scatterer between two fine pixels widens it by step^2 / 6 on average.
    narrowed = math.sqrt(deviation**2 - step**2 / 6)
    half = math.ceil(REACH * deviation / step)
    weights = np.exp(-0.5 * (np.arange(-half, half + 1) * step / narrowed) ** 2)
    weights *= math.sqrt(2 * math.pi) * deviation / step / weights.sum()
    size = (pixels - 1) * decimation + 2 * half + 2
    return _Axis(step, size, decimation, half * step, weights.astype(np.float32))


def _layout(
    grid: PixelGrid | SectorGrid,
) -> tuple[tuple[int, int], tuple[float, float], tuple[float, float], float]:
    """Size, spacing and first coordinate (lateral, axial), and radius of the face."""
    if isinstance(grid, PixelGrid):
        return (grid.columns, grid.rows), grid.spacing_mm, grid.origin_mm, 0.0
    first = -grid.line_spacing_rad * (grid.lines - 1) / 2
    spacing = (grid.line_spacing_rad, grid.sample_spacing_mm)
    return (grid.lines, grid.samples), spacing, (first, grid.first_depth_mm), grid.radius_mm


def _check_radius(beam: Beam, radius_mm: float) -> None:
    if beam.curvature_radius_mm is not None and beam.curvature_radius_mm != radius_mm:
        shape = f"a face of radius {radius_mm:g} mm" if radius_mm else "a flat face"
        raise ScanError(
            f"a beam of a convex array of radius {beam.curvature_radius_mm:g} mm does not fit"
            f" a grid in front of {shape}"
        )


def _row_gain(beam: Beam, radius_mm: float, depth_mm: np.ndarray) -> np.ndarray:
    # The integral of the squared point spread function, which is Gaussian along each axis.
    in_plane = beam.lateral_fwhm_mm * beam.axial_fwhm_mm * math.pi / _WIDTH_PER_DEVIATION**2
    volume = in_plane * slice_width_mm(beam, depth_mm) * math.sqrt(math.pi) / 2
    if radius_mm > 0:
        volume = volume * (radius_mm + depth_mm) / (radius_mm + beam.sector_depth_mm)
    return (1 / np.sqrt(volume)).astype(np.float32)
