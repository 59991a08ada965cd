"""What the patches of two frames say about each other, before any distance is made of it."""

import math
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy.lib.stride_tricks import sliding_window_view

from sonosweep.errors import ScanError
from sonosweep.estimators.coherence import LAG_PX, fineness
from sonosweep.estimators.estimator import Progress
from sonosweep.estimators.patches import PatchGrid
from sonosweep.estimators.plane_fit import PlaneFit, fit_in_plane
from sonosweep.estimators.registration import (
    LOWEST_CORRELATION,
    correlate,
    height_at,
    highest,
    moments,
    refine,
)
from sonosweep.estimators.texture import TextureFilter, gray_scale
from sonosweep.scan import FrameView, Scan

NARROWEST_PX = 24
"""Least window over which brightness is divided out: a dozen speckles, which it must spare."""

COARSE_PX = 256
"""Longest side at which motion is searched for; scanners show far more pixels than speckles."""

SEARCH_MM = 1.2
"""In-plane motion between neighboring frames that is looked for, each way."""

NARROW_PX = 3
"""Search around a motion that is already roughly known."""

CLEAR = 0.5
"""Correlation above which the summit of a patch is its own and not one of the noise."""

INTERPOLATION_PX = 0.05
"""Error of the place of a correlation summit between pixels, speckle two pixels wide."""

MOST_EMPTY = 0.5
"""Part of a patch that may show no echo; the rest holds too few speckles of a darker one."""

SAMPLED_FRAMES = 8
"""Frames from which the usual fineness of a scan is taken."""


@dataclass(frozen=True, eq=False)
class PairMatch:
    """How two frames match.

    Attributes:
        in_plane: Lateral, axial (mm) and roll (rad) about the middle of the patches.
        correlation: Of each patch, where it is in the other frame; NaN if it has no texture,
            is mostly black, or has left the image.
        speckles: How many independent speckles a patch holds.
        fineness_per_mm2: How fast each patch decorrelates laterally.
    """

    in_plane: PlaneFit
    correlation: Float[np.ndarray, " patches"]
    speckles: float
    fineness_per_mm2: Float[np.ndarray, " patches"]

    @property
    def typical(self) -> float:
        """Correlation of the typical patch; 0 if there is none."""
        known = self.correlation[np.isfinite(self.correlation)]
        return float(np.median(known)) if known.size else 0.0


@dataclass(frozen=True, eq=False)
class MatchedPair:
    """Two frames of a scan and how they match.

    Attributes:
        first: Index of the earlier frame.
        last: Index of the later frame.
        match: How they match.
    """

    first: int
    last: int
    match: PairMatch


@dataclass(frozen=True, eq=False)
class _Level:
    """A frame ready to be matched, at one resolution."""

    texture: np.ndarray
    moments: tuple[np.ndarray, np.ndarray]
    is_empty: np.ndarray  # of each patch


@dataclass(frozen=True, eq=False)
class _Textured:
    """A frame ready to be matched, whole and shrunk."""

    fine: _Level
    coarse: _Level


