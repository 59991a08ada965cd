"""The decorrelation curve of a probe and preset, measured on one sweep.

With tracked poses, every patch of every frame pair gives a correlation at a known distance,
and the whole curve is fitted. With nothing but the length of the sweep, the shape comes from
the sweep itself: pairs two and four frames apart are two and four times as far from each
other, on average, whatever a millimeter is; the length then says what a millimeter is.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from scipy.optimize import least_squares

from sonosweep.errors import ScanError
from sonosweep.estimators.coherence import patch_widths
from sonosweep.estimators.decorrelation import (
    BASELINES,
    TURN_STD_RAD,
    fit_pair,
    fuse_motion,
    usual_fineness,
)
from sonosweep.estimators.decorrelation_curve import (
    DecorrelationCurve,
    correlation_at,
    scaled_curve,
)
from sonosweep.estimators.estimator import Progress
from sonosweep.estimators.matching import MatchedPair, PairMatcher, matched_pairs
from sonosweep.estimators.patches import PatchGrid, patch_grid
from sonosweep.geometry import invert_pose, transform_points
from sonosweep.scan import Scan

LEAST_FRAMES = 8
"""Fewer pairs than these give hold no curve."""

DEPTHS = 4
"""Depths at which a tracked scan gives a width; each holds a quarter of the patches."""

SCALE_ROUNDS = 4
"""Rescalings until the path is as long as it should be: turns are not scaled, so one is not
quite enough."""

STRETCHES = 10
"""Parts of a sweep over which its direction is told, so that a tracker's noise is not."""

LEAST_OUT_OF_PLANE = 0.5
"""Part of the movement that must be out of the plane for decorrelation to be due to it."""

OUTLIER = 0.1
"""Correlation by which a patch may miss the curve before it counts less."""

LENGTH_MM = (1.0, 1000.0)
"""Lengths that a sweep of a hand-held probe can have."""


@dataclass(frozen=True, eq=False)
class _Sweep:
    """Everything of a sweep that a curve can be fitted to."""

    grid: PatchGrid
    pairs: list[MatchedPair]
    frames: int
    usual_per_mm2: np.ndarray


def calibrate(
    scan: Scan,
    length_mm: float | None = None,
    dynamic_range_db: float = 60.0,
    progress: Progress | None = None,
) -> DecorrelationCurve:
    """Return the decorrelation curve of the probe and preset of a scan.

    The sweep should be straight, in one direction, without tilting, over tissue like that
    to be scanned, and no faster than a beam width (about half a millimeter) per frame.

    Args:
        scan: Needs tracked poses, or ``length_mm``.
        length_mm: How far the probe moved, by a ruler. Used instead of poses.
        dynamic_range_db: Of the scanner's display; the curve remembers it.
        progress: Told after each frame.

    Raises:
        ScanError: If the scan has neither poses nor a length, too few frames, or does not
            decorrelate.
    """
    if length_mm is not None:
        return curve_from_length(scan, length_mm, dynamic_range_db, progress)
    return curve_from_tracked(scan, dynamic_range_db, progress)


def curve_from_length(
    scan: Scan,
    length_mm: float,
    dynamic_range_db: float = 60.0,
    progress: Progress | None = None,
) -> DecorrelationCurve:
    """Return the curve with which the estimated sweep is as long as the ruler says.

    Raises:
        ScanError: If the length is impossible, or the sweep does not decorrelate.
    """
    if not LENGTH_MM[0] <= length_mm <= LENGTH_MM[1]:
        raise ScanError(
            f"the length of the sweep must be {LENGTH_MM[0]:g} to {LENGTH_MM[1]:g} mm, got"
            f" {length_mm:g}"
        )
    sweep = _matched(scan, dynamic_range_db, progress)
    curve = DecorrelationCurve(
        exponent=_shape(sweep, scan.name),
        dynamic_range_db=dynamic_range_db,
        source="length",
        preset=scan.name,
    )
    curve = _with_fineness(curve, sweep)
    curve = _rescaled(curve, sweep, length_mm, scan.name)
    quality = {
        "length_mm": length_mm,
        "frames": float(sweep.frames),
        "step_mm": length_mm / (sweep.frames - 1),
        "neighbor_correlation": _typical(sweep, 1),
    }
    return replace(curve, quality=quality)


