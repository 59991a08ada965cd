"""What a frame contributes to which bricks: the geometry of gather compounding."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sonosweep.errors import ScanError
from sonosweep.reconstruct.bricks import BrickTable
from sonosweep.reconstruct.gather_kernels import BRICK, ONE, ROUND, list_bricks
from sonosweep.reconstruct.planes import (
    Lattice,
    Planes,
    gaps_mm,
    lattice_of_grid,
    voxel_to_plane,
)
from sonosweep.scan import VolumeGrid

NARROWEST_RADIUS_VOXELS = 2.0
"""With less, single pixels show; measured on a phantom, twice a voxel has the least error."""
WIDEST_RADIUS_MM = 3.0
"""About half the thickness of an ultrasound beam far from its focus: beyond, a frame knows
nothing, and a hole is more honest. After twice this gap a new sweep begins."""
LARGEST_FRAME_PX = 30000
"""Coordinates in a frame are 16 bits of pixels over 16 bits of fraction."""


@dataclass(frozen=True, eq=False)
class Contribution:
    """Frames, ready for the kernels; see :mod:`sonosweep.reconstruct.gather_kernels`.

    Attributes:
        fixed: Per frame, voxel (x, y, z, 1) to fixed-point (column, row, height).
        peaks: Per frame, weight in its plane, in fixed point.
        first: Index of each frame's first brick, and the total.
        numbers: Bricks that the frames meet, by their number in a table.
    """

    fixed: Float[np.ndarray, "frames 3 4"]
    peaks: Int[np.ndarray, " frames"]
    first: Int[np.ndarray, " frames+1"]
    numbers: Int[np.ndarray, " pairs"]


@dataclass(frozen=True, eq=False)
class Sampling:
    """How frames of one shape are sampled by the voxels of a grid.

    Attributes:
        lattice: Where the voxels are.
        voxel_mm: Largest spacing of the voxels.
        rows: Of a frame.
        columns: Of a frame.
        box: Rows and columns that are averaged before sampling.
        radius_mm: How far from its plane a frame counts; ``None`` adapts it to the gap
            before the frame.
        kept_cells: Empty, or which cells of the averaged frame count.
    """

    lattice: Lattice
    voxel_mm: float
    rows: int
    columns: int
    box: Int[np.ndarray, " 2"]
    radius_mm: float | None
    kept_cells: Bool[np.ndarray, " cells"]

    def radii_mm(self, gaps: Sequence[float] | np.ndarray) -> Float[np.ndarray, " frames"]:
        """Return the radius of frames with these gaps before them.

        A frame reaches back to the frame before it, so that nothing between them stays
        empty: this rule needs no frame that is yet to come.
        """
        if self.radius_mm is not None:
            return np.full(len(gaps), self.radius_mm)
        narrowest = NARROWEST_RADIUS_VOXELS * self.voxel_mm
        gaps = np.where(np.asarray(gaps) > 2 * WIDEST_RADIUS_MM, 0.0, gaps)
        return np.clip(gaps, narrowest, max(WIDEST_RADIUS_MM, narrowest))

    def gaps_mm(self, planes: Planes) -> Float[np.ndarray, " steps"]:
        """Return the gap between each frame and the next."""
        return gaps_mm(planes, self.rows, self.columns)

    def contribution(
        self,
        planes: Planes,
        radii_mm: Float[np.ndarray, " frames"],
        confidence: Float[np.ndarray, " frames"],
        order: Int[np.ndarray, "axes=3"],
        table: BrickTable,
    ) -> Contribution:
        """Return which bricks the frames meet, by number, and how they are sampled there."""
        matrix, boxes = voxel_to_plane(planes, self.lattice, self.rows, self.columns, radii_mm)
        for k, box in enumerate(self.box.tolist()[::-1]):  # pixels to averaged pixels
            if box > 1:
                matrix[:, k, :3] /= box
                matrix[:, k, 3] = (matrix[:, k, 3] + 0.5) / box - 0.5
        half_size = np.array([self.columns, self.rows]) / self.box[::-1] / 2
        first, bricks = _list(matrix, radii_mm, boxes, half_size, order)
        fixed = matrix * ONE
        fixed[:, 2] *= (confidence / radii_mm)[:, None]
        fixed[:, :2, 3] += ONE + ROUND
        peaks = np.floor(confidence * ONE + 0.5).astype(np.int64) - 1
        return Contribution(fixed, peaks, first, table.numbers(bricks))


def sampling_of_frames(
    grid: VolumeGrid,
    pixel_to_image: Float[Tensor, "4 4"],
    rows: int,
    columns: int,
    radius_mm: float | Literal["auto"] = "auto",
    prefilter: int | Literal["auto"] = "auto",
    mask: Bool[np.ndarray, "rows columns"] | None = None,
) -> Sampling:
    """Return how frames are sampled; arguments as in :func:`compound_gather`.

    Raises:
        ScanError: If a setting is out of range, or the mask has another shape.
    """
    pixel_mm = torch.linalg.vector_norm(pixel_to_image[:3, :2].double(), dim=0).numpy()
    voxel_mm = min(grid.spacing_mm)
    if prefilter == "auto":
        # A ratio of 1.5 counts as 2 even if rounding made it a little less.
        box = np.maximum(np.floor(voxel_mm / pixel_mm[::-1] + 0.501), 1).astype(np.int64)
    elif prefilter >= 1:
        box = np.array([prefilter, prefilter], np.int64)
    else:
        raise ScanError(f"the prefilter averages squares of 1 pixel or more, got {prefilter}")
    box = np.minimum(box, (rows, columns))
    if radius_mm != "auto":
        check_radius(radius_mm, grid)
    if mask is not None and mask.shape != (rows, columns):
        raise ScanError(f"a mask of shape {mask.shape} for frames of {rows} x {columns}")
    brick_px = 2 * BRICK * max(grid.spacing_mm) / (pixel_mm[::-1] * box).min()
    if max(rows / box[0], columns / box[1]) + brick_px > LARGEST_FRAME_PX:
        raise ScanError(
            f"frames of {rows} x {columns} pixels are too large for voxels of"
            f" {max(grid.spacing_mm):g} mm: use a prefilter"
        )
    return Sampling(
        lattice=lattice_of_grid(grid),
        voxel_mm=max(grid.spacing_mm),
        rows=rows,
        columns=columns,
        box=box,
        radius_mm=None if radius_mm == "auto" else float(radius_mm),
        kept_cells=np.zeros(0, bool) if mask is None else _kept_cells(mask, box),
    )


def check_radius(radius_mm: float, grid: VolumeGrid) -> None:
    """Refuse a radius that is not above 0, or too small for fixed-point heights.

    Raises:
        ScanError: Which says so.
    """
    if not min(grid.spacing_mm) / 100 <= radius_mm < np.inf:
        raise ScanError(
            f"the radius must be above 0 mm, and at least a hundredth of a voxel, got {radius_mm:g}"
        )


def _kept_cells(mask: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Cells all of whose pixels are kept; those beyond the frame's edge repeat the edge."""
    rows, columns = -(-mask.shape[0] // box[0]), -(-mask.shape[1] // box[1])
    padding = ((0, rows * box[0] - mask.shape[0]), (0, columns * box[1] - mask.shape[1]))
    whole = np.pad(mask, padding, mode="edge").reshape(rows, box[0], columns, box[1])
    kept = np.pad(whole.all(axis=(1, 3)), 1, mode="edge")
    return (kept[:-1, :-1] & kept[:-1, 1:] & kept[1:, :-1] & kept[1:, 1:]).reshape(-1)


def _list(
    matrix: np.ndarray,
    reach: np.ndarray,
    boxes: np.ndarray,
    half_size: np.ndarray,
    order: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    first = np.empty(len(matrix) + 1, np.int64)
    room = 1024 * len(matrix)
    while True:
        bricks = np.empty((room, 3), np.int32)
        count = list_bricks(matrix, reach, boxes, half_size, order, first, bricks)
        if count <= room:
            return first, bricks[:count]
        room = count
