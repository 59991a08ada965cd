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
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from sonosweep.errors import ScanError
from sonosweep.estimators.coherence import patch_widths
from sonosweep.estimators.decorrelation_curve import DecorrelationCurve, curve_from_speckle
from sonosweep.estimators.estimator import MotionEstimate, MotionEstimator, Progress
from sonosweep.estimators.fusion import PairMotion, fuse_pairs
from sonosweep.estimators.matching import MatchedPair, PairMatcher, matched_pairs
from sonosweep.estimators.patches import PatchGrid, patch_grid
from sonosweep.estimators.plane_fit import NOTHING, PlaneFit, fit_out_of_plane
from sonosweep.scan import Scan

BASELINES = (1, 2, 4)
"""Frames from one to the other of a pair: long ones drift less, short ones always match."""

TURN_STD_RAD = math.radians(0.2)
"""Pitch and yaw of a step of a hand-held sweep; measured 0.1 to 0.3 degrees."""

ROLL_STD_RAD = math.radians(1.0)
"""Roll of a step: images tell it well, so this only holds a step nothing was seen of."""

SHIFT_STD_MM = 3.0
"""Translation of a step: as wide as makes no difference to a step that was seen."""

UNEVEN = 0.2
"""By how much one side of the image may decorrelate faster than the curve says, relative."""

UNEVEN_TRACKED = 0.1
"""The same for a curve whose change with depth was measured."""

FARTHEST = 0.3
"""Part of the curve's peak below which a correlation only says "far"; long pairs that do
are left out."""


class DecorrelationEstimator(MotionEstimator):
    """Estimates motion from speckle without training.

    Args:
        curve: From ``sonosweep calibrate``; ``None`` guesses one from the size of the
            speckle, and the result says so.
        baselines: Frames from one to the other of a pair.
        patches_across: Patches, side by side, along the longer side of the image.
        turn_std_rad: How much pitch and yaw of a step are expected to be; larger follows
            real tilts better and drifts more.

    Raises:
        ScanError: If neighboring frames are not among the pairs.
    """

    def __init__(
        self,
        curve: DecorrelationCurve | None = None,
        baselines: tuple[int, ...] = BASELINES,
        patches_across: float = 8.0,
        turn_std_rad: float = TURN_STD_RAD,
    ) -> None:
        if 1 not in baselines or min(baselines) < 1:
            raise ScanError(f"baselines must be 1 and larger counts of frames, got {baselines}")
        self.curve = curve
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
            raise ScanError(f"motion needs 2 frames or more, '{scan.name}' has {len(scan.frames)}")
        grid = patch_grid(scan, self.patches_across)
        dynamic_range_db = (self.curve or DecorrelationCurve()).dynamic_range_db
        matcher = PairMatcher(scan, grid, dynamic_range_db, max(self.baselines) + 1)
        curve, usual = _choose_curve(self.curve, grid, matcher)
        pairs = [
            fit_pair(pair, curve, grid, usual)
            for pair in matched_pairs(matcher, len(scan.frames), self.baselines, progress)
        ]
        _check_seen(scan.name, len(scan.frames) - 1, pairs)
        motion, std = fuse_motion(pairs, len(scan.frames) - 1, grid, self.turn_std_rad)
        return MotionEstimate(
            torch.from_numpy(motion), torch.from_numpy(std), _assumptions(curve, pairs)
        )


@dataclass(frozen=True, eq=False)
class FittedPair:
    """The motion between two frames of a scan.

    Attributes:
        first: Index of the earlier frame.
        last: Index of the later frame.
        in_plane: Lateral, axial (mm) and roll (rad) about the middle of the patches.
        out_of_plane: Elevational (mm), pitch and yaw (rad) about it.
        is_far: Whether too little correlation is left to tell one distance from a larger.
    """

    first: int
    last: int
    in_plane: PlaneFit
    out_of_plane: PlaneFit
    is_far: bool


def _choose_curve(
    curve: DecorrelationCurve | None, grid: PatchGrid, matcher: PairMatcher
) -> tuple[DecorrelationCurve, Float[np.ndarray, " patches"]]:
    """Return the curve, guessed if none is given, and the fineness it holds for."""
    if curve is not None:
        return curve, usual_fineness(curve, grid, matcher)
    usual = matcher.usual_fineness()
    return curve_from_speckle(grid.centers_mm[:, 1], usual), usual


def usual_fineness(
    curve: DecorrelationCurve, grid: PatchGrid, matcher: PairMatcher
) -> Float[np.ndarray, " patches"]:
    """Return the fineness the curve holds for, at each patch; see ``coherence``."""
    if curve.fineness_per_mm2:
        return np.interp(grid.centers_mm[:, 1], curve.depth_mm, curve.fineness_per_mm2)
    return matcher.usual_fineness()


