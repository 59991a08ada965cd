"""SVG elements as text, and the round numbers that axes and scale bars show."""

import math
from html import escape

RUN_COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7")
"""Colours that colour-blind readers can tell apart (Okabe and Ito 2008), one for each run."""

Number = float | int
Attribute = str | Number
MINUS = "\N{MINUS SIGN}"


def run_color(index: int) -> str:
    """Return the CSS colour of a run; the page's theme may override it."""
    place = index % len(RUN_COLORS)
    return f"var(--run{place},{RUN_COLORS[place]})"


def element(tag: str, *children: str, **attributes: Attribute) -> str:
    """Return one element; children are markup already, attribute values are escaped.

    Args:
        tag: Name of the element.
        *children: What it holds; see :func:`text` for words.
        **attributes: ``stroke_width`` becomes ``stroke-width``, ``class_`` becomes ``class``.
    """
    pairs = "".join(
        f' {name.rstrip("_").replace("_", "-")}="{escape(_plain(value))}"'
        for name, value in attributes.items()
    )
    return f"<{tag}{pairs}>{''.join(children)}</{tag}>" if children else f"<{tag}{pairs}/>"


def text(words: str, x: Number, y: Number, **attributes: Attribute) -> str:
    """Return words at a place; they are escaped."""
    return element("text", escape(words), x=x, y=y, **attributes)


def line(x1: Number, y1: Number, x2: Number, y2: Number, **attributes: Attribute) -> str:
    """Return a straight line."""
    return element("line", x1=x1, y1=y1, x2=x2, y2=y2, **attributes)


def path_data(points: list[tuple[Number, Number]], closed: bool = False) -> str:
    """Return the ``d`` of a path through points."""
    joined = "L".join(f"{_plain(x)} {_plain(y)}" for x, y in points)
    return f"M{joined}{'Z' if closed else ''}"


def figure(width: Number, height: Number, label: str, *children: str) -> str:
    """Return a whole picture of ``width`` x ``height`` units that scales to its place.

    Args:
        width: Units across.
        height: Units down.
        label: What the picture shows, in words, for those who cannot see it.
        *children: Its elements.
    """
    return element(
        "svg",
        element("title", escape(label)),
        *children,
        xmlns="http://www.w3.org/2000/svg",
        viewBox=f"0 0 {_plain(width)} {_plain(height)}",
        role="img",
        font_family="system-ui,'Segoe UI',Roboto,'Helvetica Neue',Arial,sans-serif",
        font_size=12,
        style="color:var(--ink,#1c2733);max-width:100%;height:auto",
        fill="currentColor",
    )


def nice_step(span: Number, count: int) -> float:
    """Return 1, 2 or 5 times a power of ten that divides ``span`` into about ``count``."""
    if not math.isfinite(span) or span <= 0:
        return 1.0
    raw = span / max(count, 1)
    power = 10.0 ** math.floor(math.log10(raw))
    return next(power * factor for factor in (1, 2, 5, 10) if power * factor >= raw * (1 - 1e-9))


def nice_ticks(low: Number, high: Number, count: int = 5) -> list[float]:
    """Return the round numbers between two values: about ``count``, and two at the least."""
    for finer in (1, 2, 4):
        step = nice_step(high - low, finer * count)
        first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
        if last > first:
            break
    return [index * step for index in range(first, last + 1)]


def nice_length_mm(width_mm: Number) -> float:
    """Return a round length for a scale bar: the largest below three tenths of a width."""
    limit = 0.3 * width_mm
    power = 10.0 ** math.floor(math.log10(limit))
    return next(power * factor for factor in (5, 2, 1) if power * factor <= limit * (1 + 1e-9))


def number_label(value: Number) -> str:
    """Return a number as a reader writes it, with a true minus sign."""
    shown = f"{value:.6g}"
    if "e" in shown:
        shown = f"{value:.3g}"
    return "0" if float(shown) == 0 else shown.replace("-", MINUS)


def _plain(value: Attribute) -> str:
    if isinstance(value, str):
        return value
    shown = f"{float(value):.2f}".rstrip("0").rstrip(".")
    return "0" if shown in ("-0", "") else shown
