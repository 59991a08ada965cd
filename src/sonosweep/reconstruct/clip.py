"""Which pixels of a frame count: a rectangle, a fan, a mask. The words are PLUS's."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Int

from sonosweep.errors import ScanError


@dataclass(frozen=True)
class Fan:
    """The sector that a curved or phased array shows.

    Attributes:
        angles_deg: Left and right edge, measured at the origin from straight down (along
            rows), positive towards larger columns.
        origin_px: (column, row) where the edges meet; may lie outside the frame.
        start_px: Radius where the image starts.
        stop_px: Radius where it ends.
    """

    angles_deg: tuple[float, float]
    origin_px: tuple[float, float]
    start_px: float = 0.0
    stop_px: float = 500.0

    def __post_init__(self) -> None:
        """Check that the fan has a size.

        Raises:
            ScanError: If an edge or radius is not finite, or they are in the wrong order.
        """
        numbers = (*self.angles_deg, *self.origin_px, self.start_px, self.stop_px)
        if not np.isfinite(numbers).all():
            raise ScanError(f"fan angles, origin and radii must be numbers, got {numbers}")
        if not -180 <= self.angles_deg[0] < self.angles_deg[1] <= 180:
            raise ScanError(
                f"fan angles must increase from left to right between -180 and 180 degrees, got"
                f" {self.angles_deg}"
            )
        if not 0 <= self.start_px < self.stop_px:
            raise ScanError(
                f"the fan must start before it stops, got radii {self.start_px:g} and"
                f" {self.stop_px:g} pixels"
            )


def pixel_mask(
    rows: int,
    columns: int,
    rectangle_px: tuple[int, int, int, int] | None = None,
    fan: Fan | None = None,
    mask: Bool[np.ndarray, "..."] | None = None,
) -> Bool[np.ndarray, "rows columns"]:
    """Return which pixels pass all clips.

    Args:
        rows: Of a frame.
        columns: Of a frame.
        rectangle_px: ``(column, row, width, height)`` to keep; the pixel at
            ``column + width`` is the first one outside.
        fan: Sector to keep, edges included.
        mask: Pixels to keep.

    Raises:
        ScanError: If the mask has another size than the frames, or no pixel is left.
    """
    kept = np.ones((rows, columns), dtype=bool)
    if mask is not None:
        if mask.shape != kept.shape:
            raise ScanError(f"a mask of shape {mask.shape} for frames of {rows} x {columns}")
        kept &= mask
    if rectangle_px is not None:
        column, row, width, height = rectangle_px
        inside = np.zeros_like(kept)
        inside[max(row, 0) : max(row + height, 0), max(column, 0) : max(column + width, 0)] = True
        kept &= inside
    if fan is not None:
        kept &= _inside_fan(rows, columns, fan)
    if not kept.any():
        raise ScanError("the clips leave no pixel: give them in pixels of this frame's size")
    return kept


def pixel_runs(
    mask: Bool[np.ndarray, "rows columns"],
) -> tuple[Int[np.ndarray, " rows+1"], Int[np.ndarray, "runs 2"]]:
    """Return the unbroken runs of kept pixels in each row.

    Loops over runs need no test per pixel.

    Returns:
        Index of the first run of each row and one past the last; first and one-past-last
        column of each run.
    """
    padded = np.zeros((mask.shape[0], mask.shape[1] + 2), dtype=np.int8)
    padded[:, 1:-1] = mask
    change = np.diff(padded, axis=1)
    start_rows, starts = np.nonzero(change == 1)
    _, stops = np.nonzero(change == -1)
    first_run = np.searchsorted(start_rows, np.arange(mask.shape[0] + 1))
    return first_run.astype(np.int64), np.stack((starts, stops), axis=1).astype(np.int64)


def _inside_fan(rows: int, columns: int, fan: Fan) -> np.ndarray:
    across = np.arange(columns) - fan.origin_px[0]
    down = (np.arange(rows) - fan.origin_px[1])[:, None]
    radius = np.hypot(across, down)
    angle_deg = np.degrees(np.arctan2(across, down))
    return (
        (radius >= fan.start_px)
        & (radius <= fan.stop_px)
        & (angle_deg >= fan.angles_deg[0])
        & (angle_deg <= fan.angles_deg[1])
    )
