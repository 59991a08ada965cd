"""A picture in a frame of fixed shape, with its scale bar and the names of its axes."""

import base64

import numpy as np

from sonosweep.view import svg
from sonosweep.view.projections import Picture, encode_small
from sonosweep.view.vessels import DepthMap, depth_color

WIDTH, HEIGHT = 400, 310
MARGIN = 4
BAR_ROOM = 64
STRIPS = 32  # that make up the bar of colours


def draw_picture(picture: Picture, right: str = "", down: str = "") -> str:
    """Return an SVG picture on black with a scale bar whose length is what its label says.

    Args:
        picture: What to show; it is fitted into the frame.
        right: What the axis to the right is called; the picture's own name when empty.
        down: What the axis downwards is called.
    """
    image, scale, _ = _fitted(picture, WIDTH)
    return _frame(picture, right, down, image, scale_bar(scale / picture.mm_per_pixel, 0.9 * WIDTH))


def draw_depth_map(
    mapped: DepthMap,
    right: str = "",
    down: str = "",
    section: tuple[float, bool] | None = None,
) -> str:
    """Return an SVG of a depth map with the bar of its colours.

    Args:
        mapped: What to show.
        right: What the axis to the right is called.
        down: What the axis downwards is called.
        section: Where a cross-section lies, mm from the edge, and whether that is down.
    """
    picture = mapped.picture
    image, scale, (left, top) = _fitted(picture, WIDTH - BAR_ROOM)
    per_mm = scale / picture.mm_per_pixel
    rows, columns = picture.pixels.shape[:2]
    drawn = [image]
    if section is not None:
        place_mm, across = section
        x, y = left + place_mm * per_mm, top + place_mm * per_mm
        ends = (left, y, left + columns * scale, y) if across else (x, top, x, top + rows * scale)
        drawn.append(svg.line(*ends, stroke="#fff", stroke_dasharray="5 4"))
    drawn += [scale_bar(per_mm, 0.9 * WIDTH), _color_bar(mapped.span_mm)]
    return _frame(picture, right, down, *drawn)


def _frame(picture: Picture, right: str, down: str, *drawn: str) -> str:
    right, down = right or picture.right, down or picture.down
    axes = f"{right} →  {down} ↓" if right and down else ""
    return svg.figure(
        WIDTH,
        HEIGHT,
        picture.title,
        svg.element("rect", width=WIDTH, height=HEIGHT, fill="#000"),
        *drawn,
        svg.text(axes, WIDTH - 10, 20, text_anchor="end", **_LETTERS),
    )


def _fitted(picture: Picture, room: int) -> tuple[str, float, tuple[float, float]]:
    """Return the image in the middle of a width, its units per pixel, and its left top."""
    rows, columns = picture.pixels.shape[:2]
    scale = min((room - 2 * MARGIN) / columns, (HEIGHT - 2 * MARGIN) / rows)
    width, height = columns * scale, rows * scale
    left, top = (room - width) / 2, (HEIGHT - height) / 2
    data, kind = encode_small(picture)
    image = svg.element(
        "image",
        href=f"data:{kind};base64,{base64.b64encode(data).decode('ascii')}",
        x=left,
        y=top,
        width=width,
        height=height,
        preserveAspectRatio="none",
    )
    return image, scale, (left, top)


def _color_bar(span_mm: tuple[float, float]) -> str:
    """Return the colours from near (above) to far (below), with both ends in mm."""
    left, top, height = WIDTH - 30, 46, HEIGHT - 96
    colors = depth_color((np.arange(STRIPS) + 0.5) / STRIPS)
    strips = [
        svg.element(
            "rect",
            x=left,
            y=top + height * k / STRIPS,
            width=14,
            height=height / STRIPS + 0.5,
            fill="#" + "".join(f"{round(part):02x}" for part in colors[k]),
        )
        for k in range(STRIPS)
    ]
    near, far = (f"{svg.number_label(round(mm, 1))} mm" for mm in span_mm)
    above = svg.text(near, WIDTH - 10, top - 6, text_anchor="end", **_LETTERS)
    below = svg.text(far, WIDTH - 10, top + height + 16, text_anchor="end", **_LETTERS)
    return "".join(strips) + above + below


def scale_bar(units_per_mm: float, width: float) -> str:
    """Return a bar of a round length at the lower left, and its length in words."""
    length_mm = svg.nice_length_mm(width / units_per_mm)
    bar = svg.element(
        "rect",
        class_="scale-bar",
        x=12,
        y=HEIGHT - 14,
        width=length_mm * units_per_mm,
        height=3,
        fill="#fff",
        stroke="#000",
        stroke_width=0.5,
    )
    return bar + svg.text(f"{svg.number_label(length_mm)} mm", 12, HEIGHT - 20, **_LETTERS)


# White with a dark rim, to be read on bright tissue and on black alike.
_LETTERS: dict[str, svg.Attribute] = {
    "fill": "#fff",
    "stroke": "#000",
    "stroke_width": 2.5,
    "paint_order": "stroke",
    "font_size": 13,
}
