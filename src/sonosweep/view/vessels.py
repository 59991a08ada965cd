"""Pictures of vessels, as in the paper: over the B-mode, and projected with depth as colour."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from sonosweep.scan import Volume
from sonosweep.view.projections import (
    PLANES,
    Picture,
    Window,
    as_picture,
    maximum_and_place,
    open_window,
    oriented,
    orthogonal_cuts,
    overlay,
    projections,
    to_gray,
)
from sonosweep.view.render import render_volume
from sonosweep.view.resample import scalar

BACKGROUND_PERCENTILE = 90  # of what was seen; vessels fill less than a tenth of a volume
SAMPLES = 2_000_000  # voxels that decide on it
WHITE_PERCENTILE = 99.5
BEHIND = 0.55  # brightness of the B-mode behind vessels
DEPTH_COLORS = np.array(
    [[255, 236, 110], [250, 140, 70], [214, 62, 110], [136, 60, 170], [60, 90, 235]], np.float64
)
"""From near to far: yellow, red, violet, blue."""


@dataclass(frozen=True, eq=False)
class DepthMap:
    """A maximum amplitude projection, coloured by where along the axis the maximum lies.

    Attributes:
        picture: The projection.
        axis: 0, 1 or 2: along which it was projected.
        span_mm: Distance from the edge of the volume at the first and the last colour.
        window: Values shown black and fully bright.
    """

    picture: Picture
    axis: int
    span_mm: tuple[float, float]
    window: Window


@dataclass(frozen=True, eq=False)
class VesselPictures:
    """The pictures of one volume of vessels.

    Attributes:
        depth_map: Its projection.
        maximum: Its maximum along the sweep.
        over_b_mode: Seen obliquely with the B-mode behind; ``None`` without one on its grid.
        cross_section: The B-mode across the sweep; ``None`` as above.
        overlaid: The same with the vessels over it; ``None`` as above.
        section_mm: How far down (or to the right) in the depth map the cross-section lies.
        section_down: Whether it is down.
    """

    depth_map: DepthMap
    maximum: Picture
    over_b_mode: Picture | None
    cross_section: Picture | None
    overlaid: Picture | None
    section_mm: float
    section_down: bool


def vessel_pictures(
    vessels: Volume,
    b_mode: Volume | None,
    reference_to_view: Float[np.ndarray, "4 4"],
    axes: tuple[int, int],
    at: tuple[int, int, int],
    pixels: int,
) -> VesselPictures:
    """Return the pictures of a volume of vessels.

    Args:
        vessels: Such as power Doppler.
        b_mode: Of the same sweep.
        reference_to_view: The axes of the oblique view, such as those of the first frame.
        axes: Axes of the volume nearest to depth and to the direction of the sweep.
        at: Voxel (x, y, z) through which the cross-section goes.
        pixels: Longest edge of a picture.
    """
    depth, along = axes
    mapped = depth_map(vessels, depth, max_pixels=pixels)
    plane = next(k for k, plane in enumerate(PLANES) if along not in plane)
    over = section = overlaid = None
    if b_mode is not None and b_mode.grid == vessels.grid:
        over = _over_b_mode(vessels, b_mode, reference_to_view, mapped.window, pixels)
        section = orthogonal_cuts(b_mode, at, max_pixels=pixels)[plane]
        cut = orthogonal_cuts(vessels, at, mapped.window, pixels)[plane]
        overlaid = overlay(section, cut)
    return VesselPictures(
        mapped,
        projections(vessels, "maximum", mapped.window, pixels)[plane],
        over,
        section,
        overlaid,
        (at[along] + 0.5) * vessels.grid.spacing_mm[along],
        mapped.picture.down == "xyz"[along],
    )


def depth_map(
    volume: Volume, axis: int = 1, window: Window | None = None, max_pixels: int = 800
) -> DepthMap:
    """Return the maximum along an axis, coloured by where along it the maximum lies.

    Colours run from yellow (small index) over red and violet to blue (large index), over the
    range in which there is something bright.

    Args:
        volume: What to project.
        axis: 0, 1 or 2 for x, y or z; 1 is depth where the first frame is the reference.
        window: Values shown black and fully bright; when ``None`` black is what nine tenths
            of the voxels are darker than.
        max_pixels: Longest edge of the picture.
    """
    right, down = next(plane for plane in PLANES if axis not in plane)
    extent_mm = np.multiply(volume.grid.size, volume.grid.spacing_mm)
    if extent_mm[down] > extent_mm[right]:
        right, down = down, right
    values, where = maximum_and_place(volume.voxels, axis)
    shown = window or _vessel_window(volume, values)
    gray = to_gray(oriented(values, right, down), shown)
    place = oriented(where, right, down)
    near, far = _bright_span(gray, place, volume.grid.size[axis])
    color = depth_color((place - near) / (far - near)) * (gray[..., None] / 255.0)
    title = f"maximum along {'xyz'[axis]}, colour shows {'xyz'[axis]}"
    pixels = np.rint(color).astype(np.uint8)
    picture = as_picture(pixels, volume.grid, right, down, title, max_pixels)
    spacing = volume.grid.spacing_mm[axis]
    return DepthMap(picture, axis, ((near + 0.5) * spacing, (far + 0.5) * spacing), shown)


def depth_color(depth: np.ndarray) -> np.ndarray:
    """Return the colour of a depth of 0 (near) to 1 (far), as floats of 0 to 255."""
    places = np.linspace(0, 1, len(DEPTH_COLORS))
    return np.stack([np.interp(depth, places, DEPTH_COLORS[:, k]) for k in range(3)], axis=-1)


def shown_name(name: str) -> str:
    """Return a companion's name as people write it."""
    words = name.replace("_", " ")
    return {"power doppler": "Power Doppler"}.get(words, words[:1].upper() + words[1:])


