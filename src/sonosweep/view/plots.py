"""Line plots with axes, units and a legend that never covers a line."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from sonosweep.view import svg

LONG = 40  # letters of a name that a legend shows
MAX_POINTS = 1200  # more than a screen is wide; extremes of each bin are kept
GRID = "var(--grid,#dfe5ea)"
MUTED = "var(--muted,#5b6875)"


@dataclass(frozen=True, eq=False)
class Series:
    """One line of a plot.

    Attributes:
        name: What the legend calls it.
        x: Where; increasing.
        y: How much; NaN leaves a gap.
        std: Half width of the band around it; ``None`` for none.
        color: CSS colour.
    """

    name: str
    x: Float[np.ndarray, " samples"]
    y: Float[np.ndarray, " samples"]
    std: Float[np.ndarray, " samples"] | None = None
    color: str = svg.run_color(0)


@dataclass(frozen=True)
class Box:
    """Where a panel's axes lie on the page, in SVG units."""

    left: svg.Number
    top: svg.Number
    width: svg.Number
    height: svg.Number


def draw_lines(
    series: tuple[Series, ...],
    title: str,
    x_label: str,
    y_label: str,
    size: tuple[int, int] = (1120, 300),
    from_zero: bool = False,
) -> str:
    """Return an SVG picture of one panel, its title and its legend above it.

    Args:
        series: Lines, drawn in this order.
        title: What it shows.
        x_label: Quantity and unit along the bottom.
        y_label: Quantity and unit up the side.
        size: Width and height.
        from_zero: Whether 0 belongs on the vertical axis.
    """
    box = Box(58, 56, size[0] - 74, size[1] - 102)
    return svg.figure(
        *size,
        title,
        svg.text(title, 12, 20, font_size=14, font_weight=600),
        legend(series, 12, 40),
        panel(series, box, x_label, y_label, from_zero),
    )


def legend(series: tuple[Series, ...], left: svg.Number, baseline: svg.Number) -> str:
    """Return colour samples with names, in a row."""
    parts, x = [], left
    for one in series:
        y = baseline - 4
        parts.append(svg.line(x, y, x + 22, y, stroke_width=3, style=f"stroke:{one.color}"))
        name = one.name if len(one.name) <= LONG else f"{one.name[: LONG - 1]}…"
        name += "" if one.std is None else " (band: ±1 SD)"
        parts.append(svg.text(name, x + 28, baseline))
        x += 48 + 6.6 * len(name)
    return svg.element("g", *parts) if parts else ""


def panel(
    series: tuple[Series, ...], box: Box, x_label: str, y_label: str, from_zero: bool = False
) -> str:
    """Return axes and lines in a box; labels lie left of and below it."""
    x_range, y_range = _ranges(series, from_zero)

    def place(x: float, y: float) -> tuple[float, float]:
        across = (x - x_range[0]) / (x_range[1] - x_range[0])
        up = (y - y_range[0]) / (y_range[1] - y_range[0])
        return box.left + across * box.width, box.top + (1 - up) * box.height

    parts = [_axes(box, x_range, y_range, x_label, y_label)]
    for one in series:
        parts.extend(_line(one, place))
    parts.append(_cursor(box, x_range))
    return svg.element("g", *parts)


