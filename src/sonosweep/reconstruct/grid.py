"""The box of voxels that a sweep fills, and what filling it takes.

The axis-aligned box follows PLUS's rule, so that volumes can be compared voxel by voxel:
the origin is the smallest corner of all frames, and one voxel centre lies on it.
"""

import math
import os
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sonosweep.errors import ScanError
from sonosweep.geometry import nearest_rotation, transform_points
from sonosweep.scan import VolumeGrid, voxel_to_reference

MOST_VOXELS_ALONG_AN_AXIS = 2**21
"""Beyond this a pose or a unit is wrong: 0.1 mm voxels would span 200 m."""

_AXIS_ALIGNED = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def grid_of_sweep(
    image_to_reference: Float[Tensor, "frames 4 4"],
    pixel_to_image: Float[Tensor, "4 4"],
    rows: int,
    columns: int,
    voxel_mm: float | tuple[float, float, float],
    rectangle_px: tuple[int, int, int, int] | None = None,
    oriented: bool = False,
) -> VolumeGrid:
    """Return the smallest grid that holds all frames of a sweep.

    The origin is the smallest corner of all frames and the size along an axis is
    ``round((largest - smallest) / voxel) + 1``, as in PLUS.

    Args:
        image_to_reference: Pose of each frame, mm.
        pixel_to_image: From (column, row, 0, 1) to image mm.
        rows: Of a frame.
        columns: Of a frame.
        voxel_mm: Spacing of the voxels, one for all axes or one each.
        rectangle_px: Only this ``(column, row, width, height)`` of each frame counts.
        oriented: Turn the box with the sweep: x along the mean lateral direction, y along
            the mean axial one. A sweep at an angle to the reference then takes a fraction
            of the voxels. Otherwise the box is along the reference's axes.

    Raises:
        ScanError: If there are no frames, a pose is not finite, the rectangle does not meet
            the frame, or the sweep spans an absurd number of voxels.
    """
    check_poses(image_to_reference)
    spacing = np.broadcast_to(np.asarray(voxel_mm, dtype=np.float64), 3)
    if not (np.isfinite(spacing).all() and (spacing > 0).all()):
        raise ScanError(f"voxels must be larger than 0 mm, got {voxel_mm}")
    direction = _mean_axes(image_to_reference) if oriented else _AXIS_ALIGNED
    corners = _corners_px(rows, columns, rectangle_px)
    points = transform_points(image_to_reference @ pixel_to_image, corners).reshape(-1, 3)
    along = points.numpy() @ np.asarray(direction)
    smallest, largest = along.min(axis=0), along.max(axis=0)
    extent = (largest - smallest) / spacing
    if not extent.max() < MOST_VOXELS_ALONG_AN_AXIS:
        raise ScanError(
            f"the sweep spans {(largest - smallest).max():.4g} mm, {extent.max():.3g} voxels of"
            f" {spacing.min():g} mm: check the poses and their unit, which must be mm"
        )
    return VolumeGrid(
        size=tuple(math.floor(value + 0.5) + 1 for value in extent.tolist()),
        spacing_mm=tuple(spacing.tolist()),
        origin_mm=tuple((np.asarray(direction) @ smallest).tolist()),
        direction=direction,
    )


def pixel_to_voxel(
    image_to_reference: Float[Tensor, "frames 4 4"],
    pixel_to_image: Float[Tensor, "4 4"],
    grid: VolumeGrid,
) -> Float[np.ndarray, "frames 3 3"]:
    """Return per frame the matrix from (column, row, 1) to voxel coordinates (x, y, z)."""
    reference_to_voxel = torch.linalg.inv(voxel_to_reference(grid))
    matrix = reference_to_voxel @ image_to_reference.to(torch.float64) @ pixel_to_image
    return np.ascontiguousarray(matrix[:, :3, [0, 1, 3]].numpy())


def check_poses(image_to_reference: Float[Tensor, "frames 4 4"]) -> None:
    """Refuse a sweep without frames, or with a pose that is not finite.

    Raises:
        ScanError: Which names the first such frame.
    """
    if len(image_to_reference) == 0:
        raise ScanError("the sweep has no frames to put into a volume")
    if not np.isfinite(image_to_reference.numpy()).all():
        bad = ~torch.isfinite(image_to_reference).flatten(1).all(-1)
        raise ScanError(
            f"the pose of frame {int(bad.nonzero()[0])} holds values that are not numbers; leave"
            " out the frames that were not tracked"
        )


