"""Another field of view or another pixel size, with geometry kept true."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from sonosweep.errors import ScanError
from sonosweep.geometry import pose_from_parts
from sonosweep.scan.calibration import Calibration, pixel_to_image
from sonosweep.scan.frames import Frames, FrameView, LazyFrames
from sonosweep.scan.region import Region
from sonosweep.scan.scan import Scan

LARGEST_SIDE_PX = 8192  # a frame of this size fills 268 MB on the way


def crop_scan(scan: Scan, rectangle_px: tuple[int, int, int, int]) -> Scan:
    """Return the scan with only a rectangle of each frame.

    The image origin moves to the new first pixel, and poses, calibration and companions
    follow, so that every pixel that is kept stays where it was. Of the region that part
    remains which lies in the rectangle; if there is none, the scan has no region.

    Args:
        scan: What was recorded.
        rectangle_px: ``(column, row, width, height)`` to keep.

    Raises:
        ScanError: If the rectangle is empty or reaches outside the frame.
    """
    column, row, width, height = rectangle_px
    rows, columns = scan.frames.shape[1:3]
    inside = column >= 0 and row >= 0 and column + width <= columns and row + height <= rows
    if not inside or min(width, height) < 1:
        raise ScanError(f"crop {rectangle_px} does not fit a frame of {columns} x {rows} pixels")
    cropped = replace(
        scan,
        frames=FrameView(scan.frames, rectangle_px=rectangle_px),
        region=None if scan.region is None else _crop_region(scan.region, rectangle_px),
    )
    if scan.calibration is None:
        return cropped
    shift = pixel_to_image(scan.calibration)[:3, :2] @ torch.tensor(
        [column, row], dtype=torch.float64
    )
    return _move_origin(cropped, shift)


def crop_scan_center(scan: Scan, width: int = 320, height: int = 320) -> Scan:
    """Return the scan with only the middle of each frame; 320 x 320 as in the paper.

    References:
        Lee et al., section "Dataset 3".
    """
    rows, columns = scan.frames.shape[1:3]
    return crop_scan(scan, ((columns - width) // 2, (rows - height) // 2, width, height))


def resample_scan(scan: Scan, width: int = 256, height: int = 256) -> Scan:
    """Return the scan with frames resized to ``width`` x ``height`` pixels.

    Smaller frames hold means over areas, larger ones are interpolated linearly. The field of
    view stays; spacing, image origin and poses follow.

    Raises:
        ScanError: If a size is below 1 or above 8192 pixels.
    """
    rows, columns = scan.frames.shape[1:3]
    if min(width, height) < 1 or max(width, height) > LARGEST_SIDE_PX:
        raise ScanError(
            f"frames cannot be resized to {width} x {height} pixels: give 1 to"
            f" {LARGEST_SIDE_PX} each way"
        )
    region = None
    if scan.region is not None:
        region = _resize_region(scan.region, (columns, rows), (width, height))
    resized = replace(scan, frames=ResizedFrames(scan.frames, width, height), region=region)
    if scan.calibration is None:
        return resized
    factor = (columns / width, rows / height)
    old = scan.calibration
    # The outer edges of the image stay, so the centre of the first pixel moves inwards.
    centre = torch.tensor([(factor[0] - 1) / 2, (factor[1] - 1) / 2], dtype=torch.float64)
    shift = pixel_to_image(old)[:3, :2] @ centre
    spacing = (old.spacing_mm[0] * factor[0], old.spacing_mm[1] * factor[1])
    return _move_origin(replace(resized, calibration=replace(old, spacing_mm=spacing)), shift)


class ResizedFrames(LazyFrames):
    """Frames resized as they are read, as :func:`resize_frame` does."""

    def __init__(self, frames: Frames, width: int, height: int) -> None:
        super().__init__((len(frames), height, width, *frames.shape[3:]), frames.dtype)
        self._frames = frames

    def _read(self, frame: int) -> np.ndarray:
        rows, columns = self.shape[1:3]
        return resize_frame(np.asarray(self._frames[frame]), columns, rows)


def resize_frame(frame: np.ndarray, width: int, height: int) -> np.ndarray:
    """Return a frame of another size with the same outer edges.

    Along an axis that gets fewer pixels, each is the mean of what it covers; along one that
    gets more, they are interpolated linearly.
    """
    if frame.ndim == 3:
        planes = [resize_frame(frame[..., c], width, height) for c in range(frame.shape[2])]
        return np.stack(planes, axis=-1)
    image = Image.fromarray(np.ascontiguousarray(frame, dtype=np.float32))
    for size in ((width, image.height), (width, height)):
        fewer = size[0] <= image.width and size[1] <= image.height
        image = image.resize(size, Image.Resampling.BOX if fewer else Image.Resampling.BILINEAR)
    resized = np.asarray(image)
    if np.issubdtype(frame.dtype, np.integer):
        resized = np.rint(resized)
    return resized.astype(frame.dtype)


def _crop_region(region: Region, rectangle_px: tuple[int, int, int, int]) -> Region | None:
    """Return the part of the region within a rectangle, counted from its corner."""
    column, row, width, height = rectangle_px
    x, y, region_width, region_height = region.rectangle_px
    left, top = max(x - column, 0), max(y - row, 0)
    right = min(x + region_width - column, width)
    bottom = min(y + region_height - row, height)
    if left >= right or top >= bottom:
        return None
    mask = None
    if region.mask is not None:
        mask = region.mask[row : row + height, column : column + width]
    return Region((left, top, right - left, bottom - top), mask)


def _resize_region(region: Region, old: tuple[int, int], new: tuple[int, int]) -> Region:
    """Return the region on frames of another size, no larger than it was but one pixel at least."""
    scale = (new[0] / old[0], new[1] / old[1])
    column, row, width, height = region.rectangle_px
    left = min(int(np.ceil(column * scale[0])), new[0] - 1)
    top = min(int(np.ceil(row * scale[1])), new[1] - 1)
    right, bottom = int((column + width) * scale[0]), int((row + height) * scale[1])
    mask = None
    if region.mask is not None:
        mask = resize_frame(region.mask.astype(np.float32), *new) > 1 - 1e-3
    return Region((left, top, max(right - left, 1), max(bottom - top, 1)), mask)


def _move_origin(scan: Scan, shift_mm: Float[Tensor, "xyz=3"]) -> Scan:
    """Return the scan with its image origin moved to ``shift_mm`` of the old image."""
    assert scan.calibration is not None
    new_to_old = pose_from_parts(torch.eye(3, dtype=torch.float64), shift_mm)
    calibration: Calibration = scan.calibration
    if calibration.image_to_probe is not None:
        calibration = replace(calibration, image_to_probe=calibration.image_to_probe @ new_to_old)
    poses = scan.image_to_reference
    companions = {
        name: replace(
            companion,
            origin_mm=(
                companion.origin_mm[0] - float(shift_mm[0]),
                companion.origin_mm[1] - float(shift_mm[1]),
            ),
        )
        for name, companion in scan.companions.items()
    }
    return replace(
        scan,
        calibration=calibration,
        image_to_reference=None if poses is None else poses @ new_to_old,
        companions=companions,
    )
