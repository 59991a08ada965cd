"""The paper's figure of what a network looks at, as PNG."""

import os
from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw

from sonosweep.estimators.step_maps import StepMaps
from sonosweep.io.atomic import write_beside
from sonosweep.view.panels import PAPER, draw_scale_bar, draw_words, panel_with
from sonosweep.view.projections import Picture, Window, hot_color, open_window, overlay, to_gray

PANEL, GAP, TOP, LABEL = 340, 12, 44, 30
COLUMNS = ("B-mode", "Attention over it", "Correlation of features", "Correlation of frames")


def write_map_picture(path: str | os.PathLike, steps: Sequence[StepMaps]) -> None:
    """Write a PNG with a row for each step: frame, attention, and both correlations.

    Bright is much. Attention goes from the least to the most of a frame; all correlations
    share one scale, so that their contrast can be compared. Below each map are its least and
    its largest number.

    Args:
        path: Where; replaced only when the whole file is written.
        steps: From above to below.

    Raises:
        FormatError: If the file cannot be written.

    References:
        Lee et al. 2025, the figure of correlation maps and attention in the discussion.
    """
    shown = [one for step in steps for one in (step.features, step.frames) if one is not None]
    values = np.concatenate([one.ravel() for one in shown]) if shown else np.zeros(1)
    window = open_window(float(values.min()), float(values.max()))
    count = 4 if shown else 2
    size = (GAP + count * (PANEL + GAP), TOP + len(steps) * (PANEL + LABEL + GAP))
    sheet = Image.new("RGB", size, PAPER)
    draw = ImageDraw.Draw(sheet)
    for column, title in enumerate(COLUMNS[:count]):
        draw_words(draw, (_left(column), 12), title, 19)
    for row, step in enumerate(steps):
        top = TOP + row * (PANEL + LABEL + GAP)
        for column, (panel, words) in enumerate(_panels(step, window)[:count]):
            sheet.paste(panel, (_left(column), top))
            draw_words(draw, (_left(column), top + PANEL + 5), words, 16)
    with write_beside(path) as temporary:
        sheet.save(temporary, "PNG")


def _left(column: int) -> int:
    return GAP + column * (PANEL + GAP)


def _panels(step: StepMaps, window: Window) -> list[tuple[Image.Image, str]]:
    """Return the panels of a row with the words below them."""
    across, down = step.mm_per_pixel
    rows, columns = step.frame.shape
    square = Image.fromarray(step.frame)
    if across != down:  # pixels become square
        square = square.resize((columns, max(1, round(rows * down / across))))
    base = Picture(np.asarray(square), across, "", "")
    panel, scale, _ = panel_with(base.pixels, (PANEL, PANEL))
    draw_scale_bar(panel, scale / across)
    return [
        (panel, step.words),
        _attention_panel(base, step.attention),
        _correlation_panel(step.features, window),
        _correlation_panel(step.frames, window),
    ]


def _attention_panel(base: Picture, attention: np.ndarray | None) -> tuple[Image.Image, str]:
    if attention is None:
        return Image.new("RGB", (PANEL, PANEL)), "none"
    gray = to_gray(attention, open_window(float(attention.min()), float(attention.max())))
    mixed = overlay(base, Picture(gray, 1.0, "", ""), opacity=0.5)
    return panel_with(mixed.pixels, (PANEL, PANEL))[0], _range(attention)


def _correlation_panel(values: np.ndarray | None, window: Window) -> tuple[Image.Image, str]:
    if values is None:
        return Image.new("RGB", (PANEL, PANEL)), "none"
    low, high = window
    colors = hot_color((values - low) / (high - low))
    large = PANEL // max(values.shape)  # whole squares, without smoothing
    pixels = np.rint(colors).astype(np.uint8).repeat(large, axis=0).repeat(large, axis=1)
    return panel_with(pixels, (PANEL, PANEL))[0], _range(values)


def _range(values: np.ndarray) -> str:
    return f"{float(values.min()):.3g} to {float(values.max()):.3g}"
