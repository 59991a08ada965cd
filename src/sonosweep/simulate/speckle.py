"""Frames of a body as a probe hears them: complex speckle, exactly fixed in the body.

Every frame is the sum of the echoes of the scatterers in the slice before the probe. So
frames decorrelate as physics says when the probe moves or turns, and agree where it comes
back. The slice is a Gaussian beam with its curved wavefronts (Siegman, Lasers, chapter 17):
the width of the slice changes with depth but the correlation of the speckle does not; it
falls to exp(-d^2 / w0^2) after an elevational displacement d.
"""

from collections.abc import Sequence
from typing import Literal

import numpy as np
import torch
from jaxtyping import Complex64, Float, Inexact
from torch import Tensor

from sonosweep.errors import ScanError
from sonosweep.imaging import PixelGrid, SectorGrid
from sonosweep.simulate.beam import Beam
from sonosweep.simulate.body import Body, echo_amplitude
from sonosweep.simulate.coded_voxels import codes_and_values
from sonosweep.simulate.deformation import STILL, Deformation
from sonosweep.simulate.medium import Medium
from sonosweep.simulate.point_spread import PointSpread, point_spread, rayleigh_range_mm
from sonosweep.simulate.slab import CellRoom, SeenCells, cell_table, seen_cells, slab_of
from sonosweep.simulate.splat_kernels import FineGrid, Voxels, splat_cells
from sonosweep.simulate.splat_torch import TorchSplat
from sonosweep.simulate.spread_kernels import splat_points, spread_points
from sonosweep.simulate.tissue_motion import body_to_plane, pushes


def fine_grid(spread: PointSpread, beam: Beam) -> FineGrid:
    """Return the numbers with which scatterers are placed and weighed."""
    rayleigh = rayleigh_range_mm(beam)
    return FineGrid(
        origin=(float(spread.origin[0]), float(spread.origin[1])),
        per_step=(1 / spread.steps[0], 1 / spread.steps[1]),
        radius_mm=float(spread.radius_mm),
        focus_mm=float(beam.elevation_focus_mm),
        per_range=1 / rayleigh,
        slice_exponent=2 / beam.elevation_waist_mm**2,
        turns_per_mm=2 / beam.wavelength_mm,
        curve_turns=1 / (beam.wavelength_mm * rayleigh**2),
    )


