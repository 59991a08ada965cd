"""One picture of a volume of vessels, as in the paper's figures."""

import os

import numpy as np
from PIL import Image, ImageDraw

from sonosweep.geometry import invert_pose
from sonosweep.io.atomic import write_beside
from sonosweep.scan import Trajectory, Volume
from sonosweep.view.panels import PAPER, draw_scale_bar, draw_words, panel_with
from sonosweep.view.payload import name_axes
from sonosweep.view.projections import Picture, best_covered
from sonosweep.view.svg import number_label
from sonosweep.view.vessels import (
    DepthMap,
    VesselPictures,
    depth_color,
    shown_name,
    vessel_axes,
    vessel_pictures,
)

WIDTH, GAP, TOP = 1600, 16, 64
LARGE = (776, 560)
SMALL = (512, 400)
BAR_ROOM = 96  # for the colours of depth and their millimetres


def write_vessel_picture(
    path: str | os.PathLike,
    vessels: Volume,
    b_mode: Volume,
    trajectory: Trajectory,
    name: str,
) -> None:
    """Write a PNG: vessels over the B-mode, their depth map, and a cross-section.

    Args:
        path: Where; replaced only when the whole file is written.
        vessels: Such as power Doppler.
        b_mode: On the same grid.
        trajectory: Of the sweep; its first frame says where to look from.
        name: Of the modality.

    Raises:
        FormatError: If the file cannot be written.
    """
    names = name_axes(vessels, trajectory)
    axes, to_first = vessel_axes(names), invert_pose(trajectory.image_to_reference[0]).numpy()
    made = vessel_pictures(vessels, b_mode, to_first, axes, best_covered(b_mode), max(LARGE))
    size = (WIDTH, TOP + LARGE[1] + 2 * GAP + SMALL[1])
    picture = Image.new("RGB", size, PAPER)
    along = f"{names[axes[1]]} {made.section_mm:.1f} mm"
    draw_words(
        ImageDraw.Draw(picture),
        (GAP, 20),
        f"{shown_name(name)}: through the B-mode volume; maximum along the {names[axes[0]]} axis,"
        f" colour is the place along it; B-mode at {along} (dashed); maximum along the sweep",
        19,
    )
    left = GAP
    for panel in (_plain(made.over_b_mode, LARGE), _mapped(made)):
        picture.paste(panel, (left, TOP))
        left += LARGE[0] + GAP
    for k, shown in enumerate((made.cross_section, made.overlaid, made.maximum)):
        picture.paste(_plain(shown, SMALL), (GAP + k * (SMALL[0] + GAP), TOP + LARGE[1] + GAP))
    with write_beside(path) as temporary:
        picture.save(temporary, "PNG")  # optimizing takes seconds and saves little


def _plain(picture: Picture | None, size: tuple[int, int]) -> Image.Image:
    if picture is None:
        return Image.new("RGB", size)
    panel, scale, _ = panel_with(picture.pixels, size, 12)
    draw_scale_bar(panel, scale / picture.mm_per_pixel)
    return panel


def _mapped(made: VesselPictures) -> Image.Image:
    """Return the depth map with a line at the cross-section and its colours at the right."""
    mapped = made.depth_map
    room = (LARGE[0] - BAR_ROOM, LARGE[1])
    panel, scale, (left, top) = panel_with(mapped.picture.pixels, room, 12)
    per_mm = scale / mapped.picture.mm_per_pixel
    draw = ImageDraw.Draw(panel)
    place = made.section_mm * per_mm
    for start in range(0, max(room), 14):
        if made.section_down:
            draw.line((start, top + place, start + 7, top + place), fill=(255, 255, 255))
        else:
            draw.line((left + place, start, left + place, start + 7), fill=(255, 255, 255))
    draw_scale_bar(panel, per_mm)
    whole = Image.new("RGB", LARGE)
    whole.paste(panel, (0, 0))
    _color_bar(whole, mapped)
    return whole


def _color_bar(panel: Image.Image, mapped: DepthMap) -> None:
    """Draw the colours from near (above) to far (below), with both ends in mm."""
    height = LARGE[1] - 120
    colors = depth_color((np.arange(height) + 0.5) / height)
    bar = np.rint(colors).astype(np.uint8)[:, None].repeat(22, axis=1)
    panel.paste(Image.fromarray(bar), (LARGE[0] - 40, 60))
    draw, right = ImageDraw.Draw(panel), LARGE[0] - 16
    near, far = (f"{number_label(round(mm, 1))} mm" for mm in mapped.span_mm)
    draw_words(draw, (right, 52), near, 17, "rs")
    draw_words(draw, (right, 60 + height + 22), far, 17, "rs")
