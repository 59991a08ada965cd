"""The loops of ``splat_kernels`` in torch: the same frames up to rounding, on any device."""

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Complex64, Float, Float32, Int64
from torch import Tensor

from sonosweep.errors import ScanError
from sonosweep.simulate.medium import CELL_MM, ScattererSets
from sonosweep.simulate.point_spread import PointSpread
from sonosweep.simulate.slab import SeenCells
from sonosweep.simulate.splat_kernels import REACH_EXPONENT, FineGrid, Voxels

MOST_SCATTERERS = 1_500_000
"""At once: bounds the memory, about 200 bytes for each."""


class TorchSplat:
    """Renders frames with torch.

    Args:
        sets: Scatterers.
        voxels: The body.
        spread: The point spread function.
        fine: The beam.
        device: Where to compute.

    Raises:
        ScanError: If torch does not know the device or cannot reach it.
    """

    def __init__(
        self,
        sets: ScattererSets,
        voxels: Voxels,
        spread: PointSpread,
        fine: FineGrid,
        device: str,
    ) -> None:
        try:
            self._offsets = torch.tensor(sets.offsets_mm, device=device)
        except (RuntimeError, AssertionError) as error:
            reason = str(error).splitlines()[0]
            raise ScanError(f"torch cannot use the device '{device}': {reason}") from error
        self._device, self._first = device, sets.first
        self._voxels, self._spread, self._fine = voxels, spread, fine
        self._codes = torch.tensor(voxels.codes, device=device)
        self._amplitude = torch.tensor(voxels.amplitude, device=device)

    def frames(
        self,
        seen: Iterable[SeenCells],
        affines: Sequence[Float[np.ndarray, "4 4"]],
        arteries: Sequence[Float[np.ndarray, "_ 4"]],
    ) -> Complex64[Tensor, "frames rows columns"]:
        """Return the baseband echoes of frames that see these cells, one frame at a time."""
        rows, columns = self._spread.shape
        grid = torch.zeros(len(affines), rows * columns, 2, device=self._device)
        for number, cells in enumerate(seen):
            for part in _parts(cells):
                self._splat(part, affines[number], arteries[number], grid[number])
        return self._convolve(grid.reshape(len(affines), rows, columns, 2))

    def _splat(
        self, seen: SeenCells, affine: np.ndarray, arteries: np.ndarray, grid: Tensor
    ) -> None:
        """Add the echoes of cells to the fine grid of one frame."""
        arrays = _cells(seen, affine, self._first, self._voxels, self._fine)
        cells = _Cells(*(torch.from_numpy(value).to(self._device) for value in arrays))
        cell, rank = _members(cells.members)
        turn = affine[:3, :3].tolist()
        offsets = self._offsets[:, cells.first[cell] + rank] * cells.mirror.T[:, cell]
        x, y, z = (row[0] * offsets[0] + row[1] * offsets[1] + row[2] * offsets[2] for row in turn)
        if len(arteries):
            middle = cells.center[:, cell].double()
            dx, dy = _push(middle[0] + x, middle[1] + y, arteries)
            x, y = x + dx.float(), y + dy.float()
        u, y = self._across(cells, cell, x, y)
        v = cells.pixel[1][cell] + y * self._fine.per_step[1]
        z = cells.center[2][cell] + z
        rows, columns = self._spread.shape
        face = max(0.0, -self._fine.origin[1] * self._fine.per_step[1])
        inside = (u >= 0) & (u < columns - 1) & (v >= face) & (v < rows - 1)
        kept = torch.nonzero(inside & (self._exponent(cells, cell, y, z) < REACH_EXPONENT))[:, 0]
        cell, u, v = cell[kept], u[kept], v[kept]
        real, imaginary = self._echo(cells, cell, rank[kept], y[kept], z[kept])
        amplitude = self._tissue(cells, cell, offsets[:, kept])
        _share(grid, columns, u, v, torch.stack([real * amplitude, imaginary * amplitude], 1))

    def _across(self, cells: "_Cells", cell: Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Lateral fine pixel, and depth from that of the cell's middle."""
        if self._fine.radius_mm == 0:
            return cells.pixel[0][cell] + x * self._fine.per_step[0], y
        cx, cy = cells.center[0][cell], cells.center[1][cell] + self._fine.radius_mm
        distance = cells.distance[cell]
        more = 2 * (cx * x + cy * y) + x * x + y * y
        far = (distance**2 + more).clamp(min=0).sqrt()
        angle = 2 * torch.atan((cx + x) / (far + (cy + y).clamp(min=0)))
        u = (angle - self._fine.origin[0]) * self._fine.per_step[0]
        return u, more / (far + distance)

    def _exponent(self, cells: "_Cells", cell: Tensor, y: Tensor, z: Tensor) -> Tensor:
        """Exponent of the two-way amplitude across the slice."""
        t = (cells.below[cell] + y) * self._fine.per_range
        return z * z * self._fine.slice_exponent / (1 + t * t)

    def _echo(
        self, cells: "_Cells", cell: Tensor, rank: Tensor, y: Tensor, z: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Real and imaginary part of the echo of amplitude 1."""
        fine, deep = self._fine, cells.below[cell] + y
        most, top, slope = cells.gain.T[:, cell]
        weight = torch.exp(-self._exponent(cells, cell, y, z))
        weight = weight * torch.minimum(most, top - slope * rank)
        curved = z * z * deep * fine.curve_turns / (1 + (deep * fine.per_range) ** 2)
        turns = cells.turns[cell] + y * fine.turns_per_mm + curved
        angle = (turns - turns.round()) * (2 * math.pi)
        return weight * torch.cos(angle), -weight * torch.sin(angle)

    def _tissue(
        self, cells: "_Cells", cell: Tensor, offsets: Float32[Tensor, "3 n"]
    ) -> Float32[Tensor, " n"]:
        """Amplitude of the tissue at scatterers."""
        local = cells.voxel[cell] + offsets.T / self._voxels.spacing_mm
        near = local.int() + cells.corner[cell]
        size = torch.tensor(self._codes.shape[::-1], device=self._device)
        inside = ((near >= 0) & (near < size)).all(1)
        x, y, z = torch.minimum(near.clamp(min=0), size - 1).T
        return self._amplitude[self._codes[z, y, x].long()] * inside

    def _convolve(
        self, grid: Float32[Tensor, "frames fine_rows fine_columns 2"]
    ) -> Complex64[Tensor, "frames rows columns"]:
        # Sums of slices: convolutions on GPUs may use fewer digits.
        spread = self._spread
        lateral, axial = spread.decimation
        rows = len(spread.row_gain)
        gain = torch.from_numpy(spread.row_gain).to(self._device)[:, None, None]
        lines = torch.zeros((), device=self._device)
        for tap, weight in enumerate(spread.axial_weights.tolist()):
            lines = lines + weight * grid[:, tap : tap + axial * (rows - 1) + 1 : axial]
        lines = lines * gain
        columns = (grid.shape[2] - spread.lateral_weights.size - 1) // lateral + 1
        frames = torch.zeros((), device=self._device)
        for tap, weight in enumerate(spread.lateral_weights.tolist()):
            frames = (
                frames + weight * lines[:, :, tap : tap + lateral * (columns - 1) + 1 : lateral]
            )
        return torch.view_as_complex(frames.contiguous())


class _Cells(NamedTuple):
    """What the scatterers of a cell have in common.

    One row per cell, but ``center`` and ``pixel``, which have one row per axis.
    """

    members: Tensor
    first: Tensor
    corner: Tensor
    mirror: Tensor
    voxel: Tensor
    gain: Tensor
    center: Tensor
    pixel: Tensor
    distance: Tensor
    below: Tensor
    turns: Tensor


def _cells(
    seen: SeenCells, affine: np.ndarray, first: np.ndarray, voxels: Voxels, fine: FineGrid
) -> tuple[np.ndarray, ...]:
    """The fields of ``_Cells``: places in double precision, what is left of them in single."""
    middle = (seen.place[:, :3] + 0.5) * CELL_MM
    mirror = 1 - 2 * ((seen.place[:, 4:5] >> np.arange(3)) & 1)
    center = middle @ affine[:3, :3].T + affine[:3, 3]
    distance = np.hypot(center[:, 0], center[:, 1] + fine.radius_mm)
    depth = distance - fine.radius_mm if fine.radius_mm > 0 else center[:, 1]
    turns = depth * fine.turns_per_mm
    pixel = (np.stack([center[:, 0], depth], 1) - fine.origin) * fine.per_step
    at = (middle - voxels.origin_mm) / voxels.spacing_mm + 0.5
    corner = np.floor(at - 0.5 * CELL_MM / voxels.spacing_mm).astype(np.int64) - 1
    integers = seen.place[:, 5].astype(np.int64), first[seen.place[:, 3]], corner
    singles = mirror, at - corner, seen.gain, center.T, pixel.T, distance
    rest = depth - fine.focus_mm, turns - np.floor(turns)
    return (*integers, *(np.ascontiguousarray(value, np.float32) for value in (*singles, *rest)))


def _parts(seen: SeenCells) -> Iterator[SeenCells]:
    """Split cells into groups of at most so many scatterers."""
    group = np.cumsum(seen.place[:, 5], dtype=np.int64) // MOST_SCATTERERS
    for chosen in np.unique(group):
        yield SeenCells(seen.place[group == chosen], seen.gain[group == chosen])


def _members(counts: Int64[Tensor, " cells"]) -> tuple[Int64[Tensor, " n"], Int64[Tensor, " n"]]:
    """Cell of each scatterer, and its number in that cell."""
    cell = torch.repeat_interleave(counts)
    before = counts.cumsum(0) - counts
    return cell, torch.arange(len(cell), device=counts.device) - before[cell]


def _push(x: Tensor, y: Tensor, arteries: np.ndarray) -> tuple[Tensor, Tensor]:
    dx, dy = torch.zeros_like(x), torch.zeros_like(y)
    for lateral, depth, radius, dilation in arteries.tolist():
        u, v = x - lateral, y - depth
        share = dilation * radius / (u * u + v * v).clamp(min=radius * radius)
        dx, dy = dx + u * share, dy + v * share
    return dx, dy


def _share(grid: Tensor, columns: int, u: Tensor, v: Tensor, echo: Tensor) -> None:
    """Add echoes to the four fine pixels around each."""
    column, row = u.long(), v.long()
    right, down = (u - column)[:, None], (v - row)[:, None]
    at = row * columns + column
    grid.index_add_(0, at, echo * (1 - down) * (1 - right))
    grid.index_add_(0, at + 1, echo * (1 - down) * right)
    grid.index_add_(0, at + columns, echo * down * (1 - right))
    grid.index_add_(0, at + columns + 1, echo * down * right)