class SpeckleRenderer:
    """Renders what a probe hears of a body, frame by frame, in any order.

    A frame depends on its pose, its deformation and the seed alone. Where the tissue has
    echogenicity code 200, the mean power is 1 at every depth and for every beam; attenuation
    and gain are the scanner's.

    Args:
        body: What is scanned.
        beam: How the probe sees it.
        grid: Of the frames.
        seed: Of the scatterers.
        density_per_mm3: Of the scatterers. A beam with larger resolution cells, or the same
            beam out of focus, counts only as many as the default beam has at its focus, 11
            per resolution cell, with the same mean power: they cost time and change nothing.
        engine: ``"numba"`` on one thread of the CPU, or ``"torch"`` on ``device``; the same
            frames up to rounding.
        device: Of torch, such as ``"cuda"``.

    Raises:
        ScanError: If seed or density are out of range, or beam and grid do not fit.
    """

    def __init__(
        self,
        body: Body,
        beam: Beam,
        grid: PixelGrid | SectorGrid,
        *,
        seed: int,
        density_per_mm3: float = 266.0,
        engine: Literal["numba", "torch"] = "numba",
        device: str = "cpu",
    ) -> None:
        medium = Medium(seed, density_per_mm3)
        self._sets, self._word = medium.sets, medium.word
        self._spread = point_spread(grid, beam)
        self._fine = fine_grid(self._spread, beam)
        self._slab = slab_of(beam, self._spread)
        self._table = cell_table(body)
        amplitude = echo_amplitude() / np.float32(np.sqrt(density_per_mm3))
        codes, values = codes_and_values(body.echogenicity)
        self._voxels = Voxels(
            np.ascontiguousarray(codes),
            body.origin_mm,
            float(body.spacing_mm),
            amplitude[values],
        )
        self._room = CellRoom()
        self._torch: TorchSplat | None = None
        if engine == "torch":
            self._torch = TorchSplat(self._sets, self._voxels, self._spread, self._fine, device)
        else:
            self._grid = np.zeros((*self._spread.shape, 2), np.float32)

    def iq(
        self, plane_to_body: Float[np.ndarray, "4 4"], deformation: Deformation = STILL
    ) -> Complex64[np.ndarray, "rows columns"]:
        """Return the baseband echoes of one frame; of a sector, lines are columns.

        Args:
            plane_to_body: Pose of the imaging plane; its origin is the middle of the array's
                face.
            deformation: Of the tissue in this frame.

        Raises:
            ScanError: If the pose is not a rotation and a shift.
        """
        if self._torch is not None:
            return self.iq_tensor(plane_to_body[None], [deformation])[0].numpy(force=True)
        affine, arteries = body_to_plane(plane_to_body, deformation), pushes(deformation)
        seen = self._cells(affine, arteries)
        self._grid.fill(0)
        splat_cells(*seen, *self._sets, affine, arteries, self._fine, self._voxels, self._grid)
        return _spread(self._grid, self._spread, self._spread.row_gain)

    def iq_tensor(
        self,
        planes_to_body: Float[np.ndarray, "frames 4 4"],
        deformations: Sequence[Deformation] | None = None,
    ) -> Complex64[Tensor, "frames rows columns"]:
        """Return the baseband echoes of frames, on the device on which they are rendered.

        Args:
            planes_to_body: As for :meth:`iq`.
            deformations: One for each frame; none if left out.

        Raises:
            ScanError: If a pose is not a rotation and a shift.
        """
        deformations = deformations or [STILL] * len(planes_to_body)
        pairs = list(zip(planes_to_body, deformations, strict=True))
        if self._torch is None:
            return torch.from_numpy(np.stack([self.iq(*pair) for pair in pairs]))
        affines = [body_to_plane(*pair) for pair in pairs]
        arteries = [pushes(deformation) for deformation in deformations]
        seen = map(self._cells, affines, arteries)
        return self._torch.frames(seen, affines, arteries)

    def _cells(self, affine: np.ndarray, arteries: np.ndarray) -> SeenCells:
        reach = float(np.abs(arteries[:, 3]).sum())
        return seen_cells(
            self._slab, self._table, self._sets.first, self._word, affine, reach, self._room
        )


def render_points(
    points_mm: Float[np.ndarray, "points xyz=3"],
    amplitudes: Inexact[np.ndarray, " points"],
    beam: Beam,
    grid: PixelGrid | SectorGrid,
) -> Complex64[np.ndarray, "rows columns"]:
    """Return the baseband echoes of given points.

    Args:
        points_mm: In plane coordinates (origin at the middle of the array's face).
        amplitudes: Of their echoes, real or complex: the peak of a point in the plane.
        beam: How the probe sees them.
        grid: Of the frame.

    Raises:
        ScanError: If a number is not finite, or beam and grid do not fit.
    """
    if not (np.isfinite(points_mm).all() and np.isfinite(amplitudes).all()):
        raise ScanError("points and their amplitudes must be finite numbers, got NaN or infinity")
    spread = point_spread(grid, beam)
    fine = np.zeros((*spread.shape, 2), np.float32)
    splat_points(
        np.ascontiguousarray(points_mm, np.float64),
        np.ascontiguousarray(amplitudes, np.complex128),
        fine_grid(spread, beam),
        fine,
    )
    return _spread(fine, spread, np.ones_like(spread.row_gain))


def _spread(grid: np.ndarray, spread: PointSpread, gain: np.ndarray) -> np.ndarray:
    columns = (grid.shape[1] - spread.lateral_weights.size - 1) // spread.decimation[0] + 1
    frame = np.empty((gain.size, columns), np.complex64)
    line = np.empty(2 * grid.shape[1], np.float32)
    weights = spread.axial_weights, spread.lateral_weights
    spread_points(grid, *weights, spread.decimation, gain, line, frame)
    return frame