def estimate_bytes(
    grid: VolumeGrid, bytes_per_voxel: int = 1, working_bytes_per_voxel: int = 0
) -> int:
    """Return how much memory a dense volume with its coverage takes.

    Args:
        grid: Where the voxels are.
        bytes_per_voxel: Of the result: of the pixel type, times the channels.
        working_bytes_per_voxel: Held beside the result until it is finished.
    """
    return math.prod(grid.size) * (bytes_per_voxel + 1 + working_bytes_per_voxel)


def check_memory(
    grid: VolumeGrid,
    bytes_per_voxel: int = 1,
    working_bytes_per_voxel: int = 0,
    limit_bytes: int | None = None,
) -> int:
    """Return the bytes that a volume will take, or refuse before any is allocated.

    Args:
        grid: Where the voxels are.
        bytes_per_voxel: As in :func:`estimate_bytes`.
        working_bytes_per_voxel: As in :func:`estimate_bytes`.
        limit_bytes: What may be used; nine tenths of the free memory if ``None``.

    Raises:
        ScanError: If the limit is passed; it says which voxel size would fit.
    """
    needed = estimate_bytes(grid, bytes_per_voxel, working_bytes_per_voxel)
    limit = int(0.9 * free_bytes()) if limit_bytes is None else limit_bytes
    if needed <= limit:
        return needed
    # A tenth of a per cent more, because sizes are rounded up to whole voxels.
    fitting_mm = max(grid.spacing_mm) * (needed / max(limit, 1)) ** (1 / 3) * 1.001
    digits = 10.0 ** (math.floor(math.log10(fitting_mm)) - 1)
    raise ScanError(
        f"a volume of {' x '.join(str(n) for n in grid.size)} voxels of"
        f" {' x '.join(f'{s:g}' for s in grid.spacing_mm)} mm needs {needed / 1e9:,.1f} GB and"
        f" {limit / 1e9:,.1f} GB can be used: take voxels of"
        f" {math.ceil(fitting_mm / digits) * digits:.6g} mm or larger"
    )


def free_bytes() -> int:
    """Return how much memory this process can still have, as the system tells it."""
    found = [_meminfo_bytes(), _control_group_bytes()]
    known = [value for value in found if value is not None]
    if known:
        return min(known)
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):
        return 8 * 2**30  # a system that does not tell: assume a small laptop


def _meminfo_bytes() -> int | None:
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return None
    fields = dict(line.split(":", 1) for line in lines if ":" in line)
    available = fields.get("MemAvailable")
    return None if available is None else int(available.split()[0]) * 1024


def _control_group_bytes() -> int | None:
    """What the container's limit leaves; its file cache counts as free."""
    group = Path("/sys/fs/cgroup")
    try:
        limit = int((group / "memory.max").read_text())
        used = int((group / "memory.current").read_text())
        statistics = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())
        return max(limit - used + int(statistics.get("file", 0)), 0)
    except (OSError, ValueError):  # no container, or "max": no limit
        return None


def _corners_px(
    rows: int, columns: int, rectangle_px: tuple[int, int, int, int] | None
) -> Float[Tensor, "points=4 xyz=3"]:
    """Corners of the clipped frame in pixels, with PLUS's rule for the far side."""
    left, top, right, bottom = 0, 0, columns - 1, rows - 1
    if rectangle_px is not None:
        column, row, width, height = rectangle_px
        left, right = max(left, column), min(right, column + width)
        top, bottom = max(top, row), min(bottom, row + height)
    if left > right or top > bottom:
        raise ScanError(
            f"the clip rectangle {rectangle_px} (column, row, width, height) does not meet the"
            f" frame of {columns} x {rows} pixels"
        )
    corners = [[left, top, 0], [right, top, 0], [right, bottom, 0], [left, bottom, 0]]
    return torch.tensor(corners, dtype=torch.float64)


def _mean_axes(
    image_to_reference: Float[Tensor, "frames 4 4"],
) -> tuple[tuple[float, float, float], ...]:
    """Rows of the rotation that is nearest to all frames' rotations."""
    mean = image_to_reference[:, :3, :3].to(torch.float64).mean(dim=0)
    return tuple(tuple(row) for row in nearest_rotation(mean).tolist())
