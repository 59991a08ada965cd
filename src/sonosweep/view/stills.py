"""The report's static pictures of volumes, which need no script and print."""

from collections.abc import Sequence
from html import escape

import numpy as np

from sonosweep.geometry import invert_pose
from sonosweep.scan import Trajectory, Volume, voxel_to_reference
from sonosweep.view.content import ReportRun
from sonosweep.view.payload import name_axes
from sonosweep.view.picture_frame import draw_depth_map, draw_picture
from sonosweep.view.projections import (
    Picture,
    best_covered,
    difference_cuts,
    display_window,
    orthogonal_cuts,
    projections,
)
from sonosweep.view.render import render_volume
from sonosweep.view.svg import run_color
from sonosweep.view.vessels import filled, shown_name, vessel_axes, vessel_pictures

STILL_PIXELS = 520
MANY = 24  # pictures; a report with more gets smaller ones, so that it can still be mailed
Voxel = tuple[int, int, int]


def still_pictures(runs: Sequence[ReportRun]) -> str:
    """Return the pictures of every volume of every run, and of the difference of the first two.

    All cuts go through one place: the middle of what the first volume covers.
    """
    shown = [(k, run, run.volume) for k, run in enumerate(runs) if run.volume is not None]
    if not shown:
        return ""
    first = runs[0].trajectory
    place = _place_mm(shown[0][2], best_covered(shown[0][2]))
    count = sum(7 + 5 * len(run.companions) for _, run, _ in shown)
    pixels = int(STILL_PIXELS * min(1.0, (MANY / count) ** 0.5))
    parts = [_renderings(shown, first)]
    parts += [_run_pictures(k, run, volume, first, place, pixels) for k, run, volume in shown]
    if len(shown) > 1 and shown[0][2].grid == shown[1][2].grid:
        parts.append(_difference(shown[0][1], shown[1][1], first, place, pixels))
    return "".join(parts)


def _run_pictures(
    index: int, run: ReportRun, volume: Volume, first: Trajectory, place: np.ndarray, pixels: int
) -> str:
    names, at = name_axes(volume, first), _voxel_at(volume, place)
    cuts = orthogonal_cuts(volume, at, max_pixels=pixels)
    low, high = display_window(volume)
    head = f'<h3><i style="background:{run_color(index)}"></i>{escape(run.name)}</h3>'
    note = (
        f'<p class="legend">Cuts through {_millimetres(place)} mm; '
        f"black is {low:.4g}, white is {high:.4g}.</p>"
    )
    rows = [
        _row(_framed(cut, names, _cut_caption(cut, volume, at, names)) for cut in cuts),
        note,
        _row(
            _framed(one, names, f"Maximum along the {names[_through(one)]} axis")
            for one in projections(volume, "maximum", max_pixels=pixels)
        ),
        *(
            _companion(name, companion, volume, first, place, pixels)
            for name, companion in run.companions.items()
        ),
    ]
    return head + "".join(rows)


def _companion(
    name: str,
    companion: Volume,
    volume: Volume,
    first: Trajectory,
    place: np.ndarray,
    pixels: int,
) -> str:
    """Return vessels over the B-mode, their depth map, and a cross-section beside it."""
    names, at = name_axes(companion, first), _voxel_at(companion, place)
    depth, along = axes = vessel_axes(names)
    to_first = invert_pose(first.image_to_reference[0]).numpy()
    made = vessel_pictures(companion, volume, to_first, axes, at, pixels)
    right, down = _axis_names(made.depth_map.picture, names)
    section = (made.section_mm, made.section_down)
    drawn = draw_depth_map(made.depth_map, right, down, section)
    words = f"Maximum along the {names[depth]} axis; colour is the place along it"
    large = [_figure(drawn, words)]
    if made.over_b_mode is not None:
        over = draw_picture(made.over_b_mode)
        large.insert(0, _figure(over, "Seen obliquely through the B-mode volume"))
    where = f"{names[along]} {made.section_mm:.1f} mm (dashed)"
    small = [
        _framed(picture, names, words)
        for picture, words in (
            (made.cross_section, f"B-mode at {where}"),
            (made.overlaid, f"{shown_name(name)} over it"),
            (made.maximum, f"Maximum along the {names[along]} axis"),
        )
        if picture is not None
    ]
    low, high = made.depth_map.window
    legend = (
        '<p class="legend">Millimetres count from the edge of the volume; black is '
        f"{low:.4g}, the brightest colours are {high:.4g}.</p>"
    )
    head = f"<h3>{escape(shown_name(name))}</h3>"
    return f'{head}<div class="pictures two">{"".join(large)}</div>{_row(small)}{legend}'


