"""Pictures of volumes: cuts, projections, overlays and differences.

A picture is uint8 with square pixels, whatever the voxels are. Along its rows and columns
run two axes of the volume: (x, y), (x, z) or (z, y), the first to the right and the second
down.
"""

import io
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from sonosweep.errors import ScanError
from sonosweep.scan import Volume, VolumeGrid
from sonosweep.view.resample import finite, scalar

AXES = "xyz"
PLANES = ((0, 1), (0, 2), (2, 1))  # axis to the right, axis down
MAX_PIXELS = 800
SAMPLES = 2_000_000  # voxels that decide on black and white; reading all takes seconds
SLAB_BYTES = 64 << 20
PNG_BYTES = 160_000  # noise does not compress; above this a report uses JPEG

Window = tuple[float, float]


@dataclass(frozen=True, eq=False)
class Picture:
    """Pixels with a size in mm.

    Attributes:
        pixels: ``(rows, columns)`` or ``(rows, columns, 3)``.
        mm_per_pixel: Edge of a pixel.
        right: Name of the axis that runs to the right.
        down: Name of the axis that runs down.
        title: What it shows.
    """

    pixels: UInt8[np.ndarray, "rows columns *colors"]
    mm_per_pixel: float
    right: str
    down: str
    title: str = ""

    @property
    def width_mm(self) -> float:
        """Width from edge to edge."""
        return self.pixels.shape[1] * self.mm_per_pixel


def display_window(volume: Volume) -> Window:
    """Return the values that become black and white: where 0.5 and 99.7 % of voxels lie.

    Voxels that hold 0, are not finite, or were not seen, do not count. Black is 0 when the
    values do not go below.
    """
    values = _sample(volume)
    if len(values) == 0:
        return 0.0, 1.0
    low, high = (float(x) for x in np.percentile(values, [0.5, 99.7]))
    low = min(low, 0.0) if low <= 0 or np.issubdtype(volume.voxels.dtype, np.integer) else low
    return open_window(low, high)


def best_covered(volume: Volume) -> tuple[int, int, int]:
    """Return the voxel (x, y, z) in the middle of what was seen: the median of each axis."""
    step = _stride(volume.voxels.shape[:3], SAMPLES)
    seen = volume.voxels if volume.coverage is None else volume.coverage
    part = scalar(seen[::step, ::step, ::step])
    found = np.nonzero(finite(part))
    if len(found[0]) == 0:
        x, y, z = volume.grid.size
        return x // 2, y // 2, z // 2
    z, y, x = (int(np.median(index)) * step for index in found)
    return x, y, z


def orthogonal_cuts(
    volume: Volume,
    at: tuple[int, int, int] | None = None,
    window: Window | None = None,
    max_pixels: int = MAX_PIXELS,
) -> tuple[Picture, Picture, Picture]:
    """Return the three cuts through one voxel.

    Args:
        volume: What to cut.
        at: Voxel (x, y, z); the middle of what was seen when ``None``.
        window: Values shown black and white; :func:`display_window` when ``None``.
        max_pixels: Longest edge of a picture.
    """
    voxel = at or best_covered(volume)
    shown = window or display_window(volume)
    pictures = []
    for right, down in PLANES:
        through = _third(right, down)
        values = scalar(_slice(volume.voxels, through, voxel[through]))
        title = f"{AXES[right]}{AXES[down]} cut at {AXES[through]} = {voxel[through]}"
        gray = to_gray(oriented(values, right, down), shown)
        pictures.append(as_picture(gray, volume.grid, right, down, title, max_pixels))
    return pictures[0], pictures[1], pictures[2]


def projections(
    volume: Volume,
    mode: Literal["maximum", "mean"] = "maximum",
    window: Window | None = None,
    max_pixels: int = MAX_PIXELS,
) -> tuple[Picture, Picture, Picture]:
    """Return the projections along z, y and x.

    Args:
        volume: What to project.
        mode: The mean counts only what is not 0.
        window: Values shown black and white; when ``None`` white is what 0.5 % of the
            projected pixels exceed, which is more than :func:`display_window` has.
        max_pixels: Longest edge of a picture.
    """
    flat = _maxima(volume.voxels) if mode == "maximum" else _means(volume.voxels)
    shown = window or _projected_window(flat, display_window(volume)[0])
    pictures = []
    for (right, down), values in zip(PLANES, flat, strict=True):
        through = _third(right, down)
        title = f"{mode} along {AXES[through]}"
        gray = to_gray(oriented(values, right, down), shown)
        pictures.append(as_picture(gray, volume.grid, right, down, title, max_pixels))
    return pictures[0], pictures[1], pictures[2]