def fit_pair(
    pair: MatchedPair,
    curve: DecorrelationCurve,
    grid: PatchGrid,
    usual_per_mm2: Float[np.ndarray, " patches"],
) -> FittedPair:
    """Return the motion between two matched frames; nothing if they are too far apart."""
    match = pair.match
    is_far = match.typical < FARTHEST * curve.peak
    if is_far and pair.last - pair.first > 1:
        return FittedPair(pair.first, pair.last, NOTHING, NOTHING, is_far)
    depth_mm = grid.centers_mm[:, 1]
    width_mm = patch_widths(curve, depth_mm, match.fineness_per_mm2, usual_per_mm2)
    out_of_plane = fit_out_of_plane(
        match.correlation, match.speckles, curve, width_mm, grid.from_middle_mm, grid.redundancy
    )
    unsure = _less_sure_of_turns(out_of_plane, curve, grid)
    return FittedPair(pair.first, pair.last, match.in_plane, unsure, is_far)


def _less_sure_of_turns(fit: PlaneFit, curve: DecorrelationCurve, grid: PatchGrid) -> PlaneFit:
    """Return the fit with the error that the curve itself makes from one side to the other.

    Tissue that decorrelates faster on one side looks like a turn, in every frame alike, so
    no scatter of patches shows it.
    """
    if fit is NOTHING:
        return fit
    covariance = np.linalg.inv(fit.information)
    across_mm = grid.from_middle_mm.std(axis=0)
    uneven = UNEVEN_TRACKED if curve.source == "tracked" else UNEVEN
    turn_rad = uneven * abs(fit.value[0]) / across_mm[::-1]
    covariance[[1, 2], [1, 2]] += turn_rad**2
    return PlaneFit(fit.value, np.linalg.inv(covariance))


def fuse_motion(
    pairs: list[FittedPair], steps: int, grid: PatchGrid, turn_std_rad: float
) -> tuple[Float[np.ndarray, "steps motion=6"], Float[np.ndarray, "steps motion=6"]]:
    """Return the motion of every step about the image's origin, and its deviation."""
    flat = fuse_pairs(
        [PairMotion(pair.first, pair.last, pair.in_plane) for pair in pairs],
        steps,
        np.array([SHIFT_STD_MM, SHIFT_STD_MM, ROLL_STD_RAD]),
    )
    deep = fuse_pairs(
        [PairMotion(pair.first, pair.last, pair.out_of_plane) for pair in pairs],
        steps,
        np.array([SHIFT_STD_MM, turn_std_rad, turn_std_rad]),
    )
    return _motion(flat, deep, grid.middle_mm)


def _check_seen(name: str, steps: int, pairs: list[FittedPair]) -> None:
    """Refuse a scan with a step that no pair of frames says anything about."""
    seen = np.zeros(steps, dtype=bool)
    for pair in pairs:
        if pair.out_of_plane is not NOTHING:
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


def _assumptions(curve: DecorrelationCurve, pairs: list[FittedPair]) -> tuple[str, ...]:
    """Return what a user must know before believing the result."""
    scale = {
        "guess": "The elevational scale is a guess from the size of the speckle: no"
        " decorrelation curve was given, and frame averaging and the height of the elements"
        " stretch it, by a factor of two or more; calibrate with a tracked scan or a ruler.",
        "probe": "The elevational scale comes from the probe's beam alone; frame averaging and"
        " gray-level compression of the scanner can stretch it several times.",
        "tracked": f"The elevational scale was measured with a tracker ({curve.preset}) and"
        " holds for that probe, preset and sweep speed.",
        "length": f"The elevational scale was measured on a sweep of known length"
        f" ({curve.preset}) and holds for that probe, preset and sweep speed.",
    }
    always = (
        "The probe never went backward: two frames of speckle do not tell the direction.",
        scale[curve.source],
        "Tissue moved only with the probe's plane: no pulsation, breathing or compression.",
        "The standard deviations are those of speckle; they do not cover a wrong curve, or"
        " tissue that lies slanted to the sweep and seems to slide.",
    )
    steps = [pair for pair in pairs if pair.last - pair.first == 1]
    far = sum(pair.is_far for pair in steps)
    if far == 0:
        return always
    return (
        *always,
        f"In {far} of {len(steps)} steps the frames were too far apart to tell how far: the"
        " probe moved at least as much as estimated; sweep more slowly.",
    )
