"""A picture in a frame of fixed shape, with its scale bar and the names of its axes."""

import base64

from sonosweep.view import svg
from sonosweep.view.projections import Picture, encode_small

WIDTH, HEIGHT = 400, 310
MARGIN = 4


def draw_picture(picture: Picture, right: str = "", down: str = "") -> str:
    """Return an SVG picture on black with a scale bar whose length is what its label says.

    Args:
        picture: What to show; it is fitted into the frame.
        right: What the axis to the right is called; the picture's own name when empty.
        down: What the axis downwards is called.
    """
    rows, columns = picture.pixels.shape[:2]
    scale = min((WIDTH - 2 * MARGIN) / columns, (HEIGHT - 2 * MARGIN) / rows)
    width, height = columns * scale, rows * scale
    data, kind = encode_small(picture)
    image = svg.element(
        "image",
        href=f"data:{kind};base64,{base64.b64encode(data).decode('ascii')}",
        x=(WIDTH - width) / 2,
        y=(HEIGHT - height) / 2,
        width=width,
        height=height,
        preserveAspectRatio="none",
    )
    right, down = right or picture.right, down or picture.down
    axes = f"{right} →  {down} ↓" if right and down else ""
    return svg.figure(
        WIDTH,
        HEIGHT,
        picture.title,
        svg.element("rect", width=WIDTH, height=HEIGHT, fill="#000"),
        image,
        scale_bar(scale / picture.mm_per_pixel, 0.9 * WIDTH),
        svg.text(axes, WIDTH - 10, 20, text_anchor="end", **_LETTERS),
    )


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
