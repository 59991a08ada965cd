"""Volume rendering without a graphics card: rays through voxels from an oblique direction."""

import numpy as np
from jaxtyping import Float, UInt8
from numba import njit, prange

from sonosweep.scan import Volume
from sonosweep.view.camera import view_rotation
from sonosweep.view.projections import Window, display_window, to_gray
from sonosweep.view.resample import resample_volume

MAX_VOXELS = 3_000_000  # finer than a picture of 640 pixels can show along its depth
OPACITY_PER_MM = 0.22  # of a white voxel; darker ones go with the square of brightness
FAR_SHADE = 0.45  # brightness left at the far end of the volume, which gives depth


def render_volume(
    volume: Volume,
    reference_to_view: Float[np.ndarray, "4 4"] | None = None,
    rotation: Float[np.ndarray, "3 3"] | None = None,
    pixels: int = 640,
    window: Window | None = None,
    max_voxels: int = MAX_VOXELS,
) -> tuple[UInt8[np.ndarray, "rows columns"], Float[np.ndarray, "4"]]:
    """Return an oblique picture of a volume, and where it lies on the screen.

    Bright voxels are opaque and dark ones let them through; what is far is darker.

    Args:
        volume: What to show.
        reference_to_view: The coordinates in which the viewer's axes are, such as those of
            the first frame; the reference when ``None``.
        rotation: From those to the screen; :func:`view_rotation` when ``None``.
        pixels: Longest edge of the picture.
        window: Values shown black and white.
        max_voxels: A larger volume is thinned before.

    Returns:
        The picture, and its (left, top, right, bottom) edges on the screen in mm.
    """
    small = resample_volume(volume, max_voxels)
    gray = to_gray(small.voxels, window or display_window(small))
    turn = view_rotation() if rotation is None else rotation
    to_view = np.eye(4) if reference_to_view is None else reference_to_view
    voxel_to_screen = turn @ to_view[:3, :3] @ np.asarray(small.grid.direction)
    origin = turn @ (to_view[:3, :3] @ np.asarray(small.grid.origin_mm) + to_view[:3, 3])
    spacing = np.asarray(small.grid.spacing_mm)
    ends = np.array(small.grid.size) - 1.0
    corners = np.stack(np.meshgrid(*([0.0, end] for end in ends), indexing="ij"), -1).reshape(-1, 3)
    screen = (corners * spacing) @ voxel_to_screen.T + origin
    low, high = screen.min(axis=0), screen.max(axis=0)
    edge = float((high - low)[:2].max()) / pixels
    edge = max(edge, 1e-6)
    columns, rows = (max(1, int(np.ceil(span / edge))) for span in (high - low)[:2])
    # A screen point s is voxel (voxel_to_screen.T @ (s - origin)) / spacing.
    to_voxel = voxel_to_screen.T / spacing[:, None]
    start = to_voxel @ (
        np.array([low[0], low[1], low[2]]) + edge / 2 * np.array([1, 1, 0]) - origin
    )
    step_mm = float(spacing.min())
    picture = _march(
        gray,
        start,
        to_voxel[:, 0] * edge,
        to_voxel[:, 1] * edge,
        to_voxel[:, 2] * step_mm,
        np.array([rows, columns, int(np.ceil((high[2] - low[2]) / step_mm)) + 1]),
        OPACITY_PER_MM * step_mm,
    )
    bounds = np.array([low[0], low[1], low[0] + columns * edge, low[1] + rows * edge])
    return picture, bounds


@njit(cache=True, parallel=True)
def _march(voxels, start, right, down, away, counts, opacity):
    """Collect light along parallel rays, front to back, until little can be added."""
    rows, columns, steps = counts[0], counts[1], counts[2]
    depth, height, width = voxels.shape
    picture = np.zeros((rows, columns), np.uint8)
    for row in prange(rows):
        for column in range(columns):
            x0 = start[0] + row * down[0] + column * right[0]
            y0 = start[1] + row * down[1] + column * right[1]
            z0 = start[2] + row * down[2] + column * right[2]
            light, passing = 0.0, 1.0
            for step in range(steps):
                x, y, z = x0 + step * away[0], y0 + step * away[1], z0 + step * away[2]
                if x < 0 or y < 0 or z < 0 or x > width - 1 or y > height - 1 or z > depth - 1:
                    continue
                i, j, k = min(int(x), width - 2), min(int(y), height - 2), min(int(z), depth - 2)
                i, j, k = max(i, 0), max(j, 0), max(k, 0)
                value = _trilinear(voxels, i, j, k, x - i, y - j, z - k) / 255.0
                alpha = min(1.0, opacity * value * value)
                shade = 1.0 - (1.0 - FAR_SHADE) * step / steps
                light += passing * alpha * shade * (0.35 + 0.65 * value)
                passing *= 1.0 - alpha
                if passing < 0.02:
                    break
            picture[row, column] = np.uint8(min(255.0, 255.0 * light + 0.5))
    return picture


@njit(cache=True, inline="always")
def _trilinear(voxels, i, j, k, fx, fy, fz):
    """Interpolate between eight voxels; an axis of one voxel counts it twice."""
    i1, j1, k1 = (
        min(i + 1, voxels.shape[2] - 1),
        min(j + 1, voxels.shape[1] - 1),
        min(k + 1, voxels.shape[0] - 1),
    )
    near = (voxels[k, j, i] * (1 - fx) + voxels[k, j, i1] * fx) * (1 - fy) + (
        voxels[k, j1, i] * (1 - fx) + voxels[k, j1, i1] * fx
    ) * fy
    far = (voxels[k1, j, i] * (1 - fx) + voxels[k1, j, i1] * fx) * (1 - fy) + (
        voxels[k1, j1, i] * (1 - fx) + voxels[k1, j1, i1] * fx
    ) * fy
    return near * (1 - fz) + far * fz