def vessel_axes(names: tuple[str, str, str]) -> tuple[int, int]:
    """Return the axes for depth and for the direction of the sweep, given their names.

    Where the volume is not along the first frame, y is taken for depth and z for the sweep,
    or what is left of the axes.
    """
    named = {name: k for k, name in enumerate(names)}
    depth, along = named.get("axial"), named.get("elevational")
    if depth is None:
        depth = next(k for k in (1, 2, 0) if k != along)
    if along is None:
        along = next(k for k in (2, 0, 1) if k != depth)
    return depth, along


def _vessel_window(volume: Volume, projected: np.ndarray) -> Window:
    """Return black and white: above the background, and where little is brighter."""
    bright = projected[np.isfinite(projected)].astype(np.float64)
    background = _covered(volume)
    if len(bright) == 0 or len(background) == 0:
        return 0.0, 1.0
    low = float(np.percentile(background, BACKGROUND_PERCENTILE))
    return open_window(low, float(np.percentile(bright, WHITE_PERCENTILE)))


def _covered(volume: Volume) -> np.ndarray:
    """Return values of the voxels that were seen, or of every so many of them."""
    step = max(1, round((volume.voxels.size / SAMPLES) ** (1 / 3)))
    values = scalar(np.asarray(volume.voxels[::step, ::step, ::step]))
    seen = np.isfinite(values)
    if volume.coverage is not None:
        seen &= volume.coverage[::step, ::step, ::step] > 0
    return values[seen].astype(np.float64)


def _bright_span(gray: np.ndarray, place: np.ndarray, size: int) -> tuple[int, int]:
    """Return the indices between which almost all that is brighter than half lies."""
    bright = place[gray > 127]
    if len(bright) == 0:
        return 0, max(size - 1, 1)
    near, far = (int(index) for index in np.percentile(bright, [1, 99], method="nearest"))
    return near, max(far, near + 1)


def _over_b_mode(
    vessels: Volume,
    b_mode: Volume,
    reference_to_view: Float[np.ndarray, "4 4"],
    window: Window,
    pixels: int,
) -> Picture:
    """Return the vessels, seen through the dimmed B-mode."""
    behind, bounds = render_volume(b_mode, reference_to_view, pixels=pixels)
    before, _ = render_volume(
        vessels, reference_to_view, pixels=pixels, window=window, brightest=True
    )
    edge = float(bounds[2] - bounds[0]) / behind.shape[1]
    rows, columns = filled(behind)
    dim = np.rint(behind[rows, columns] * BEHIND).astype(np.uint8)
    return overlay(
        Picture(dim, edge, "", ""),
        Picture(before[rows, columns], edge, "", "", "vessels over the B-mode volume"),
    )


def filled(pixels: np.ndarray, darkest: int = 8, margin: int = 12) -> tuple[slice, slice]:
    """Return the rows and columns where something is to be seen, and a little around them."""
    found = np.nonzero(pixels > darkest)
    if len(found[0]) == 0:
        return slice(None), slice(None)
    rows, columns = (
        slice(max(0, int(index.min()) - margin), int(index.max()) + margin + 1) for index in found
    )
    return rows, columns
