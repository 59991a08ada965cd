"""How much later the frames are stamped than the tracker, from one movement both saw.

Move the probe up and down over a flat echo, such as the bottom of a water tank, for some
ten seconds. The depth of the echo and the position of the probe are then the same signal,
one of them late. The lag found is :class:`sonosweep.scan.Calibration`'s ``latency_s``: a
frame stamped t shows what the tracker saw at ``t - lag_s``.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from scipy.optimize import minimize_scalar
from torch import Tensor

from sonosweep.errors import ScanError
from sonosweep.geometry import is_rigid
from sonosweep.scan.frames import Frames
from sonosweep.scan.motion_signal import image_motion_signal, tracker_motion_signal

# Signals with fewer samples in common say nothing about a lag.
FEWEST_SAMPLES = 20
# Parts of the recording left out in turn to see how much the lag depends on each.
JACKKNIFE_PARTS = 8


@dataclass(frozen=True)
class LagEstimate:
    """How much later one signal is than another, and how sure that is.

    Attributes:
        lag_s: The first signal at t equals the second at ``t - lag_s``.
        uncertainty_s: Standard deviation of the lag (jackknife over parts of the time).
        correlation: Of the two signals at this lag. Below 0: one rises as the other falls.
        half_lags_s: Lag of the first and of the second half of the recording alone.
        runner_up_lag_s: Lag of the second best peak, either sign; ``None`` if there is one
            peak only.
        runner_up_correlation: Correlation there. Nearly as large as the best: the movement
            repeats itself, and either lag may be true.
        samples: How many samples were compared.
    """

    lag_s: float
    uncertainty_s: float
    correlation: float
    half_lags_s: tuple[float, float]
    runner_up_lag_s: float | None
    runner_up_correlation: float | None
    samples: int


def estimate_latency(
    frames: Frames,
    frame_times_s: Float[Tensor, " frames"],
    probe_to_reference: Float[Tensor, "samples 4 4"],
    sample_times_s: Float[Tensor, " samples"],
    max_lag_s: float = 2.0,
) -> LagEstimate:
    """Return the latency of the frames against the tracker.

    Args:
        frames: Of a flat echo, with the probe moving along its beam.
        frame_times_s: When each was stamped.
        probe_to_reference: Tracked poses, or ``image_to_reference``: any point fixed to the
            probe will do. Those that are not rigid are passed over.
        sample_times_s: When each was stamped, on the same clock.
        max_lag_s: Longest lag looked for, either way.

    Raises:
        ScanError: If the frames show no line, the probe hardly moves, or the two overlap
            too little.
    """
    start, stop = float(frame_times_s[0]) - max_lag_s, float(frame_times_s[-1]) + max_lag_s
    usable = is_rigid(probe_to_reference) & (sample_times_s >= start) & (sample_times_s <= stop)
    if int(usable.sum()) < FEWEST_SAMPLES:
        raise ScanError(
            f"{int(usable.sum())} tracker samples between {start:.3f} and {stop:.3f} s, where the"
            f" frames are; a lag needs {FEWEST_SAMPLES}: are both on one clock?"
        )
    depth = image_motion_signal(frames)
    seen = torch.isfinite(depth)
    if int(seen.sum()) < max(FEWEST_SAMPLES, len(depth) // 2):
        raise ScanError(
            f"only {int(seen.sum())} of {len(depth)} frames show a bright line: record a flat"
            " echo, such as the bottom of a water tank, while moving the probe up and down"
        )
    return estimate_lag(
        depth[seen],
        frame_times_s[seen],
        tracker_motion_signal(probe_to_reference[usable]),
        sample_times_s[usable],
        max_lag_s,
    )


def estimate_lag(
    signal_a: Float[Tensor, " samples_a"],
    times_a_s: Float[Tensor, " samples_a"],
    signal_b: Float[Tensor, " samples_b"],
    times_b_s: Float[Tensor, " samples_b"],
    max_lag_s: float = 2.0,
    sign: Literal[-1, 1] | None = None,
) -> LagEstimate:
    """Return the lag at which signal a correlates best with signal b.

    The signal with more samples per second is interpolated at the times of the other, so
    that the coarser one is used as it was measured, however unevenly. Half of it must
    overlap with the other at a lag for that lag to count.

    Args:
        signal_a: The one that may be late, such as the depth of an echo.
        times_a_s: When it was sampled, increasing.
        signal_b: The other, such as the position of a probe.
        times_b_s: When it was sampled, increasing, on the same clock.
        max_lag_s: Longest lag looked for, either way.
        sign: Whether a rises (1) or falls (-1) with b; ``None``: not known, and the
            larger correlation decides.

    Raises:
        ScanError: If times do not increase, a signal is constant, or they do not overlap.

    References:
        Lasso et al., "PLUS: open-source toolkit for ultrasound-guided intervention
        systems", 2014, section "Temporal calibration", for the movement and the signals.
    """
    a, b = _Signal.of(signal_a, times_a_s, "first"), _Signal.of(signal_b, times_b_s, "second")
    a_is_coarse = a.interval_s >= b.interval_s
    coarse, fine = (a, b) if a_is_coarse else (b, a)
    direction = 1.0 if a_is_coarse else -1.0
    step = fine.interval_s / 2
    lags = np.arange(-np.ceil(max_lag_s / step), np.ceil(max_lag_s / step) + 1) * step
    score = _Correlation(fine, direction, sign)
    curve = score.curve(coarse, lags)
    if not (curve > -1).any():
        raise ScanError(
            f"the signals overlap too little within {max_lag_s:g} s of lag: the first spans"
            f" {a.times[0]:.3f} to {a.times[-1]:.3f} s, the second {b.times[0]:.3f} to"
            f" {b.times[-1]:.3f} s"
        )
    best = score.peak(coarse, lags)
    runner_up = _runner_up(lags, curve)
    parts = np.array_split(np.arange(len(coarse.times)), JACKKNIFE_PARTS)
    without = np.array([score.peak(coarse.without(part), lags) for part in parts])
    spread = (JACKKNIFE_PARTS - 1) / JACKKNIFE_PARTS * ((without - without.mean()) ** 2).sum()
    first, second = np.array_split(np.arange(len(coarse.times)), 2)
    return LagEstimate(
        lag_s=best,
        uncertainty_s=float(np.sqrt(spread)),
        correlation=float(score.signed(coarse, np.array([best]))[0]),
        half_lags_s=(
            score.peak(coarse.without(second), lags),
            score.peak(coarse.without(first), lags),
        ),
        runner_up_lag_s=runner_up,
        runner_up_correlation=(
            None if runner_up is None else float(score.signed(coarse, np.array([runner_up]))[0])
        ),
        samples=score.overlap(coarse, best),
    )


@dataclass(frozen=True, eq=False)
class _Signal:
    values: np.ndarray
    times: np.ndarray
    interval_s: float

    @classmethod
    def of(cls, values: Tensor, times_s: Tensor, name: str) -> "_Signal":
        value, time = values.double().numpy(), times_s.double().numpy()
        if not (np.isfinite(value).all() and np.isfinite(time).all()):
            raise ScanError(f"the {name} signal or its times hold values that are not numbers")
        if len(time) < FEWEST_SAMPLES:
            raise ScanError(
                f"the {name} signal has {len(time)} samples; a lag needs {FEWEST_SAMPLES}"
            )
        if not (np.diff(time) > 0).all():
            raise ScanError(f"the times of the {name} signal must increase")
        if np.ptp(value) == 0:
            raise ScanError(f"the {name} signal does not change: there is nothing to match")
        return cls(value, time, float(np.median(np.diff(time))))

    def without(self, samples: np.ndarray) -> "_Signal":
        kept = np.delete(np.arange(len(self.times)), samples)
        return _Signal(self.values[kept], self.times[kept], self.interval_s)


@dataclass(frozen=True, eq=False)
class _Correlation:
    """Correlation of a coarse signal with a fine one, as a function of the lag."""

    fine: _Signal
    direction: float  # 1 if the coarse signal is the one that may be late
    sign: int | None

    def overlap(self, coarse: _Signal, lag_s: float) -> int:
        return int(self._inside(coarse.times - self.direction * lag_s).sum())

    def _inside(self, moments: np.ndarray) -> np.ndarray:
        return (moments >= self.fine.times[0]) & (moments <= self.fine.times[-1])

    def signed(self, coarse: _Signal, lags_s: np.ndarray) -> np.ndarray:
        """Return the correlation at each lag, NaN where too little overlaps."""
        moments = coarse.times - self.direction * lags_s[:, None]
        inside = self._inside(moments)
        count = inside.sum(axis=1)
        enough = count >= max(FEWEST_SAMPLES // 2, len(coarse.times) // 2)
        share = inside / np.maximum(count, 1)[:, None]
        other = np.interp(moments, self.fine.times, self.fine.values)
        one = coarse.values - share @ coarse.values[:, None]
        other = other - (share * other).sum(axis=1, keepdims=True)
        covariance = (share * one * other).sum(axis=1)
        product = (share * one**2).sum(axis=1) * (share * other**2).sum(axis=1)
        usable = enough & (product > 0)
        return np.where(usable, covariance / np.sqrt(np.where(usable, product, 1)), np.nan)

    def curve(self, coarse: _Signal, lags_s: np.ndarray) -> np.ndarray:
        """Return what is to be largest, -1 where it is not defined."""
        value = self.signed(coarse, lags_s)
        return np.nan_to_num(np.abs(value) if self.sign is None else self.sign * value, nan=-1.0)

    def peak(self, coarse: _Signal, lags_s: np.ndarray) -> float:
        """Return the lag of the highest peak, between the lags given."""
        best = int(self.curve(coarse, lags_s).argmax())
        lower, upper = lags_s[max(best - 2, 0)], lags_s[min(best + 2, len(lags_s) - 1)]
        found = minimize_scalar(
            lambda lag_s: -self.curve(coarse, np.array([lag_s]))[0],
            bounds=(lower, upper),
            method="bounded",
        )
        return float(found.x)


def _runner_up(lags: np.ndarray, curve: np.ndarray) -> float | None:
    """Return the lag of the second highest peak."""
    is_peak = (curve[1:-1] >= curve[:-2]) & (curve[1:-1] > curve[2:]) & (curve[1:-1] > -1)
    peaks = np.flatnonzero(is_peak) + 1
    peaks = peaks[peaks != curve.argmax()]
    return float(lags[peaks[curve[peaks].argmax()]]) if len(peaks) else None
