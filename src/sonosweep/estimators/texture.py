"""Speckle as the scanner formed it, recovered from the gray levels it shows.

A B-mode pixel is the logarithm of an echo amplitude. Speckle statistics are those of the
amplitude: for it, the normalized correlation of two images is close to the squared
correlation of the echoes, the estimate scatters least, and the deep black nulls of the
speckle, where a logarithm magnifies noise most, hardly count. So the logarithm is undone.
Brightness that changes over millimetres (tissue layers, shadows, gain) is divided out
first: it does not decorrelate like speckle and would pass for "no motion". So would the edge
of a shadow: where the scanner shows no echo at all, there is no image.
"""

import math

import numpy as np
from jaxtyping import Bool, Float, Shaped
from scipy.ndimage import grey_opening, uniform_filter

from sonosweep.errors import ScanError
from sonosweep.scan import Frames

SAMPLED_FRAMES = 16
"""Frames looked at to find the brightest level of a stack that is not 8-bit."""

BLACK = 0.02
"""Part of the gray scale that counts as black."""

NULL_PX = 5
"""Side of the smallest square that is black for want of echoes; nulls of speckle are smaller."""

SOFTEST = 1e-6
"""Part of the window that must hold image; guards a division where there is none."""


def gray_scale(frames: Frames) -> tuple[float, float]:
    """Return the level of black, and how many levels lie between black and white.

    0 and 255 for bytes; for other types the darkest pixel of some frames of the stack, and
    what lies between it and the brightest.

    Raises:
        ScanError: If these frames hold one level only, or no numbers.
    """
    if frames.dtype == np.uint8:
        return 0.0, 255.0
    chosen = np.unique(np.linspace(0, len(frames) - 1, SAMPLED_FRAMES).astype(int))
    some = [np.asarray(frames[int(index)], dtype=np.float64) for index in chosen]
    black = min(float(frame.min()) for frame in some)
    span = max(float(frame.max()) for frame in some) - black
    if math.isnan(span) or math.isinf(span):
        first = next(i for i, f in zip(chosen, some, strict=True) if not np.isfinite(f).all())
        raise ScanError(f"frame {first} holds pixels that are not numbers")
    if not span > 0:
        raise ScanError(f"all pixels of the frames have the same gray level, {some[0].flat[0]:g}")
    return black, span


class TextureFilter:
    """Turns gray frames into speckle amplitude relative to its surroundings.

    Args:
        mask: Which pixels hold image.
        scale: Of :func:`gray_scale`.
        dynamic_range_db: Echo amplitude from black to white.
        window_px: Rows and columns over which brightness is averaged to be divided out.
    """

    def __init__(
        self,
        mask: Bool[np.ndarray, "rows columns"],
        scale: tuple[float, float],
        dynamic_range_db: float,
        window_px: tuple[int, int],
    ) -> None:
        self._mask = mask
        self._window_px = window_px
        black, span = scale
        self._darkest = black + BLACK * span
        self._nepers_per_level = np.float32(dynamic_range_db / span * math.log(10) / 20)
        self._weight = self._weight_of(mask)

    def __call__(
        self, gray: Shaped[np.ndarray, "rows columns"]
    ) -> Float[np.ndarray, "rows columns"]:
        """Return amplitude over mean amplitude, less one; zero where there is no image."""
        mask, weight = self._mask, self._weight
        empty = self._empty(gray)
        if empty.any():
            mask = mask & ~empty
            weight = self._weight_of(mask)
        nepers = gray.astype(np.float32)
        nepers *= self._nepers_per_level
        nepers *= mask
        mean = uniform_filter(nepers, self._window_px, mode="constant")
        mean *= weight
        nepers -= mean
        np.expm1(nepers, out=nepers)
        nepers *= mask
        return nepers

    def _empty(self, gray: np.ndarray) -> np.ndarray:
        """Return where no echo is shown: black, but for the nulls of the speckle."""
        black = (gray <= self._darkest) & self._mask
        return grey_opening(black, (NULL_PX, NULL_PX)) if black.any() else black

    def _weight_of(self, mask: np.ndarray) -> np.ndarray:
        """Return what turns a mean over a window into one over its pixels that hold image."""
        share = uniform_filter(mask.astype(np.float32), self._window_px, mode="constant")
        return np.where(mask, 1 / np.maximum(share, SOFTEST), 0).astype(np.float32)
