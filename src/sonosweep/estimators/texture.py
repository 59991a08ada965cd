"""Speckle as the scanner formed it, recovered from the gray levels it shows.

A B-mode pixel is the logarithm of an echo amplitude. Speckle statistics are those of the
amplitude: for it, the normalized correlation of two images is close to the squared
correlation of the echoes, the estimate scatters least, and the deep black nulls of the
speckle, where a logarithm magnifies noise most, hardly count. So the logarithm is undone.
Brightness that changes over millimetres (tissue layers, shadows, gain) is divided out
first: it does not decorrelate like speckle and would pass for "no motion".
"""

import math

import numpy as np
from jaxtyping import Bool, Float, Shaped
from scipy.ndimage import uniform_filter

from sonosweep.errors import ScanError
from sonosweep.scan import Frames

SAMPLED_FRAMES = 16
"""Frames looked at to find the brightest level of a stack that is not 8-bit."""

SOFTEST = 1e-6
"""Part of the window that must hold image; guards a division where there is none."""


def full_scale(frames: Frames) -> float:
    """Return how many gray levels lie between black and white.

    255 for bytes; for other types between the darkest and the brightest pixel of some
    frames of the stack, wherever black lies.

    Raises:
        ScanError: If these frames hold one level only, or no numbers.
    """
    if frames.dtype == np.uint8:
        return 255.0
    chosen = np.unique(np.linspace(0, len(frames) - 1, SAMPLED_FRAMES).astype(int))
    some = [np.asarray(frames[int(index)], dtype=np.float64) for index in chosen]
    span = max(float(frame.max()) for frame in some) - min(float(frame.min()) for frame in some)
    if math.isnan(span) or math.isinf(span):
        first = next(i for i, f in zip(chosen, some, strict=True) if not np.isfinite(f).all())
        raise ScanError(f"frame {first} holds pixels that are not numbers")
    if not span > 0:
        raise ScanError(f"all pixels of the frames have the same gray level, {some[0].flat[0]:g}")
    return span


class TextureFilter:
    """Turns gray frames into speckle amplitude relative to its surroundings.

    Args:
        mask: Which pixels hold image.
        level_db: Decibels of echo amplitude per gray level.
        window_px: Rows and columns over which brightness is averaged to be divided out.
    """

    def __init__(
        self,
        mask: Bool[np.ndarray, "rows columns"],
        level_db: float,
        window_px: tuple[int, int],
    ) -> None:
        self._mask = mask
        self._window_px = window_px
        self._nepers_per_level = np.float32(level_db * math.log(10) / 20)
        share = uniform_filter(mask.astype(np.float32), window_px, mode="constant")
        self._scale = np.where(mask, 1 / np.maximum(share, SOFTEST), 0).astype(np.float32)

    def __call__(
        self, gray: Shaped[np.ndarray, "rows columns"]
    ) -> Float[np.ndarray, "rows columns"]:
        """Return amplitude over mean amplitude, less one; zero outside the image."""
        nepers = gray.astype(np.float32)
        nepers *= self._nepers_per_level
        nepers *= self._mask
        mean = uniform_filter(nepers, self._window_px, mode="constant")
        mean *= self._scale
        nepers -= mean
        np.expm1(nepers, out=nepers)
        nepers *= self._mask
        return nepers
