"""Give each frame the tracker pose of its time.

A frame stamped t shows what the tracker saw at ``t - latency_s``, as in
:class:`sonosweep.scan.Calibration`.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sonosweep.errors import ScanError
from sonosweep.geometry import interpolate_poses, is_rigid


@dataclass(frozen=True)
class MatchReport:
    """How well the tracker covered the frames.

    Attributes:
        frames: How many there are.
        without_pose: How many of them have no pose.
        first_without_pose: The first of these; ``None`` if all have one.
        last_without_pose: The last of these.
        samples: How many tracker samples were valid.
        invalid_samples: How many were not and were passed over.
        largest_gap_s: Longest time between two valid samples during the frames; ``None``
            with fewer than two samples there.
        uncovered_before_s: How much earlier the first frame is than the first sample, or 0.
        uncovered_after_s: How much later the last frame is than the last sample, or 0.
    """

    frames: int
    without_pose: int
    first_without_pose: int | None
    last_without_pose: int | None
    samples: int
    invalid_samples: int
    largest_gap_s: float | None
    uncovered_before_s: float
    uncovered_after_s: float

    def __str__(self) -> str:
        """Return one sentence for people."""
        gap = ""
        if self.largest_gap_s is not None:
            gap = f"; the longest gap between tracker samples is {self.largest_gap_s:.3g} s"
        if self.without_pose == 0:
            return f"all {self.frames} frames have a pose{gap}"
        where = f"between frames {self.first_without_pose} and {self.last_without_pose}"
        return f"{self.without_pose} of {self.frames} frames have no pose ({where}){gap}"


def match_poses(
    sample_times_s: Float[Tensor, " samples"],
    poses: Float[Tensor, "pose_samples 4 4"],
    frame_times_s: Float[Tensor, " frames"],
    latency_s: float = 0.0,
    max_gap_s: float = 0.1,
    valid: Bool[Tensor, " valid_samples"] | None = None,
) -> tuple[Float[Tensor, "frames 4 4"], Bool[Tensor, " frames"], MatchReport]:
    """Return the tracker's pose at the time of each frame, which frames have one, a report.

    A frame has a pose if it lies between two valid samples that are at most ``max_gap_s``
    apart; positions are interpolated along a line and turns along a great circle. The
    poses of other frames hold NaN. Nothing is extrapolated.

    Args:
        sample_times_s: Times of the tracker samples; of samples with one time the first
            counts.
        poses: Pose of each sample (any two coordinate systems); those that are not rigid
            are passed over.
        frame_times_s: Times of the frames, on the same clock.
        latency_s: How much later a frame is stamped than the tracker for the same moment.
        max_gap_s: Longest time between two samples to interpolate over.
        valid: Which samples the tracker calls good; all when ``None``.

    Raises:
        ScanError: If the counts differ, times are not numbers or go back, or no frame gets
            a pose.
    """
    times, kept = _valid_samples(sample_times_s, poses, valid)
    if not bool(torch.isfinite(frame_times_s).all()):
        raise ScanError("frame times that are not numbers cannot be matched")
    if not (max_gap_s > 0 and abs(latency_s) < float("inf")):
        raise ScanError(
            f"matching needs a gap above 0 s and a finite latency, got {max_gap_s:g} s and"
            f" {latency_s:g} s"
        )
    moments = frame_times_s.double() - latency_s
    after = torch.searchsorted(times, moments).clamp(max=len(times) - 1)
    before = torch.searchsorted(times, moments, right=True).sub(1).clamp(min=0)
    # A frame at the very time of a sample has that sample on both sides.
    inside = (times[before] <= moments) & (moments <= times[after])
    tracked = inside & (times[after] - times[before] <= max_gap_s)
    report = _report(tracked, times, moments, len(sample_times_s) - len(times))
    if not bool(tracked.any()):
        raise ScanError(
            f"no frame has a pose: the frames span {_span(moments)} and the tracker"
            f" {_span(times)}, with gaps of up to {max_gap_s:g} s allowed; check that both are"
            " on one clock, or allow a longer gap"
        )
    matched = interpolate_poses(times, kept, moments)
    return torch.where(tracked[:, None, None], matched, torch.nan), tracked, report


def _valid_samples(
    sample_times_s: Tensor, poses: Tensor, valid: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Return times and poses of the samples that can be used, in float64."""
    for what, values in (("poses", poses), ("validity flags", valid)):
        if values is not None and len(values) != len(sample_times_s):
            raise ScanError(f"{len(sample_times_s)} tracker times but {len(values)} {what}")
    good = is_rigid(poses) if valid is None else is_rigid(poses) & valid
    times, kept = sample_times_s[good].double(), poses[good].double()
    if len(times) == 0:
        raise ScanError(f"none of the {len(sample_times_s)} tracker samples is valid")
    if not bool(torch.isfinite(times).all()):
        raise ScanError("tracker times that are not numbers cannot be matched")
    back = times.diff() < 0
    if bool(back.any()):
        sample = int(back.nonzero()[0]) + 1
        raise ScanError(
            f"tracker times must not go back, but valid sample {sample} is"
            f" {float(times[sample - 1] - times[sample]):.3g} s earlier than the one before"
        )
    new = torch.ones(len(times), dtype=torch.bool)
    new[1:] = times.diff() > 0
    return times[new], kept[new]


def _report(tracked: Tensor, times: Tensor, moments: Tensor, invalid: int) -> MatchReport:
    if len(moments) == 0:
        raise ScanError("there is no frame to match")
    lost = (~tracked).nonzero()[:, 0]
    first = int(torch.searchsorted(times, moments.min(), right=True)) - 1
    last = int(torch.searchsorted(times, moments.max()))
    gaps = times[max(first, 0) : last + 1].diff()
    return MatchReport(
        frames=len(tracked),
        without_pose=len(lost),
        first_without_pose=int(lost[0]) if len(lost) else None,
        last_without_pose=int(lost[-1]) if len(lost) else None,
        samples=len(times),
        invalid_samples=invalid,
        largest_gap_s=float(gaps.max()) if len(gaps) else None,
        uncovered_before_s=max(float(times[0] - moments.min()), 0.0),
        uncovered_after_s=max(float(moments.max() - times[-1]), 0.0),
    )


def _span(times: Tensor) -> str:
    return f"{float(times.min()):.3f} to {float(times.max()):.3f} s"
