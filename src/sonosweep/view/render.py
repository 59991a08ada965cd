"""Volume rendering without a graphics card: rays through voxels from an oblique direction."""

import numpy as np
from jaxtyping import Float, UInt8

from sonosweep.scan import Volume
from sonosweep.view.camera import view_rotation
from sonosweep.view.projections import Window, display_window, to_gray
from sonosweep.view.render_kernel import march
from sonosweep.view.resample import resample_volume

MAX_VOXELS = 3_000_000  # finer than a picture of 640 pixels can show along its depth
OPACITY = 90.0  # of white voxels all along the diagonal; the square of brightness scales it
FAR_SHADE = 0.45  # brightness left at the far end of the volume, which gives depth


def render_volume(
    volume: Volume,
    reference_to_view: Float[np.ndarray, "4 4"] | None = None,
    rotation: Float[np.ndarray, "3 3"] | None = None,
    pixels: int = 640,
    window: Window | None = None,
    max_voxels: int = MAX_VOXELS,
    brightest: bool = False,
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
        brightest: Show the brightest voxel along each ray instead, whatever is before it.

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
    diagonal_mm = float(np.linalg.norm(spacing * np.array(small.grid.size)))
    picture = march(
        gray,
        start,
        to_voxel[:, 0] * edge,
        to_voxel[:, 1] * edge,
        to_voxel[:, 2] * step_mm,
        np.array([rows, columns, int(np.ceil((high[2] - low[2]) / step_mm)) + 1]),
        OPACITY * step_mm / diagonal_mm,
        FAR_SHADE,
        brightest,
    )
    bounds = np.array([low[0], low[1], low[0] + columns * edge, low[1] + rows * edge])
    return picture, bounds