def curve_from_tracked(
    scan: Scan, dynamic_range_db: float = 60.0, progress: Progress | None = None
) -> DecorrelationCurve:
    """Return the curve that fits correlations to tracked distances best.

    Raises:
        ScanError: If a frame has no tracked pose, or the sweep does not decorrelate.
    """
    poses = scan.image_to_reference
    if poses is None:
        raise ScanError(
            f"'{scan.name}' has no tracked poses: give the length of the sweep (--length-mm)"
        )
    if scan.tracked is not None and not bool(scan.tracked.all()):
        missed = int((~scan.tracked).sum())
        raise ScanError(
            f"the tracker missed {missed} frames of '{scan.name}': cut the scan to a part that"
            " is tracked throughout, or give its length (--length-mm)"
        )
    sweep = _matched(scan, dynamic_range_db, progress)
    share = out_of_plane_share(poses, sweep.grid.middle_mm)
    if share < LEAST_OUT_OF_PLANE:
        raise ScanError(
            f"the probe moved in its plane in '{scan.name}', {share:.0%} of the way out of it:"
            " calibrate with a sweep that moves out of the plane"
        )
    distance_mm = _tracked_distances(sweep, poses)
    curve, rms = _fitted(sweep, distance_mm, scan.name, dynamic_range_db)
    length_mm = _tracked_length(sweep, poses)
    curve = _rescaled(curve, sweep, length_mm, scan.name)
    quality = {
        "length_mm": length_mm,
        "frames": float(sweep.frames),
        "step_mm": length_mm / (sweep.frames - 1),
        "neighbor_correlation": _typical(sweep, 1),
        "correlation_rms_error": rms,
    }
    return replace(curve, quality=quality)


