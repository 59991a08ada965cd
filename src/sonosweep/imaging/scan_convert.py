"""Scan conversion: from the lines of a convex probe to pixels, and back.

Where each pixel lies between its four samples is worked out once for a geometry. What is
interpolated must be an amplitude or gray levels: IQ turns faster than samples follow.
"""

from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32
from numba import njit

from sonosweep.errors import ScanError
from sonosweep.imaging.pixel_grid import PixelGrid, centered_grid
from sonosweep.imaging.sector_grid import SectorGrid

OUTSIDE = -1
EDGE = 1e-6  # of a sample: rounding leaves no pixel of the rim outside


@dataclass(frozen=True, eq=False)
class ScanConverter:
    """Where each pixel of an image lies among the samples of another one.

    Attributes:
        source_shape: Rows and columns of the frames that :meth:`apply` takes.
        shape: Rows and columns of what it returns.
        cell: Index of the first of the four samples around each pixel, of the flattened
            frame; -1 for pixels outside.
        down: Part of the way to the next row of samples.
        across: Part of the way to the next column of samples.
    """

    source_shape: tuple[int, int]
    shape: tuple[int, int]
    cell: Int32[np.ndarray, " pixels"]
    down: Float32[np.ndarray, " pixels"]
    across: Float32[np.ndarray, " pixels"]

    @property
    def inside(self) -> Bool[np.ndarray, "rows columns"]:
        """Which pixels were insonified."""
        return (self.cell != OUTSIDE).reshape(self.shape)

    def apply(self, frames: np.ndarray) -> np.ndarray:
        """Return frames resampled bilinearly, of the same type; 0 outside.

        Args:
            frames: ``(*frames, rows, columns)`` of ``source_shape``, 8-bit or float.

        Raises:
            ScanError: If the frames have another shape.
        """
        check_source(self, frames.shape)
        source = np.ascontiguousarray(frames).reshape(-1, frames.shape[-2] * frames.shape[-1])
        converted = np.empty((len(source), len(self.cell)), frames.dtype)
        rounding = 0.5 if np.issubdtype(frames.dtype, np.integer) else 0.0
        width = self.source_shape[1]
        _convert(source, self.cell, self.down, self.across, width, rounding, converted)
        return converted.reshape(*frames.shape[:-2], *self.shape)


def sector_image_grid(sector: SectorGrid, columns: int, rows: int) -> PixelGrid:
    """Return the grid of square pixels that just holds a sector, centered in it."""
    lateral, axial = _positions(sector)
    half, top, bottom = (float(edge) for edge in (lateral.max(), axial.min(), axial.max()))
    spacing = max(2 * half / max(columns - 1, 1), (bottom - top) / max(rows - 1, 1))
    first_depth = (top + bottom - spacing * (rows - 1)) / 2
    return centered_grid(columns, rows, (spacing, spacing), first_depth)


def prepare_scan_converter(sector: SectorGrid, grid: PixelGrid) -> ScanConverter:
    """Return the conversion of a sector, ``(samples, lines)``, to an image.

    Raises:
        ScanError: If the sector has fewer than two lines or samples.
    """
    lateral, axial = grid.lateral_mm, grid.axial_mm[:, np.newaxis] + sector.radius_mm
    depth = np.hypot(lateral, axial) - sector.radius_mm
    sample = (depth - sector.first_depth_mm) / sector.sample_spacing_mm
    line = np.arctan2(lateral, axial) / sector.line_spacing_rad + (sector.lines - 1) / 2
    return _prepare(sample, line, (sector.samples, sector.lines))


def prepare_inverse_scan_converter(grid: PixelGrid, sector: SectorGrid) -> ScanConverter:
    """Return the conversion of an image to the samples of a sector, ``(samples, lines)``.

    Raises:
        ScanError: If the image has fewer than two rows or columns.
    """
    lateral, axial = _positions(sector)
    column = (lateral - grid.origin_mm[0]) / grid.spacing_mm[0]
    row = (axial - grid.origin_mm[1]) / grid.spacing_mm[1]
    return _prepare(row, column, (grid.rows, grid.columns))


def check_source(converter: ScanConverter, shape: tuple[int, ...]) -> None:
    """Check that frames fit a conversion.

    Raises:
        ScanError: If they do not.
    """
    if tuple(shape[-2:]) != converter.source_shape:
        rows, columns = converter.source_shape
        raise ScanError(
            f"the scan converter was prepared for {rows} x {columns} samples, got {shape}"
        )


def _positions(
    sector: SectorGrid,
) -> tuple[Float[np.ndarray, "samples lines"], Float[np.ndarray, "samples lines"]]:
    """Return the lateral and axial place of each sample."""
    reach = sector.radius_mm + sector.depths_mm[:, np.newaxis]
    return reach * np.sin(sector.angles_rad), reach * np.cos(sector.angles_rad) - sector.radius_mm


def _prepare(
    row: Float[np.ndarray, "rows columns"],
    column: Float[np.ndarray, "rows columns"],
    source_shape: tuple[int, int],
) -> ScanConverter:
    if min(source_shape) < 2:
        raise ScanError(
            f"scan conversion needs at least 2 x 2 samples, got {source_shape[0]} x"
            f" {source_shape[1]}"
        )
    inside, cell, shares = np.ones(row.shape, bool), np.zeros(row.shape, np.int32), []
    for place, count in zip((row, column), source_shape, strict=True):
        inside &= (place >= -EDGE) & (place <= count - 1 + EDGE)
        first = np.clip(np.floor(place), 0, count - 2)
        shares.append(np.clip(place - first, 0, 1).ravel().astype(np.float32))
        cell = cell * count + first.astype(np.int32)  # row * columns + column
    cell[~inside] = OUTSIDE
    return ScanConverter(source_shape, (row.shape[0], row.shape[1]), cell.ravel(), *shares)


@njit(cache=True, nogil=True)
@no_type_check
def _convert(source, cell, down, across, width, rounding, converted):
    for frame in range(source.shape[0]):
        samples, pixels = source[frame], converted[frame]
        for pixel in range(cell.size):
            first = cell[pixel]
            if first == OUTSIDE:
                pixels[pixel] = 0
                continue
            # In double precision: differences of unsigned bytes would wrap around.
            below, right = np.float64(down[pixel]), np.float64(across[pixel])
            upper = (1.0 - right) * samples[first] + right * samples[first + 1]
            first += width
            lower = (1.0 - right) * samples[first] + right * samples[first + 1]
            pixels[pixel] = (1.0 - below) * upper + below * lower + rounding
