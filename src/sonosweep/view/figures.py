"""Figures of a sweep: its trajectory with outlined frames, its drift and its steps."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from sonosweep.geometry import MOTION_NAMES, invert_pose, motion_from_step, steps_from_poses
from sonosweep.scan import Trajectory
from sonosweep.view import svg
from sonosweep.view.camera import box_corners, project, view_rotation
from sonosweep.view.plots import GRID, MUTED, Box, Series, draw_lines, legend, panel

OUTLINES = 9  # frames drawn per run; more hide each other
MAX_PATH_POINTS = 600


@dataclass(frozen=True, eq=False)
class Track:
    """A trajectory with the name under which figures show it."""

    name: str
    trajectory: Trajectory


def draw_trajectories(
    tracks: Sequence[Track],
    frame_size_mm: tuple[float, float] | None = None,
    outlines: int = OUTLINES,
    size: tuple[int, int] = (560, 520),
) -> str:
    """Return an SVG picture of trajectories in 3D, with the outlines of some frames.

    Everything is drawn in the image coordinates of the first frame of the first
    trajectory. The thick line is the path of the middle of the frame's upper edge, which
    is where the probe touches the skin; a dot marks its start.

    Args:
        tracks: What to draw, all in one reference.
        frame_size_mm: Width and depth of a frame; ``None`` if not known, which leaves the
            outlines out and draws the path of the first pixel.
        outlines: How many frames of each to outline.
        size: Width and height.
    """
    rotation = view_rotation()
    quads = frame_outlines([track.trajectory for track in tracks], frame_size_mm)
    points = np.concatenate([quad.reshape(-1, 3) for quad in quads])
    low, high = padded_box(points)
    screen, scale, shift = _fit(project(box_corners(low, high), rotation), size)

    def place(points_mm: np.ndarray) -> np.ndarray:
        return project(points_mm, rotation)[..., :2] * scale + shift

    names = tuple(
        Series(track.name, np.empty(0), np.empty(0), None, svg.run_color(k))
        for k, track in enumerate(tracks)
    )
    parts = [_box(low, high, screen, place)]
    for k, quad in enumerate(quads):
        width = 6.0 if k == 0 < len(quads) - 1 else 2.5
        parts.append(_outlined(place(quad), svg.run_color(k), outlines, width))
    to_first = invert_pose(tracks[0].trajectory.image_to_reference[0]).numpy()
    parts.extend(_frame_cursors(len(quads), scale * rotation[:2] @ to_first[:3], shift))
    title = "Trajectory in space"
    return svg.figure(
        *size,
        title,
        svg.text(title, 12, 20, font_size=14, font_weight=600),
        legend(names, 12, 40),
        *parts,
    )


def draw_drift(drifts: Sequence[tuple[str, Float[np.ndarray, " frames"], int]]) -> str:
    """Return an SVG picture of how far each frame is from where it should be.

    Args:
        drifts: Name, drift in mm of each frame and index of the run, which is its colour.
    """
    lines = tuple(
        Series(
            name, np.arange(len(drift), dtype=float), drift.astype(float), None, svg.run_color(k)
        )
        for name, drift, k in drifts
    )
    return draw_lines(
        lines, "Drift: distance from the tracked position", "frame", "drift (mm)", from_zero=True
    )


def draw_steps(tracks: Sequence[Track]) -> str:
    """Return an SVG picture of the six motion numbers of every step, one panel each.

    Turns are in degrees. A trajectory that knows its standard deviations gets a band.
    """
    motions = [_motion(track.trajectory) for track in tracks]
    parts: list[str] = []
    first: tuple[Series, ...] = ()
    for number, name in enumerate(MOTION_NAMES):
        lines = tuple(
            _step_series(track, motion, number, k)
            for k, (track, motion) in enumerate(zip(tracks, motions, strict=True))
        )
        first = first or lines
        box = Box(52 + 268 * (number // 3), 78 + 148 * (number % 3), 222, 94)
        unit = "mm" if number < 3 else "°"
        parts.append(svg.text(f"{name} ({unit})", box.left, box.top - 8, font_weight=600))
        parts.append(panel(lines, box, "step" if number % 3 == 2 else "", ""))
    title = "Steps from frame to frame"
    head = svg.text(title, 12, 20, font_size=14, font_weight=600)
    return svg.figure(560, 520, title, head, legend(first, 12, 40), *parts)


def frame_outlines(
    trajectories: Sequence[Trajectory], frame_size_mm: tuple[float, float] | None
) -> list[Float[np.ndarray, "frames points=5 xyz=3"]]:
    """Return the corners of every frame, clockwise, and the middle of its upper edge.

    They are in the image coordinates of the first frame of the first trajectory.
    """
    width, depth = frame_size_mm or (0.0, 0.0)
    corners = [(0.0, 0.0), (width, 0.0), (width, depth), (0.0, depth), (width / 2, 0.0)]
    local = torch.tensor([[x, y, 0.0, 1.0] for x, y in corners], dtype=torch.float64)
    to_first = invert_pose(trajectories[0].image_to_reference[0])
    return [(to_first @ one.image_to_reference @ local.T)[:, :3].mT.numpy() for one in trajectories]


def padded_box(
    points_mm: Float[np.ndarray, "points xyz=3"],
) -> tuple[Float[np.ndarray, "xyz=3"], Float[np.ndarray, "xyz=3"]]:
    """Return the ends of a box around points that is nowhere thinner than 1/20 of its length."""
    low, high = points_mm.min(axis=0), points_mm.max(axis=0)
    least = max(float((high - low).max()) / 20, 1.0)
    missing = np.maximum(least - (high - low), 0.0) / 2
    return low - missing, high + missing


def _fit(corners: np.ndarray, size: tuple[int, int]) -> tuple[np.ndarray, float, np.ndarray]:
    """Return the box on the page, units per mm, and the shift to the page's middle."""
    flat = corners[..., :2].reshape(-1, 2)
    room = np.array([size[0] - 130.0, size[1] - 150.0])
    extent = flat.max(axis=0) - flat.min(axis=0)
    scale = float((room / np.maximum(extent, 1e-9)).min())
    middle = np.array([size[0] / 2, 56 + (size[1] - 100) / 2])
    shift = middle - scale * (flat.max(axis=0) + flat.min(axis=0)) / 2
    return corners[..., :2] * scale + shift, scale, shift


