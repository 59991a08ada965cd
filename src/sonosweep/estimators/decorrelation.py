"""Motion from speckle alone: registration in plane, decorrelation out of plane.

Frames are cut into overlapping patches. How far a patch shifted between two frames is
found by correlation; how much of the correlation is lost tells how far the frames are
apart, through a decorrelation curve. A plane through these distances gives the turns.

References:
    Chen et al., "Determination of scan-plane motion using speckle decorrelation", 1997.
    Tuthill et al., "Automated three-dimensional US frame positioning computed from
    elevational speckle decorrelation", 1998.
    Gee et al., "Sensorless freehand 3D ultrasound in real tissue: speckle decorrelation
    without fully developed speckle", 2006.
"""

import math
from collections import OrderedDict
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from sonosweep.errors import ScanError
from sonosweep.estimators.decorrelation_curve import DecorrelationCurve
from sonosweep.estimators.estimator import MotionEstimate, MotionEstimator, Progress
from sonosweep.estimators.fusion import PairMotion, fuse_pairs
from sonosweep.estimators.patches import PatchGrid, patch_grid
from sonosweep.estimators.plane_fit import NOTHING, PlaneFit, fit_in_plane, fit_out_of_plane
from sonosweep.estimators.registration import (
    LOWEST_CORRELATION,
    correlate,
    height_at,
    highest,
    moments,
    refine,
)
from sonosweep.estimators.texture import TextureFilter, full_scale
from sonosweep.scan import FrameView, Scan

BASELINES = (1, 2, 4)
"""Frames from one to the other of a pair: long ones drift less, short ones always match."""

SEARCH_MM = 1.2
"""In-plane motion between neighbouring frames that is looked for, each way."""

NARROW_PX = 3
"""Search around a motion that is already roughly known."""

TURN_STD_RAD = math.radians(0.2)
"""Pitch and yaw of a step of a hand-held sweep; measured 0.1 to 0.3 degrees."""

ROLL_STD_RAD = math.radians(1.0)
"""Roll of a step: images tell it well, so this only holds a step nothing was seen of."""

SHIFT_STD_MM = 3.0
"""Translation of a step: as wide as makes no difference to a step that was seen."""

FARTHEST = 0.3
"""Part of the curve's peak below which a long pair is left out: it only says "far"."""

CLEAR = 0.5
"""Correlation above which the summit of a patch is its own and not one of the noise."""

INTERPOLATION_PX = 0.05
"""Error of the place of a correlation summit between pixels, speckle two pixels wide."""


@dataclass(frozen=True, eq=False)
class _Textured:
    """A frame ready to be matched."""

    texture: np.ndarray
    moments: tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True, eq=False)
class PairMatch:
    """What two frames say about the motion between them.

    Attributes:
        in_plane: Lateral, axial (mm) and roll (rad) about the middle of the patches.
        out_of_plane: Elevational (mm), pitch and yaw (rad) about it.
        correlation: Of the typical patch.
    """

    in_plane: PlaneFit
    out_of_plane: PlaneFit
    correlation: float


class DecorrelationEstimator(MotionEstimator):
    """Estimates motion from speckle without training.

    Args:
        curve: From ``sonosweep calibrate``; ``None`` guesses one, and the result says so.
        baselines: Frames from one to the other of a pair.
        patches_across: Patches, side by side, along the longer side of the image.
        turn_std_rad: How much pitch and yaw of a step are expected to be; larger follows
            real tilts better and drifts more.
    """

    def __init__(
        self,
        curve: DecorrelationCurve | None = None,
        baselines: tuple[int, ...] = BASELINES,
        patches_across: float = 8.0,
        turn_std_rad: float = TURN_STD_RAD,
    ) -> None:
        self.curve = curve or DecorrelationCurve()
        self.baselines = tuple(sorted(set(baselines)))
        self.patches_across = patches_across
        self.turn_std_rad = turn_std_rad

    def estimate(self, scan: Scan, progress: Progress | None = None) -> MotionEstimate:
        """Return the motion between consecutive frames, the sweep going forward.

        Raises:
            ScanError: If the scan has fewer than two frames, no pixel spacing, or frames
                without speckle.
        """
        if len(scan.frames) < 2:
            raise ScanError(f"'{scan.name}' has {len(scan.frames)} frame; motion needs two")
        grid = patch_grid(scan, self.patches_across)
        in_plane, out_of_plane = self._measure(scan, grid, progress)
        steps = len(scan.frames) - 1
        _check_seen(scan.name, steps, out_of_plane)
        wide = np.array([SHIFT_STD_MM, SHIFT_STD_MM, ROLL_STD_RAD])
        tilt = np.array([SHIFT_STD_MM, self.turn_std_rad, self.turn_std_rad])
        flat = fuse_pairs(in_plane, steps, np.zeros(3), wide)
        deep = fuse_pairs(out_of_plane, steps, np.zeros(3), tilt)
        motion, std = _motion(flat, deep, _middle_mm(grid))
        return MotionEstimate(
            torch.from_numpy(motion), torch.from_numpy(std), _assumptions(self.curve)
        )

    def _measure(
        self, scan: Scan, grid: PatchGrid, progress: Progress | None
    ) -> tuple[list[PairMotion], list[PairMotion]]:
        """Return the in-plane and the out-of-plane motion of every pair."""
        matcher = PairMatcher(scan, grid, self.curve.dynamic_range_db)
        in_plane: list[PairMotion] = []
        out_of_plane: list[PairMotion] = []
        shifts = np.zeros((len(scan.frames) - 1, 3))
        for last in range(1, len(scan.frames)):
            for baseline in self.baselines:
                first = last - baseline
                if first < 0:
                    continue
                guess = shifts[first:last].sum(axis=0) if baseline > 1 else None
                match = matcher.match(first, last, self.curve, guess)
                if baseline == 1:
                    shifts[first] = match.in_plane.value
                elif match.correlation < FARTHEST * self.curve.peak:
                    continue
                in_plane.append(PairMotion(first, last, match.in_plane))
                out_of_plane.append(PairMotion(first, last, match.out_of_plane))
            if progress is not None:
                progress(last, len(scan.frames) - 1)
        return in_plane, out_of_plane