def difference_cuts(
    first: Volume,
    second: Volume,
    at: tuple[int, int, int] | None = None,
    max_pixels: int = MAX_PIXELS,
) -> tuple[Picture, Picture, Picture]:
    """Return cuts of the absolute difference of two volumes on one grid.

    White is a difference as large as the first volume's brightest voxels.

    Raises:
        ScanError: If the grids differ.
    """
    if first.grid != second.grid:
        raise ScanError("only volumes on the same grid can be subtracted; compound both onto one")
    voxel, shown = at or best_covered(first), display_window(first)
    pictures = []
    for right, down in PLANES:
        through = _third(right, down)
        a, b = (
            scalar(_slice(one.voxels, through, voxel[through])).astype(np.float32)
            for one in (first, second)
        )
        gray = to_gray(oriented(np.abs(a - b), right, down), (0.0, shown[1] - min(shown[0], 0.0)))
        title = f"|difference| at {AXES[through]} = {voxel[through]}"
        pictures.append(as_picture(gray, first.grid, right, down, title, max_pixels))
    return pictures[0], pictures[1], pictures[2]


def overlay(base: Picture, companion: Picture, opacity: float = 0.9) -> Picture:
    """Return a gray picture with a companion over it in hot colours; black hides nothing.

    The companion is stretched to the base's pixels: both must show the same box.
    """
    size = (base.pixels.shape[1], base.pixels.shape[0])
    strength = np.asarray(Image.fromarray(companion.pixels).resize(size, Image.Resampling.BILINEAR))
    alpha = np.clip(strength / 96.0, 0, 1)[..., None] * opacity
    gray = np.repeat(base.pixels[..., None], 3, axis=-1)
    mixed = gray * (1 - alpha) + hot_color(strength / 255.0) * alpha
    pixels = np.rint(mixed).astype(np.uint8)
    return Picture(pixels, base.mm_per_pixel, base.right, base.down, companion.title)


def encode_png(picture: Picture) -> bytes:
    """Return the picture as a PNG file."""
    buffer = io.BytesIO()
    Image.fromarray(picture.pixels).save(buffer, "PNG", optimize=True)
    return buffer.getvalue()


def encode_small(picture: Picture) -> tuple[bytes, str]:
    """Return the picture as a file and its MIME type: PNG, or JPEG where PNG is large."""
    png = encode_png(picture)
    if len(png) <= PNG_BYTES:
        return png, "image/png"
    buffer = io.BytesIO()
    Image.fromarray(picture.pixels).save(buffer, "JPEG", quality=88)
    return buffer.getvalue(), "image/jpeg"


def to_gray(values: np.ndarray, window: Window) -> UInt8[np.ndarray, "*shape"]:
    """Return values as gray between black and white; what is not finite is black."""
    low, high = window
    scaled = (values.astype(np.float32) - low) * (255.0 / (high - low))
    return np.rint(np.clip(np.nan_to_num(scaled, posinf=255.0, neginf=0.0), 0, 255)).astype(
        np.uint8
    )


def hot_color(strength: np.ndarray) -> np.ndarray:
    """Return black, red, yellow, white for 0 to 1, as floats of 0 to 255."""
    ramp = np.clip(strength[..., None] * 3.0 - np.array([0.0, 1.0, 2.0]), 0, 1)
    return 255.0 * ramp


def _projected_window(flat: list[np.ndarray], low: float) -> Window:
    values = np.concatenate([one[one != 0].ravel() for one in flat]).astype(np.float64)
    return open_window(low, float(np.percentile(values, 99.5)) if len(values) else low)


def open_window(low: float, high: float) -> Window:
    """Return a window that can be divided by, around the one value that all voxels have."""
    return low, high if high > low else low + max(1.0, 1e-6 * abs(low))


def _third(right: int, down: int) -> int:
    return 3 - right - down