class PairMatcher:
    """Matches the patches of two frames; keeps the last few frames ready.

    Args:
        scan: Whose frames.
        grid: Its patches.
        dynamic_range_db: Echo amplitude from black to white.
        kept: How many prepared frames to hold.
    """

    def __init__(self, scan: Scan, grid: PatchGrid, dynamic_range_db: float, kept: int = 6) -> None:
        self._from_middle_mm = grid.from_middle_mm
        self._grid = grid
        self._name = scan.name
        self._frames = FrameView(scan.frames, rectangle_px=grid.rectangle_px, gray=True)
        window = (max(NARROWEST_PX, grid.side_px // 2),) * 2
        scale = gray_scale(self._frames)
        self._filter = TextureFilter(grid.mask, scale, dynamic_range_db, window)
        self._ready: OrderedDict[int, _Textured] = OrderedDict()
        self._kept = kept
        self._pixel_mm = np.array(grid.spacing_mm[::-1])
        self._shrink = max(1, max(grid.mask.shape) // COARSE_PX)

    def match(
        self, first: int, last: int, guess: Float[np.ndarray, "unknowns=3"] | None = None
    ) -> PairMatch:
        """Return how the patches of one frame match those of a later one.

        Every patch is first matched on its own, then again within a pixel of where the
        rigid motion of all of them puts it: the highest of many correlations by chance is
        no measure of distance.

        Args:
            first: Index of the earlier frame.
            last: Index of the later frame.
            guess: In-plane motion to search around; ``None`` searches widely.

        Raises:
            ScanError: If a frame holds NaN.
        """
        one, other = self._textured(first), self._textured(last)
        rough = self._rough(one, other, guess)
        base = np.rint(self._shift_px(rough.value)).astype(np.int64)
        surfaces = self._correlate(one.fine, other.fine, base, 1)
        shift, summit, curvature = refine(surfaces, np.zeros_like(base))
        hill = np.isfinite(summit)
        typical = np.median(curvature[hill], axis=0) if hill.any() else np.ones(2)
        expected = np.clip(self._shift_px(rough.value) - base, -1, 1)
        height = height_at(surfaces, expected, typical)
        correlation = np.where(hill & (height > CLEAR), summit, height)
        speckles = max(1.0, self._grid.side_px**2 * math.sqrt(typical.prod()) / math.pi)
        share = np.sqrt((1 / np.clip(summit, LOWEST_CORRELATION, 1) ** 2 - 1) / speckles)
        std_px = np.hypot(share[:, None] / np.sqrt(typical), INTERPOLATION_PX)
        in_plane = self._rigid(shift + base, std_px)
        return PairMatch(in_plane, correlation, speckles, self.fineness(first))

    def fineness(self, index: int) -> Float[np.ndarray, " patches"]:
        """Return how fast the patches of a frame decorrelate laterally, per mm squared."""
        one = self._textured(index).fine
        aside = np.tile(np.array([0, LAG_PX]), (len(self._grid.corners_px), 1))
        return fineness(self._correlate(one, one, aside, 0)[:, 0, 0], self._pixel_mm[1])

    def usual_fineness(self) -> Float[np.ndarray, " patches"]:
        """Return the median fineness of patches at the same depth, over some frames."""
        chosen = np.unique(np.linspace(0, len(self._frames) - 1, SAMPLED_FRAMES).astype(int))
        every = np.stack([self.fineness(int(index)) for index in chosen])
        result = np.full(every.shape[1], np.nan)
        for row in np.unique(self._grid.corners_px[:, 0]):
            here = self._grid.corners_px[:, 0] == row
            known = every[:, here][np.isfinite(every[:, here])]
            result[here] = np.median(known) if known.size else np.nan
        return result

    def _rough(self, one: _Textured, other: _Textured, guess: np.ndarray | None) -> PlaneFit:
        """Return the rigid motion of all patches, each matched within the search range."""
        pixel_mm = self._pixel_mm * self._shrink
        if guess is None:
            widest = math.ceil(SEARCH_MM / pixel_mm.min())
            guess, radius = np.zeros(3), min(widest, self._grid.side_px // (2 * self._shrink))
        else:
            radius = NARROW_PX
        base = np.rint(self._shift_px(guess) / self._shrink).astype(np.int64)
        surfaces = self._correlate(one.coarse, other.coarse, base, radius, self._shrink)
        shift, summit, _ = refine(surfaces, highest(surfaces))
        share = np.sqrt(1 / np.clip(summit, LOWEST_CORRELATION, 1) ** 2 - 1)
        std_px = np.tile(np.hypot(share, INTERPOLATION_PX)[:, None], (1, 2))
        return self._rigid((shift + base) * self._shrink, std_px * self._shrink)

    def _rigid(self, shift_px: np.ndarray, std_px: np.ndarray) -> PlaneFit:
        """Return the motion of the probe that shifts patches so in the second frame."""
        # What the probe moves toward comes to meet it: the image shifts the other way.
        moved_mm = (-shift_px * self._pixel_mm)[:, ::-1]
        std_mm = (std_px * self._pixel_mm)[:, ::-1]
        return fit_in_plane(moved_mm, std_mm, self._from_middle_mm, self._grid.redundancy)

    def _shift_px(self, motion: np.ndarray) -> np.ndarray:
        """Return by how many pixels a rigid motion shifts each patch in the second frame."""
        lateral, axial, roll = motion
        x, y = self._from_middle_mm.T
        return -np.stack((axial + roll * x, lateral - roll * y), axis=-1) / self._pixel_mm

    def _correlate(
        self, one: _Level, other: _Level, base: np.ndarray, radius: int, shrink: int = 1
    ) -> np.ndarray:
        surfaces = correlate(
            one.texture,
            one.moments,
            other.texture,
            other.moments,
            self._grid.corners_px // shrink,
            self._grid.side_px // shrink,
            base,
            radius,
        )
        surfaces[one.is_empty | other.is_empty] = np.nan
        return surfaces

    def _textured(self, index: int) -> _Textured:
        if index not in self._ready:
            gray = self._frames[index]
            if not np.isfinite(gray).all():
                raise ScanError(
                    f"frame {index} of '{self._name}' holds pixels that are not numbers"
                )
            texture = self._filter(gray)
            fine = _Level(texture, moments(texture), self._is_empty(texture))
            self._ready[index] = _Textured(fine, self._shrunk(fine))
            if len(self._ready) > self._kept:
                self._ready.popitem(last=False)
        return self._ready[index]

    def _shrunk(self, fine: _Level) -> _Level:
        """Return the means of small squares of pixels."""
        side = self._shrink
        if side == 1:
            return fine
        rows, columns = (length // side for length in fine.texture.shape)
        squares = fine.texture[: rows * side, : columns * side].reshape(rows, side, columns, side)
        small = np.ascontiguousarray(squares.mean(axis=(1, 3)))
        return _Level(small, moments(small), fine.is_empty)

    def _is_empty(self, texture: np.ndarray) -> np.ndarray:
        """Say of each patch whether most of it shows no echo."""
        side, corners = self._grid.side_px, self._grid.corners_px
        patches = sliding_window_view(texture == 0, (side, side))
        return patches[corners[:, 0], corners[:, 1]].mean(axis=(1, 2)) > MOST_EMPTY


def matched_pairs(
    matcher: PairMatcher, frames: int, baselines: tuple[int, ...], progress: Progress | None = None
) -> Iterator[MatchedPair]:
    """Yield every pair of frames that is one of these baselines long, by its later frame.

    Long pairs are searched around the sum of the short ones between them.

    Args:
        matcher: Of the scan.
        frames: How many there are.
        baselines: Frames from one to the other, increasing, 1 among them.
        progress: Told after each frame.
    """
    motion = np.zeros((frames - 1, 3))
    for last in range(1, frames):
        for baseline in baselines:
            first = last - baseline
            if first < 0:
                continue
            guess = motion[first:last].sum(axis=0) if baseline > 1 else None
            match = matcher.match(first, last, guess)
            if baseline == 1:
                motion[first] = match.in_plane.value
            yield MatchedPair(first, last, match)
        if progress is not None:
            progress(last, frames - 1)