class PairMatcher:
    """Matches the patches of two frames; keeps the last few frames ready.

    Args:
        scan: Whose frames.
        grid: Its patches.
        dynamic_range_db: Echo amplitude from black to white.
        kept: How many prepared frames to hold.
    """

    def __init__(self, scan: Scan, grid: PatchGrid, dynamic_range_db: float, kept: int = 6) -> None:
        self.grid = grid
        self._name = scan.name
        self._frames = FrameView(scan.frames, rectangle_px=grid.rectangle_px, gray=True)
        window = (max(3, grid.side_px // 2),) * 2
        self._filter = TextureFilter(grid.mask, dynamic_range_db / full_scale(self._frames), window)
        self._ready: OrderedDict[int, _Textured] = OrderedDict()
        self._kept = kept
        self._pixel_mm = np.array(grid.spacing_mm[::-1])
        self._from_middle_mm = grid.centers_mm - _middle_mm(grid)
        covered = np.zeros_like(grid.mask)
        for row, column in grid.corners_px:
            covered[row : row + grid.side_px, column : column + grid.side_px] = True
        self._redundancy = len(grid.corners_px) * grid.side_px**2 / covered.sum()

    def match(
        self,
        first: int,
        last: int,
        curve: DecorrelationCurve,
        guess: Float[np.ndarray, "unknowns=3"] | None = None,
    ) -> PairMatch:
        """Return the in-plane and out-of-plane motion from one frame to another.

        Args:
            first: Index of the earlier frame.
            last: Index of the later frame.
            curve: What tells distance from correlation.
            guess: In-plane motion to search around; ``None`` searches widely.
        """
        moved, correlation, curvature = self.patches(first, last, guess)
        speckles = self.speckles(curvature)
        known = np.clip(correlation, LOWEST_CORRELATION, 1)
        share = np.sqrt((1 / known**2 - 1) / speckles)[:, None]
        std_px = np.hypot(share / np.sqrt(curvature), INTERPOLATION_PX)
        flat = fit_in_plane(
            moved[:, ::-1],
            (std_px * self._pixel_mm)[:, ::-1],
            self._from_middle_mm,
            self._redundancy,
        )
        deep = fit_out_of_plane(
            correlation,
            speckles,
            curve,
            self.grid.centers_mm,
            self._from_middle_mm,
            self._redundancy,
        )
        typical = float(np.nanmedian(correlation)) if np.isfinite(correlation).any() else 0.0
        return PairMatch(flat, deep, typical)

    def patches(
        self, first: int, last: int, guess: Float[np.ndarray, "unknowns=3"] | None = None
    ) -> tuple[
        Float[np.ndarray, "patches rc=2"],
        Float[np.ndarray, " patches"],
        Float[np.ndarray, "rc=2"],
    ]:
        """Return how the patches moved (mm), how alike they stayed, and how fine they are.

        Every patch is first matched on its own, then again within a pixel of where the
        rigid motion of all of them puts it: the highest of many correlations by chance is
        no measure of distance.
        """
        one, other = self._textured(first), self._textured(last)
        widest = math.ceil(SEARCH_MM / min(self._pixel_mm))
        radius = NARROW_PX if guess is not None else min(widest, self.grid.side_px // 2)
        fit = PlaneFit(np.zeros(3) if guess is None else guess, np.zeros((3, 3)))
        base = self._shift_px(fit.value)
        surfaces = self._correlate(one, other, base, radius)
        shift, height, curvature = refine(surfaces, highest(surfaces))
        moved = -(shift + base) * self._pixel_mm
        with np.errstate(divide="ignore", invalid="ignore"):
            std = np.sqrt(1 / height**2 - 1 + INTERPOLATION_PX)[:, None] * self._pixel_mm
        fit = fit_in_plane(moved[:, ::-1], std[:, ::-1], self._from_middle_mm, 1.0)
        base = self._shift_px(fit.value)
        surfaces = self._correlate(one, other, base, 1)
        shift, height, curvature = refine(surfaces, np.zeros_like(base))
        known = np.isfinite(height)
        if not known.any():
            return np.full(base.shape, np.nan), height, np.ones(2)
        typical = np.median(curvature[known], axis=0)
        moved = -(shift + base) * self._pixel_mm
        rigid = self._rigid_shift(fit.value) - base
        plain = height_at(surfaces, np.clip(rigid, -1, 1), typical)
        height = np.where(known & (plain > CLEAR), height, plain)
        return moved, height, typical

    def speckles(self, curvature: Float[np.ndarray, "rc=2"]) -> float:
        """Return how many independent speckles a patch holds."""
        return max(1.0, self.grid.side_px**2 * math.sqrt(curvature.prod()) / math.pi)

    def _correlate(
        self, one: _Textured, other: _Textured, base: np.ndarray, radius: int
    ) -> np.ndarray:
        return correlate(
            one.texture,
            one.moments,
            other.texture,
            other.moments,
            self.grid.corners_px,
            self.grid.side_px,
            base,
            radius,
        )

    def _shift_px(self, motion: np.ndarray) -> np.ndarray:
        return np.rint(self._rigid_shift(motion)).astype(np.int64)

    def _rigid_shift(self, motion: np.ndarray) -> np.ndarray:
        """Return by how many pixels a rigid motion shifts each patch in the second frame."""
        lateral, axial, roll = motion
        x, y = self._from_middle_mm.T
        moved = np.stack((axial + roll * x, lateral - roll * y), axis=-1)
        return -moved / self._pixel_mm

    def _textured(self, index: int) -> _Textured:
        if index not in self._ready:
            gray = self._frames[index]
            if not np.isfinite(gray).all():
                raise ScanError(
                    f"frame {index} of '{self._name}' holds pixels that are not numbers"
                )
            texture = self._filter(gray)
            self._ready[index] = _Textured(texture, moments(texture))
            if len(self._ready) > self._kept:
                self._ready.popitem(last=False)
        return self._ready[index]


def _middle_mm(grid: PatchGrid) -> np.ndarray:
    """Return the point about which turns are estimated: the middle of all patches."""
    return grid.centers_mm.mean(axis=0)


def _check_seen(name: str, steps: int, pairs: list[PairMotion]) -> None:
    """Refuse a scan with a step that no pair of frames says anything about."""
    seen = np.zeros(steps, dtype=bool)
    for pair in pairs:
        if pair.fit is not NOTHING:
            seen[pair.first : pair.last] = True
    if not seen.all():
        step = int(np.argmin(seen))
        raise ScanError(
            f"frames {step} and {step + 1} of '{name}' have no speckle in common: are they"
            " black, flat or of another place? Cut the scan there"
        )


def _motion(
    flat: tuple[np.ndarray, np.ndarray],
    deep: tuple[np.ndarray, np.ndarray],
    middle_mm: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return motions about the image's origin from those about its middle."""
    (lateral, axial, roll), flat_std = flat[0].T, flat[1]
    (elevational, pitch, yaw), deep_std = deep[0].T, deep[1]
    x, y = middle_mm
    # The probe moves one way: what scatter puts behind the first frame stays beside it.
    elevational = np.maximum(elevational, 0)
    motion = np.stack(
        (
            lateral + roll * y,
            axial - roll * x,
            elevational - pitch * y + yaw * x,
            pitch,
            yaw,
            roll,
        ),
        axis=-1,
    )
    std = np.stack(
        (
            np.hypot(flat_std[:, 0], flat_std[:, 2] * y),
            np.hypot(flat_std[:, 1], flat_std[:, 2] * x),
            np.sqrt(deep_std[:, 0] ** 2 + (deep_std[:, 1] * y) ** 2 + (deep_std[:, 2] * x) ** 2),
            deep_std[:, 1],
            deep_std[:, 2],
            flat_std[:, 2],
        ),
        axis=-1,
    )
    return motion, std


def _assumptions(curve: DecorrelationCurve) -> tuple[str, ...]:
    """Return what a user must know before believing the result."""
    scale = {
        "guess": "The elevational scale is a guess: no decorrelation curve was given, and"
        " scanners stretch it several times; calibrate with a tracked scan or a ruler.",
        "probe": "The elevational scale comes from the probe's beam alone; frame averaging and"
        " gray-level compression of the scanner can stretch it several times.",
        "tracked": f"The elevational scale was measured with a tracker ({curve.preset}) and"
        " holds for that probe, preset and sweep speed.",
        "length": f"The elevational scale was measured on a sweep of known length"
        f" ({curve.preset}) and holds for that probe, preset and sweep speed.",
    }
    return (
        "The probe never went backward: two frames of speckle do not tell the direction.",
        scale[curve.source],
        "Tissue moved only with the probe's plane: no pulsation, breathing or compression.",
    )