def out_of_plane_share(
    image_to_reference: Float[torch.Tensor, "frames 4 4"], middle_mm: Float[np.ndarray, "xy=2"]
) -> float:
    """Return which part of a movement is out of the plane, from 0 to 1; NaN at rest.

    Args:
        image_to_reference: Poses.
        middle_mm: Point of the image that is followed, lateral and axial.
    """
    apart = max(1, len(image_to_reference) // STRETCHES)
    moved = _moved(image_to_reference, middle_mm, apart)
    return float(moved[:, 2].abs().sum() / moved.norm(dim=-1).sum())


def _moved(
    image_to_reference: torch.Tensor, middle_mm: np.ndarray, apart: int = 1
) -> Float[torch.Tensor, "pairs 3"]:
    """Return how far the middle is moved so many frames later, seen from the earlier one."""
    x, y = middle_mm
    middle = torch.tensor([[x, y, 0.0]], dtype=torch.float64)
    poses = image_to_reference.double()
    later_to_earlier = invert_pose(poses[:-apart]) @ poses[apart:]
    return transform_points(later_to_earlier, middle)[:, 0] - middle


def _matched(scan: Scan, dynamic_range_db: float, progress: Progress | None) -> _Sweep:
    if len(scan.frames) < LEAST_FRAMES:
        raise ScanError(
            f"'{scan.name}' has {len(scan.frames)} frames; a calibration needs {LEAST_FRAMES}"
        )
    grid = patch_grid(scan)
    matcher = PairMatcher(scan, grid, dynamic_range_db, max(BASELINES) + 1)
    usual = usual_fineness(DecorrelationCurve(), grid, matcher)
    pairs = list(matched_pairs(matcher, len(scan.frames), BASELINES, progress))
    if not any(np.isfinite(pair.match.correlation).any() for pair in pairs):
        raise ScanError(f"no two frames of '{scan.name}' have speckle in common")
    return _Sweep(grid, pairs, len(scan.frames), usual)


def _typical(sweep: _Sweep, baseline: int) -> float:
    """Return the median correlation of patches of pairs that far apart."""
    values = [p.match.typical for p in sweep.pairs if p.last - p.first == baseline]
    return float(np.median(values))


def _shape(sweep: _Sweep, name: str) -> float:
    """Return the exponent with which twice as many frames are twice as far."""
    losses = [-np.log(np.clip(_typical(sweep, k), 1e-3, 1 - 1e-6)) for k in (1, 2)]
    if losses[0] < 1e-4:
        raise ScanError(f"the frames of '{name}' do not decorrelate: did the probe move?")
    return float(np.clip(np.log2(losses[1] / losses[0]), 0.5, 2.0))


def _with_fineness(curve: DecorrelationCurve, sweep: _Sweep) -> DecorrelationCurve:
    """Return the curve with its width spread over the sweep's depths, and the fineness there."""
    depth = np.unique(sweep.grid.centers_mm[:, 1])
    return replace(
        curve,
        depth_mm=tuple(depth.tolist()),
        width_mm=(curve.width_mm[0],) * len(depth),
        fineness_per_mm2=tuple(_by_depth(sweep, depth).tolist()),
    )


def _by_depth(sweep: _Sweep, depth_mm: np.ndarray) -> np.ndarray:
    """Return the usual fineness at some depths."""
    known = np.isfinite(sweep.usual_per_mm2)
    depths, first = np.unique(sweep.grid.centers_mm[known, 1], return_index=True)
    return np.interp(depth_mm, depths, sweep.usual_per_mm2[known][first])


def _rescaled(
    curve: DecorrelationCurve, sweep: _Sweep, length_mm: float, name: str
) -> DecorrelationCurve:
    """Return the curve with which the middle of the image moves this far."""
    for _ in range(SCALE_ROUNDS):
        estimated = _estimated_length(curve, sweep)
        if not estimated > 1e-6:
            raise ScanError(f"the frames of '{name}' do not decorrelate: did the probe move?")
        curve = scaled_curve(curve, length_mm / estimated)
    return curve


def _estimated_length(curve: DecorrelationCurve, sweep: _Sweep) -> float:
    fitted = [fit_pair(pair, curve, sweep.grid, sweep.usual_per_mm2) for pair in sweep.pairs]
    motion, _ = fuse_motion(fitted, sweep.frames - 1, sweep.grid, TURN_STD_RAD)
    x, y = sweep.grid.middle_mm
    elevational = motion[:, 2] + motion[:, 3] * y - motion[:, 4] * x
    return float(elevational.sum())


def _tracked_length(sweep: _Sweep, image_to_reference: torch.Tensor) -> float:
    """Return how far the middle of the image moved out of plane, summed over steps.

    Not the length of its path, which tracker noise makes longer.
    """
    return abs(float(_moved(image_to_reference, sweep.grid.middle_mm)[:, 2].sum()))


def _tracked_distances(
    sweep: _Sweep, image_to_reference: torch.Tensor
) -> Float[np.ndarray, "pairs patches"]:
    """Return how far each patch of each pair really was out of plane."""
    points = torch.zeros(len(sweep.grid.centers_mm), 3, dtype=torch.float64)
    points[:, :2] = torch.from_numpy(sweep.grid.centers_mm)
    first = torch.tensor([pair.first for pair in sweep.pairs])
    last = torch.tensor([pair.last for pair in sweep.pairs])
    last_to_first = invert_pose(image_to_reference[first]) @ image_to_reference[last]
    return transform_points(last_to_first, points)[..., 2].abs().numpy()


def _fitted(
    sweep: _Sweep, distance_mm: np.ndarray, name: str, dynamic_range_db: float
) -> tuple[DecorrelationCurve, float]:
    """Return the curve of least robust squares of correlation, and its residual."""
    depth_mm = sweep.grid.centers_mm[:, 1]
    edges = np.quantile(depth_mm, np.linspace(0, 1, DEPTHS + 1))
    depths = np.unique((edges[1:] + edges[:-1]) / 2)
    if not np.median(distance_mm) > 1e-3:
        raise ScanError(f"the tracked probe of '{name}' did not move out of plane")
    correlation = np.stack([pair.match.correlation for pair in sweep.pairs])
    fineness = np.stack([pair.match.fineness_per_mm2 for pair in sweep.pairs])
    known = np.isfinite(correlation)

    def curve_of(numbers: np.ndarray) -> DecorrelationCurve:
        exponent, peak, coherence = numbers[-3:]
        return DecorrelationCurve(
            depth_mm=tuple(depths.tolist()),
            width_mm=tuple(np.exp(numbers[:-3]).tolist()),
            exponent=float(exponent),
            peak=float(peak),
            fineness_per_mm2=tuple(_by_depth(sweep, depths).tolist()),
            coherence=float(coherence),
            dynamic_range_db=dynamic_range_db,
            source="tracked",
            preset=name,
        )

    def residual(numbers: np.ndarray) -> np.ndarray:
        curve = curve_of(numbers)
        width = patch_widths(curve, depth_mm, fineness, sweep.usual_per_mm2)
        return (correlation_at(curve, distance_mm, width) - correlation)[known]

    start = np.concatenate(
        (np.full(len(depths), np.log(np.median(distance_mm) * 2)), [1.5, 0.98, 0.5])
    )
    low = np.concatenate((np.full(len(depths), np.log(1e-2)), [0.5, 0.7, 0.0]))
    high = np.concatenate((np.full(len(depths), np.log(1e2)), [2.5, 1.0, 1.0]))
    fit = least_squares(
        residual, np.clip(start, low, high), bounds=(low, high), loss="soft_l1", f_scale=OUTLIER
    )
    return curve_of(fit.x), float(np.sqrt(np.mean(residual(fit.x) ** 2)))