def _slice(voxels: np.ndarray, axis: int, index: int) -> np.ndarray:
    """Return the slice at an index of x, y or z; the array's axes are (z, y, x)."""
    return np.asarray(voxels[(slice(None),) * (2 - axis) + (index,)])


def oriented(values: np.ndarray, right: int, down: int) -> np.ndarray:
    """Turn a slice, whose rows are the higher axis, so that ``down`` runs down."""
    flat = values.mean(axis=-1, dtype=np.float32) if values.ndim == 3 else values
    return flat if down > right else flat.T


def _stride(shape: tuple[int, ...], samples: int) -> int:
    return max(1, int(np.ceil((np.prod(shape, dtype=float) / samples) ** (1 / 3))))


def _sample(volume: Volume) -> np.ndarray:
    step = _stride(volume.voxels.shape[:3], SAMPLES)
    values = scalar(np.asarray(volume.voxels[::step, ::step, ::step]))
    keep = np.isfinite(values) & (values != 0)
    if volume.coverage is not None:
        keep &= volume.coverage[::step, ::step, ::step] > 0
    return values[keep].astype(np.float64)


def _slabs(voxels: np.ndarray):
    """Yield where along z a slab starts and its values, few enough to hold in memory."""
    per_slice = int(np.prod(voxels.shape[1:])) * 4
    thickness = max(1, SLAB_BYTES // per_slice)
    for start in range(0, len(voxels), thickness):
        yield start, finite(scalar(np.asarray(voxels[start : start + thickness])))


def _maxima(voxels: np.ndarray) -> list[np.ndarray]:
    """Return the maxima along z, y and x; every voxel is read once."""
    along_z: np.ndarray | None = None
    along_y: list[np.ndarray] = []
    along_x: list[np.ndarray] = []
    for _, slab in _slabs(voxels):
        highest = slab.max(axis=0)
        along_z = highest if along_z is None else np.maximum(along_z, highest)
        along_y.append(slab.max(axis=1))
        along_x.append(slab.max(axis=2))
    return [np.asarray(along_z), np.concatenate(along_y), np.concatenate(along_x)]


def _means(voxels: np.ndarray) -> list[np.ndarray]:
    """Return the means along z, y and x of the voxels that are not 0."""
    total, count = np.zeros(voxels.shape[1:3]), np.zeros(voxels.shape[1:3], np.int64)
    along_y: list[np.ndarray] = []
    along_x: list[np.ndarray] = []
    for _, slab in _slabs(voxels):
        seen = slab != 0
        total += slab.sum(axis=0, dtype=np.float64)
        count += seen.sum(axis=0)
        for axis, means in ((1, along_y), (2, along_x)):
            sums = slab.sum(axis=axis, dtype=np.float64)
            means.append(sums / np.maximum(seen.sum(axis=axis), 1))
    return [total / np.maximum(count, 1), np.concatenate(along_y), np.concatenate(along_x)]


def maximum_and_place(voxels: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the maximum along x, y or z and its index there."""
    along = 2 - axis
    if along != 0:
        slabs = [(slab.max(axis=along), slab.argmax(axis=along)) for _, slab in _slabs(voxels)]
        return np.concatenate([s[0] for s in slabs]), np.concatenate([s[1] for s in slabs])
    slabs = [(slab.max(axis=0), slab.argmax(axis=0) + start) for start, slab in _slabs(voxels)]
    best, where = slabs[0]
    for highest, place in slabs[1:]:
        where = np.where(highest > best, place, where)
        best = np.maximum(best, highest)
    return best, where


def as_picture(
    pixels: np.ndarray, grid: VolumeGrid, right: int, down: int, title: str, max_pixels: int
) -> Picture:
    """Return pixels resampled to squares: as small as the finer spacing if there is room."""
    extents = [grid.size[axis] * grid.spacing_mm[axis] for axis in (right, down)]
    edge = max(min(grid.spacing_mm[right], grid.spacing_mm[down]), max(extents) / max_pixels)
    size = (max(1, round(extents[0] / edge)), max(1, round(extents[1] / edge)))
    image = Image.fromarray(np.ascontiguousarray(pixels)).resize(size, Image.Resampling.BILINEAR)
    return Picture(np.asarray(image), edge, AXES[right], AXES[down], title)