def _ranges(
    series: tuple[Series, ...], from_zero: bool
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the ends of both axes; a little room above and below the lines."""
    x = [one.x[np.isfinite(one.x)] for one in series]
    y = [one.y + sign * _band(one) for one in series for sign in (-1, 1)]
    y = [values[np.isfinite(values)] for values in y]
    all_x, all_y = np.concatenate([*x, np.empty(0)]), np.concatenate([*y, np.empty(0)])
    if from_zero:
        all_y = np.append(all_y, 0.0)
    x_low, x_high = _ends(all_x)
    y_low, y_high = _ends(all_y)
    room = 0.06 * (y_high - y_low)
    bottom = y_low if from_zero and y_low == 0 else y_low - room
    return (x_low, x_high), (bottom, y_high + room)


def _band(one: Series) -> np.ndarray:
    return np.zeros_like(one.y) if one.std is None else one.std


def _ends(values: np.ndarray) -> tuple[float, float]:
    if len(values) == 0:
        return 0.0, 1.0
    low, high = float(values.min()), float(values.max())
    if high - low > 1e-9 * max(abs(low), abs(high), 1e-3):
        return low, high
    pad = 0.5 * abs(low) or 0.5
    return low - pad, high + pad


def _axes(
    box: Box,
    x_range: tuple[float, float],
    y_range: tuple[float, float],
    x_label: str,
    y_label: str,
) -> str:
    """Return grid lines, tick labels and the names of both axes."""
    bottom, right = box.top + box.height, box.left + box.width
    parts = []
    for value in svg.nice_ticks(*y_range, count=max(3, round(box.height / 45))):
        y = bottom - (value - y_range[0]) / (y_range[1] - y_range[0]) * box.height
        parts.append(svg.line(box.left, y, right, y, style=f"stroke:{GRID}"))
        parts.append(svg.text(svg.number_label(value), box.left - 6, y + 4, text_anchor="end"))
    for value in svg.nice_ticks(*x_range, count=max(2, round(box.width / 90))):
        x = box.left + (value - x_range[0]) / (x_range[1] - x_range[0]) * box.width
        parts.append(svg.line(x, bottom, x, bottom + 4, style=f"stroke:{MUTED}"))
        parts.append(svg.text(svg.number_label(value), x, bottom + 17, text_anchor="middle"))
    parts.append(svg.line(box.left, bottom, right, bottom, style=f"stroke:{MUTED}"))
    middle = box.left + box.width / 2
    parts.append(svg.text(x_label, middle, bottom + 34, text_anchor="middle"))
    x, y = box.left - 44, box.top + box.height / 2
    turn = f"rotate(-90 {x:.1f} {y:.1f})"
    parts.append(svg.text(y_label, x, y, text_anchor="middle", transform=turn))
    return svg.element("g", *parts, style=f"fill:{MUTED}")


def _line(one: Series, place) -> list[str]:
    """Return the band of a series and its line, broken where it is not finite."""
    parts = []
    for part in _pieces(one):
        if part.std is not None:
            upper = [place(*xy) for xy in zip(part.x, part.y + part.std, strict=True)]
            lower = [place(*xy) for xy in zip(part.x, part.y - part.std, strict=True)]
            outline = svg.path_data(upper + lower[::-1], closed=True)
            style = f"fill:{one.color};fill-opacity:.18"
            parts.append(svg.element("path", d=outline, style=style))
        points = [place(*xy) for xy in zip(part.x, part.y, strict=True)]
        if len(points) == 1:
            (x, y) = points[0]
            parts.append(svg.element("circle", cx=x, cy=y, r=2.5, style=f"fill:{one.color}"))
            continue
        style = f"fill:none;stroke:{one.color};stroke-width:1.8;stroke-linejoin:round"
        parts.append(svg.element("path", d=svg.path_data(points), style=style))
    return parts


def _pieces(one: Series) -> list[Series]:
    """Return the runs of finite samples, each thinned to what a screen can show."""
    good = np.isfinite(one.x) & np.isfinite(one.y) & np.isfinite(_band(one))
    edges = np.flatnonzero(np.diff(np.concatenate(([False], good, [False])).astype(np.int8)))
    pieces = []
    for start, stop in edges.reshape(-1, 2):
        keep = start + _extremes(one.y[start:stop])
        std = None if one.std is None else one.std[keep]
        pieces.append(Series(one.name, one.x[keep], one.y[keep], std, one.color))
    return pieces


def _extremes(values: np.ndarray) -> np.ndarray:
    """Return which samples to keep: all of a few, both extremes of each bin of many."""
    if len(values) <= MAX_POINTS:
        return np.arange(len(values))
    bins = np.array_split(np.arange(len(values)), MAX_POINTS // 2)
    ends = [(part[values[part].argmin()], part[values[part].argmax()]) for part in bins]
    return np.unique(np.concatenate(([0], np.ravel(ends), [len(values) - 1])))


def _cursor(box: Box, x_range: tuple[float, float]) -> str:
    """Return the line that the page's script moves to the frame being looked at."""
    return svg.element(
        "line",
        class_="cursor",
        x1=box.left,
        x2=box.left,
        y1=box.top,
        y2=box.top + box.height,
        visibility="hidden",
        data_left=box.left,
        data_width=box.width,
        data_from=repr(x_range[0]),
        data_to=repr(x_range[1]),
        style=f"stroke:{MUTED};stroke-dasharray:3 3",
    )