def _box(low: np.ndarray, high: np.ndarray, screen: np.ndarray, place) -> str:
    """Return the edges of the box with ticks in mm along three that border the picture."""
    parts = []
    middle = screen.reshape(-1, 2).mean(axis=0)
    for axis, name in enumerate(MOTION_NAMES[:3]):
        edges = np.moveaxis(screen, axis, 0).reshape(2, 4, 2)
        for start, stop in zip(edges[0], edges[1], strict=True):
            parts.append(svg.line(*start, *stop, style=f"stroke:{GRID}"))
        # The lowest edge for what runs sideways, the left one for depth: always in view.
        middles = edges.mean(axis=0)
        chosen = int(middles[:, 0].argmin() if axis == 1 else middles[:, 1].argmax())
        parts.append(_ticks(axis, name, low, high, chosen, middle, place))
    return svg.element("g", *parts)


def _ticks(
    axis: int,
    name: str,
    low: np.ndarray,
    high: np.ndarray,
    chosen: int,
    middle: np.ndarray,
    place,
) -> str:
    """Return one axis: its line, round numbers and its name, outside of the box."""
    others = [k for k in range(3) if k != axis]
    start = np.array(low, dtype=float)
    for k, bit in zip(others, (chosen // 2, chosen % 2), strict=True):
        start[k] = (low, high)[bit][k]
    stop = start.copy()
    stop[axis] = high[axis]
    a, b = place(start), place(stop)
    along = (b - a) / max(float(np.hypot(*(b - a))), 1e-9)
    outward = np.array([-along[1], along[0]])
    outward = outward if (outward @ ((a + b) / 2 - middle)) > 0 else -outward
    count = max(1, round(float(np.hypot(*(b - a))) / 55))
    parts = [svg.line(*a, *b, style=f"stroke:{MUTED}")]
    for value in svg.nice_ticks(float(low[axis]), float(high[axis]), count):
        point = start.copy()
        point[axis] = value
        at = place(point)
        parts.append(svg.line(*at, *(at + 5 * outward), style=f"stroke:{MUTED}"))
        x, y = at + (9 if axis == 1 else 16) * outward
        anchor = "end" if outward[0] < -0.7 else "middle"
        parts.append(svg.text(svg.number_label(value), x, y + 4, text_anchor=anchor))
    x, y = (a + b) / 2 + 42 * outward
    angle = float(np.degrees(np.arctan2(along[1], along[0])))
    angle = angle - 180 if angle >= 90 else angle + 180 if angle < -90 else angle
    turn = f"rotate({angle:.1f} {x:.1f} {y:.1f})"
    parts.append(svg.text(f"{name} (mm)", x, y + 4, text_anchor="middle", transform=turn))
    return svg.element("g", *parts, style=f"fill:{MUTED}")


def _outlined(quads: np.ndarray, color: str, outlines: int, width: float) -> str:
    """Return some frames as see-through rectangles, and the path of the probe's face.

    The first of several paths is wider, so that it shows beneath one that covers it.
    """
    frames = len(quads)
    shown = np.unique(np.linspace(0, frames - 1, min(outlines, frames)).round().astype(int))
    style = f"stroke:{color};stroke-opacity:.75;fill:{color};fill-opacity:.025"
    parts = [
        svg.element("path", d=svg.path_data(_pairs(quads[k, :4]), closed=True), style=style)
        for k in shown
    ]
    kept = np.unique(np.linspace(0, frames - 1, min(frames, MAX_PATH_POINTS)).round().astype(int))
    points = _pairs(quads[kept, 4])
    path = f"fill:none;stroke:{color};stroke-width:{width};stroke-linejoin:round"
    parts.append(svg.element("path", d=svg.path_data(points), style=path))
    (x, y) = points[0]
    dot = f"fill:var(--paper,#fff);stroke:{color};stroke-width:2.5"
    parts.append(svg.element("circle", cx=x, cy=y, r=4.5, style=dot))
    return svg.element("g", *parts)


def _frame_cursors(
    runs: int, to_page: Float[np.ndarray, "2 4"], shift: Float[np.ndarray, "2"]
) -> list[str]:
    """Return outlines that the page's script moves to the frame being looked at."""
    matrix = to_page.copy()
    matrix[:, 3] += shift
    project_ = " ".join(f"{value:.5g}" for value in matrix.ravel())
    return [
        svg.element(
            "path",
            class_="frame-cursor",
            d="",
            data_run=k,
            data_project=project_,
            style=f"fill:{svg.run_color(k)};fill-opacity:.12;stroke:{svg.run_color(k)};"
            "stroke-width:2",
        )
        for k in range(runs)
    ]


def _pairs(points: np.ndarray) -> list[tuple[float, float]]:
    return [(float(x), float(y)) for x, y in points]


def _motion(trajectory: Trajectory) -> np.ndarray:
    motion = motion_from_step(steps_from_poses(trajectory.image_to_reference)).numpy().copy()
    motion[:, 3:] = np.degrees(motion[:, 3:])
    return motion


def _step_series(track: Track, motion: np.ndarray, number: int, run: int) -> Series:
    std = track.trajectory.step_std
    band = None
    if std is not None:
        band = std[:, number].double().numpy()
        band = band if number < 3 else np.degrees(band)
    steps = np.arange(len(motion), dtype=float)
    return Series(track.name, steps, motion[:, number], band, svg.run_color(run))
