"""Where in the image motion is measured: a grid of overlapping square patches."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from sonosweep.errors import ScanError
from sonosweep.scan import Scan

INSIDE = 0.95
"""Part of a patch that must be image: a sector's edge has no speckle beyond it."""

BORDER_PX = 3
"""Kept free around all patches, so that a small motion does not lose the outer ones."""

SMALLEST_PATCH_PX = 24
"""Below this a patch holds too few speckles to correlate."""


@dataclass(frozen=True, eq=False)
class PatchGrid:
    """Square patches that lie in the image, neighbours half a patch apart.

    Attributes:
        side_px: Rows, and columns, of a patch.
        corners_px: First row and column of each patch, in the cropped frame.
        centers_mm: Middle of each patch in image coordinates: lateral, axial.
        mask: Which pixels of the cropped frame hold image.
        rectangle_px: ``(column, row, width, height)`` of the cropped frame in the full one.
        spacing_mm: Distance between columns and between rows.
        redundancy: How many times over overlapping patches use each pixel.
    """

    side_px: int
    corners_px: Int[np.ndarray, "patches rc=2"]
    centers_mm: Float[np.ndarray, "patches xy=2"]
    mask: Bool[np.ndarray, "rows columns"]
    rectangle_px: tuple[int, int, int, int]
    spacing_mm: tuple[float, float]
    redundancy: float

    @property
    def middle_mm(self) -> Float[np.ndarray, "xy=2"]:
        """Middle of all patches: the point about which turns are estimated."""
        return self.centers_mm.mean(axis=0)

    @property
    def from_middle_mm(self) -> Float[np.ndarray, "patches xy=2"]:
        """Middle of each patch from the middle of all."""
        return self.centers_mm - self.middle_mm


def patch_grid(scan: Scan, patches_across: float = 8.0) -> PatchGrid:
    """Return the patches of a scan's region, or of its whole frame if none was found.

    Args:
        scan: Needs a calibration.
        patches_across: How many patches, side by side, span the longer side of the image.

    Raises:
        ScanError: If the scan has no pixel spacing, or its image is too small.
    """
    if scan.calibration is None:
        raise ScanError(
            f"'{scan.name}' has no pixel spacing, so motion in mm cannot be told: give it with"
            " --pixel-spacing LATERAL AXIAL in mm"
        )
    mask, rectangle = _region(scan)
    column, row, width, height = rectangle
    side = 2 * round(max(width, height) / (2 * patches_across))
    side = max(SMALLEST_PATCH_PX, min(side, min(width, height) // 3))
    if min(width, height) < 2 * side:
        raise ScanError(
            f"the image of '{scan.name}' is {width} x {height} pixels; motion needs at least"
            f" {2 * side} each way"
        )
    corners = _corners(mask, side)
    if len(corners) == 0:
        raise ScanError(f"the region of '{scan.name}' holds no {side} x {side} pixels of image")
    x_mm, y_mm = scan.calibration.spacing_mm
    middle = corners + (side - 1) / 2
    centers = np.stack(((middle[:, 1] + column) * x_mm, (middle[:, 0] + row) * y_mm), axis=-1)
    centers[:, 0] += scan.calibration.shear * centers[:, 1]
    redundancy = _redundancy(mask, corners, side)
    return PatchGrid(side, corners, centers, mask, rectangle, (x_mm, y_mm), redundancy)


def _region(scan: Scan) -> tuple[np.ndarray, tuple[int, int, int, int]]:
    rows, columns = scan.frames.shape[1:3]
    if scan.region is None:
        return np.ones((rows, columns), dtype=bool), (0, 0, columns, rows)
    column, row, width, height = scan.region.rectangle_px
    width, height = min(width, columns - column), min(height, rows - row)
    if width < 1 or height < 1:
        raise ScanError(f"the region of '{scan.name}' lies outside its {columns} x {rows} frame")
    if scan.region.mask is None:
        return np.ones((height, width), dtype=bool), (column, row, width, height)
    if scan.region.mask.shape != (rows, columns):
        raise ScanError(
            f"the region's mask is {scan.region.mask.shape[1]} x {scan.region.mask.shape[0]}"
            f" pixels, the frames of '{scan.name}' are {columns} x {rows}"
        )
    mask = scan.region.mask[row : row + height, column : column + width]
    return np.ascontiguousarray(mask), (column, row, width, height)


def _corners(mask: np.ndarray, side: int) -> np.ndarray:
    """Spread patches evenly over the image, and keep those that are inside the mask."""
    starts = []
    for length in mask.shape:
        room = length - side - 2 * BORDER_PX
        count = max(2, 1 + round(room / (side / 2)))
        starts.append(BORDER_PX + np.rint(np.linspace(0, room, count)).astype(np.int64))
    area = np.zeros((mask.shape[0] + 1, mask.shape[1] + 1))
    area[1:, 1:] = mask.cumsum(0).cumsum(1)
    top, left = (index.ravel() for index in np.meshgrid(*starts, indexing="ij"))
    inside = (
        area[top + side, left + side]
        - area[top, left + side]
        - area[top + side, left]
        + area[top, left]
    )
    return np.stack((top, left), axis=-1)[inside >= INSIDE * side * side]


def _redundancy(mask: np.ndarray, corners: np.ndarray, side: int) -> float:
    covered = np.zeros_like(mask)
    for row, column in corners:
        covered[row : row + side, column : column + side] = True
    return len(corners) * side**2 / int(covered.sum())
