"""Panels of the PNG pictures: an image in the middle of black, a scale bar, words."""

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from sonosweep.view.svg import nice_length_mm, number_label

PAPER, WORDS, FAINT = (11, 15, 20), (228, 234, 240), (150, 168, 184)


def panel_with(
    pixels: np.ndarray, size: tuple[int, int], margin: int = 4
) -> tuple[Image.Image, float, tuple[int, int]]:
    """Return pixels as large as they fit into the middle of a black panel.

    Args:
        pixels: Gray or coloured.
        size: Of the panel, width and height.
        margin: Left around them.

    Returns:
        The panel, its pixels for each of theirs, and where their left top is.
    """
    rows, columns = pixels.shape[:2]
    scale = min((size[0] - 2 * margin) / columns, (size[1] - 2 * margin) / rows)
    fitted = (max(1, round(columns * scale)), max(1, round(rows * scale)))
    panel = Image.new("RGB", size)
    image = Image.fromarray(pixels).resize(fitted, Image.Resampling.BICUBIC)
    place = ((size[0] - fitted[0]) // 2, (size[1] - fitted[1]) // 2)
    panel.paste(image.convert("RGB"), place)
    return panel, scale, place


def draw_scale_bar(panel: Image.Image, units_per_mm: float) -> None:
    """Draw a bar of a round length at the lower left, and its length in words."""
    length_mm = nice_length_mm(panel.width / units_per_mm)
    draw, bottom = ImageDraw.Draw(panel), panel.height - 16
    draw.rectangle((16, bottom, 15 + round(length_mm * units_per_mm), bottom + 3), fill=WORDS)
    draw_words(draw, (16, bottom - 26), f"{number_label(length_mm)} mm", 17)


def draw_words(
    draw: ImageDraw.ImageDraw, at: tuple[int, int], words: str, size: int = 24, anchor: str = "la"
) -> None:
    """Write words with their left top (or what Pillow's anchor says) at a place."""
    font = ImageFont.load_default(size)
    draw.text(at, words, WORDS, font, anchor, stroke_width=size // 12, stroke_fill=(0, 0, 0))
