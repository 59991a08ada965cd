"""One picture of the whole job: a sweep goes in, a volume comes out."""

import os

import numpy as np
from PIL import Image, ImageChops, ImageDraw

from sonosweep.geometry import invert_pose
from sonosweep.io.atomic import write_beside
from sonosweep.scan import Frames, Trajectory, Volume
from sonosweep.view.camera import project, view_rotation
from sonosweep.view.figures import frame_outlines
from sonosweep.view.panels import FAINT, PAPER, draw_scale_bar, draw_words, panel_with
from sonosweep.view.projections import orthogonal_cuts
from sonosweep.view.render import render_volume
from sonosweep.view.resample import finite
from sonosweep.view.svg import number_label

SIZE = (1600, 700)
PANEL = (590, 580)
CUT = (236, 186)
TOP = 84
LEFTS = (24, 716, 1330)  # of the sweep, the volume and its cuts
FINE = 2  # lines are drawn larger and thinned, which smooths them
STACKED = 8  # frames; more hide each other
VOXELS = 20_000_000
OUTLINE, PATH = (86, 180, 233), (240, 144, 61)
BRIGHTER = 1.4  # frames are dark beside a rendering that gathers light over depth


def write_overview_picture(
    path: str | os.PathLike,
    frames: Frames,
    spacing_mm: tuple[float, float],
    trajectory: Trajectory,
    volume: Volume,
) -> None:
    """Write a PNG of 1600 x 700: frames along their trajectory, an arrow, the volume.

    Args:
        path: Where; replaced only when the whole file is written.
        frames: The B-mode frames of the sweep.
        spacing_mm: Distance between their neighbouring columns and rows.
        trajectory: Their poses.
        volume: What was made of them, in the same reference.

    Raises:
        FormatError: If the file cannot be written.
    """
    picture = Image.new("RGB", SIZE, PAPER)
    picture.paste(_sweep_panel(frames, spacing_mm, trajectory), (LEFTS[0], TOP))
    picture.paste(_volume_panel(volume, trajectory), (LEFTS[1], TOP))
    for k, cut in enumerate(orthogonal_cuts(volume, max_pixels=max(CUT))):
        picture.paste(panel_with(cut.pixels, CUT)[0], (LEFTS[2], TOP + k * (CUT[1] + 11)))
    draw = ImageDraw.Draw(picture)
    _arrow(draw, LEFTS[0] + PANEL[0] + 22, TOP + PANEL[1] // 2, 56)
    count = len(trajectory.image_to_reference)
    spacing = " x ".join(dict.fromkeys(number_label(round(s, 3)) for s in volume.grid.spacing_mm))
    size = " x ".join(str(n) for n in volume.grid.size)
    draw_words(draw, (LEFTS[0] + 4, 32), f"A sweep of {count} frames along their trajectory")
    draw_words(draw, (LEFTS[1] + 4, 32), f"A volume of {size} voxels of {spacing} mm, and its cuts")
    with write_beside(path) as temporary:
        picture.save(temporary, "PNG", optimize=True)


def _sweep_panel(
    frames: Frames, spacing_mm: tuple[float, float], trajectory: Trajectory
) -> Image.Image:
    """Return some frames where they were, see-through, and the path of the probe's face."""
    rows, columns = frames.shape[1:3]
    size_mm = ((columns - 1) * spacing_mm[0], (rows - 1) * spacing_mm[1])
    quads = project(frame_outlines([trajectory], size_mm)[0], view_rotation())[..., :2]
    quads, units_per_mm = _fitted(quads)
    panel = Image.new("RGB", _fine(PANEL), PAPER)
    chosen = np.unique(np.linspace(0, len(quads) - 1, STACKED).round().astype(int))
    for k in chosen:
        laid = _laid_frame(np.asarray(frames[int(k)]), quads[k, :4])
        panel = ImageChops.lighter(panel, laid)
        corners = [(float(x), float(y)) for x, y in quads[k, :4]]
        ImageDraw.Draw(panel).line([*corners, corners[0]], fill=OUTLINE, width=2 * FINE)
    draw = ImageDraw.Draw(panel)
    path = [(float(x), float(y)) for x, y in quads[:, 4]]
    draw.line([path[0], *path], fill=PATH, width=6 * FINE, joint="curve")
    (x, y), r = path[0], 7 * FINE
    draw.ellipse((x - r, y - r, x + r, y + r), fill=PAPER, outline=PATH, width=4 * FINE)
    panel = panel.reduce(FINE)
    draw_scale_bar(panel, units_per_mm / FINE)
    return panel


def _fine(size: tuple[int, int]) -> tuple[int, int]:
    return FINE * size[0], FINE * size[1]


def _fitted(points_mm: np.ndarray) -> tuple[np.ndarray, float]:
    """Return screen points in fine pixels of a panel, and how many there are per mm."""
    flat = points_mm.reshape(-1, 2)
    low, high = flat.min(axis=0), flat.max(axis=0)
    room = FINE * (np.array(PANEL) - 70.0)
    scale = float((room / np.maximum(high - low, 1e-6)).min())
    return (points_mm - (low + high) / 2) * scale + FINE * np.array(PANEL) / 2, scale


def _laid_frame(frame: np.ndarray, quad: np.ndarray) -> Image.Image:
    """Return a frame in a parallelogram whose corners go clockwise from pixel (0, 0)."""
    values = finite(frame.mean(axis=-1) if frame.ndim == 3 else frame.astype(np.float32))
    top = 255.0 if frame.dtype == np.uint8 else float(values.max()) or 1.0
    gray = np.clip(values * (BRIGHTER * 255.0 / top), 0, 255).astype(np.uint8)
    sides = np.column_stack((quad[1] - quad[0], quad[3] - quad[0]))
    if abs(np.linalg.det(sides)) < 1.0:
        return Image.new("RGB", _fine(PANEL))  # seen from its edge
    # Pillow skips pixels where it shrinks: thin the frame to about its size on the panel.
    width, height = (max(2, int(np.hypot(*sides[:, k]))) for k in (0, 1))
    image = Image.fromarray(gray).resize((width, height), Image.Resampling.BOX)
    (a, b), (d, e) = to_frame = np.diag([width - 1.0, height - 1.0]) @ np.linalg.inv(sides)
    c, f = -to_frame @ quad[0]
    kind, smooth = Image.Transform.AFFINE, Image.Resampling.BILINEAR
    return image.transform(_fine(PANEL), kind, (a, b, c, d, e, f), smooth).convert("RGB")


def _volume_panel(volume: Volume, trajectory: Trajectory) -> Image.Image:
    """Return the rendered volume without its empty margins, with a scale bar."""
    to_first = invert_pose(trajectory.image_to_reference[0]).numpy()
    shown, bounds = render_volume(volume, to_first, pixels=900, max_voxels=VOXELS)
    mm_per_pixel = float(bounds[2] - bounds[0]) / shown.shape[1]
    rows, columns = np.nonzero(shown > 8)
    if len(rows):
        shown = shown[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    panel, scale, _ = panel_with(shown, PANEL, margin=24)
    draw_scale_bar(panel, scale / mm_per_pixel)
    return panel


def _arrow(draw: ImageDraw.ImageDraw, left: int, middle: int, length: int) -> None:
    right, head = left + length, 20
    draw.line((left, middle, right - head, middle), fill=FAINT, width=8)
    tip = [(right, middle), (right - head, middle - head), (right - head, middle + head)]
    draw.polygon(tip, fill=FAINT)
