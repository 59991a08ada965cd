"""What the numbers of a sensorless trajectory mean, in plain words."""

from sonosweep.metrics import TrajectoryMetrics

# Final drift per length of the path, per cent, and what it means for a user.
GRADES = (
    (5.0, "good: distances in the volume are right to a few per cent"),
    (15.0, "usable to look at: shapes are right, measured lengths may be off by a tenth"),
    (40.0, "poor: what lies next to what is right, lengths and curvature are not"),
    (float("inf"), "not usable as geometry: treat the volume as a stack of frames"),
)


def verdict(metrics: TrajectoryMetrics) -> tuple[str, ...]:
    """Return sentences that say how far a trajectory is from the tracker's.

    The grade is the final drift per length of the path (the paper's FDR); the limits are
    ours, and a matter of taste.
    """
    drift, path = metrics.final_drift_mm, metrics.path_length_mm
    rate = metrics.final_drift_rate_path_percent
    sentences = [
        f"After {path:.1f} mm of tracked path the sensorless trajectory is {drift:.1f} mm off"
        + ("." if rate is None else f" ({rate:.0f} % of the path)."),
        f"It is {metrics.accumulated_frame_error_mm:.1f} mm off on average over the sweep, and"
        f" its own path is {metrics.estimated_path_length_mm:.1f} mm long.",
    ]
    if rate is not None:
        word = next(word for limit, word in GRADES if rate <= limit)
        sentences.insert(0, f"The sensorless result is {word}.")
    return tuple(sentences)
