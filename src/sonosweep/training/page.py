"""A page that shows how a training run goes: curves, the last numbers, the recipe."""

import math
from collections.abc import Sequence
from html import escape

WIDTH, HEIGHT = 520, 220
LEFT, BOTTOM, MARGIN = 62, 34, 14
COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
"""That colour-blind readers can tell apart (Okabe and Ito 2008)."""
CURVES = (
    ("Loss", ("loss",)),
    (
        "Correlation of each motion with the truth",
        ("r_lateral", "r_axial", "r_elevational", "r_pitch", "r_yaw", "r_roll"),
    ),
    ("Relative error of a step (rAE, mean of mm and degrees)", ("rae",)),
    ("Final drift (FDR, % of the path)", ("fdr",)),
    ("Learning rate", ("learning_rate",)),
)
STYLE = """
body{font:15px/1.5 system-ui,sans-serif;margin:2rem auto;max-width:1120px;padding:0 1rem}
figure{display:inline-block;margin:0 1rem 1rem 0;vertical-align:top}
figcaption{font-weight:600}svg{max-width:100%;height:auto}
table{border-collapse:collapse}td,th{padding:.1rem .8rem .1rem 0;text-align:left}
pre{background:#f4f4f4;padding:1rem;overflow:auto}
"""


def training_page(name: str, rows: Sequence[dict[str, float]], recipe: str) -> str:
    """Return the page as HTML that needs no other file.

    Args:
        name: Of the network.
        rows: Numbers by name; ``"pairs"`` is in each.
        recipe: As text.
    """
    figures = "".join(_figure(title, names, rows) for title, names in CURVES)
    latest: dict[str, float] = {}
    for row in rows:
        latest |= row
    cells = "".join(f"<tr><th>{escape(k)}</th><td>{v:.5g}</td></tr>" for k, v in latest.items())
    return (
        "<!doctype html><html lang='en'><head><meta charset='utf-8'>"
        f"<title>Training of {escape(name)}</title><style>{STYLE}</style></head><body>"
        f"<h1>Training of {escape(name)}</h1>{figures}<h2>Latest numbers</h2>"
        f"<table>{cells}</table><h2>Recipe</h2><pre>{escape(recipe)}</pre></body></html>\n"
    )


def _figure(title: str, names: Sequence[str], rows: Sequence[dict[str, float]]) -> str:
    """Return curves of some numbers against pairs; nothing if there are none yet."""
    curves = {
        name: [(row["pairs"], row[name]) for row in rows if math.isfinite(row.get(name, math.nan))]
        for name in names
    }
    points = [point for curve in curves.values() for point in curve]
    if not points:
        return ""
    last = max(x for x, _ in points) or 1.0
    low, high = min(0.0, *(y for _, y in points)), max(y for _, y in points)
    high = high if high > low else low + 1.0
    lines = "".join(
        _curve(curve, (last, low, high), COLORS[k], name, k, len(names) > 1)
        for k, (name, curve) in enumerate(curves.items())
        if curve
    )
    axes = (
        f"<path d='M{LEFT} {MARGIN}V{HEIGHT - BOTTOM}H{WIDTH - MARGIN}' stroke='#888'/>"
        f"<text x='{LEFT - 6}' y='{MARGIN + 10}' text-anchor='end'>{high:.3g}</text>"
        f"<text x='{LEFT - 6}' y='{HEIGHT - BOTTOM}' text-anchor='end'>{low:.3g}</text>"
        f"<text x='{WIDTH - MARGIN}' y='{HEIGHT - 12}' text-anchor='end'>{last:,.0f} pairs</text>"
    )
    return (
        f"<figure><figcaption>{escape(title)}</figcaption><svg viewBox='0 0 {WIDTH} {HEIGHT}'"
        f" width='{WIDTH}' role='img' font-size='11' fill='none'><title>{escape(title)}</title>"
        f"<g fill='#333' stroke='none'>{axes}</g>{lines}</svg></figure>"
    )


def _curve(
    curve: Sequence[tuple[float, float]],
    limits: tuple[float, float, float],
    color: str,
    name: str,
    place: int,
    labeled: bool,
) -> str:
    last, low, high = limits
    across, down = WIDTH - LEFT - MARGIN, HEIGHT - BOTTOM - MARGIN
    path = "L".join(
        f"{LEFT + across * x / last:.1f} {MARGIN + down * (high - y) / (high - low):.1f}"
        for x, y in curve
    )
    label = ""
    if labeled:
        x = LEFT + 10 + 76 * place
        words = escape(name.removeprefix("r_"))
        label = f"<text x='{x}' y='{HEIGHT - 12}' fill='{color}'>{words}</text>"
    return f"<path d='M{path}' stroke='{color}' stroke-width='1.5'/>{label}"