def _difference(
    first: ReportRun, second: ReportRun, trajectory: Trajectory, place: np.ndarray, pixels: int
) -> str:
    if first.volume is None or second.volume is None:
        return ""
    names = name_axes(first.volume, trajectory)
    at = _voxel_at(first.volume, place)
    cuts = difference_cuts(first.volume, second.volume, at, max_pixels=pixels)
    head = f"<h3>Difference between {escape(first.name)} and {escape(second.name)}</h3>"
    captions = (_cut_caption(cut, first.volume, at, names) for cut in cuts)
    row = _row(_framed(cut, names, words) for cut, words in zip(cuts, captions, strict=True))
    note = (
        '<p class="legend">Absolute difference of the voxel values at the same place; black is '
        "none, white is as much as the brightest tissue. What only one of the two covers counts "
        "fully.</p>"
    )
    return head + row + note


def _renderings(shown: Sequence[tuple[int, ReportRun, Volume]], first: Trajectory) -> str:
    """Return the volumes seen obliquely, without the margins that are empty in all of them."""
    to_first = invert_pose(first.image_to_reference[0]).numpy()
    drawn = [render_volume(volume, to_first, pixels=STILL_PIXELS) for _, _, volume in shown]
    figures = []
    for (pixels, bounds), (_, run, _) in zip(drawn, shown, strict=True):
        alike = [other for other, edges in drawn if np.array_equal(edges, bounds)]
        rows, columns = filled(np.maximum.reduce(alike))
        edge = float(bounds[2] - bounds[0]) / pixels.shape[1]
        picture = Picture(pixels[rows, columns], edge, "", "", "volume rendering")
        words = f"Seen obliquely from before the first frame ({run.name}); far is darker"
        figures.append(_figure(draw_picture(picture), words))
    return f'<div class="pictures two">{"".join(figures)}</div>'


def _row(figures) -> str:
    return f'<div class="pictures">{"".join(figures)}</div>'


def _framed(picture: Picture, names: tuple[str, str, str], caption: str) -> str:
    return _figure(draw_picture(picture, *_axis_names(picture, names)), caption)


def _figure(drawn: str, caption: str) -> str:
    return f"<figure>{drawn}<figcaption>{escape(caption)}</figcaption></figure>"


def _axis_names(picture: Picture, names: tuple[str, str, str]) -> tuple[str, str]:
    return names["xyz".index(picture.right)], names["xyz".index(picture.down)]


def _through(picture: Picture) -> int:
    return 3 - "xyz".index(picture.right) - "xyz".index(picture.down)


def _cut_caption(picture: Picture, volume: Volume, at: Voxel, names: tuple[str, str, str]) -> str:
    axis = _through(picture)
    depth_mm = (at[axis] + 0.5) * volume.grid.spacing_mm[axis]
    return f"{names[axis].capitalize()} {depth_mm:.1f} mm from the edge of the volume"


def _place_mm(volume: Volume, voxel: Voxel) -> np.ndarray:
    return (voxel_to_reference(volume.grid).numpy() @ np.array([*voxel, 1.0]))[:3]


def _voxel_at(volume: Volume, place_mm: np.ndarray) -> Voxel:
    """Return the voxel nearest to a place in the reference, inside of the volume."""
    inverse = np.linalg.inv(voxel_to_reference(volume.grid).numpy())
    index = np.rint(inverse[:3, :3] @ place_mm + inverse[:3, 3])
    x, y, z = (int(np.clip(i, 0, n - 1)) for i, n in zip(index, volume.grid.size, strict=True))
    return x, y, z


def _millimetres(place: np.ndarray) -> str:
    return "(" + ", ".join(f"{value:.1f}" for value in place) + ")"
