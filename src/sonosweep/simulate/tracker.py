"""What a tracker on the probe reports of a movement, instead of the truth.

The sensor sits on the probe's handle, so that an error of its direction shifts the image.
The tracker has its own sampling times and its own clock; its poses are matched to the frames
as those of a real recording are.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from sonosweep.errors import ScanError
from sonosweep.scan.clock import match_poses

MARGIN_S = 0.5  # recorded before the first frame and after the last
HIGHEST_RATE_HZ = 10_000.0
MOST_DROPOUTS = 600  # per minute

PosesAt = Callable[[Float[np.ndarray, " times"]], Float[np.ndarray, "times 4 4"]]


@dataclass(frozen=True)
class TrackerSettings:
    """How well a tracker sees.

    Attributes:
        sampling_hz: Poses per second.
        latency_s: How much later frames are stamped than the tracker's poses for the same
            moment, as in :class:`sonosweep.scan.Calibration`.
        position_noise_mm: Standard deviation of each coordinate of the sensor, anew for
            each sample.
        rotation_noise_deg: The same about each axis.
        dropouts_per_minute: How often it loses the sensor, on average.
        dropout_s: For how long, on average.
        sensor_above_face_mm: How far behind the array's face the sensor is mounted.
        largest_gap_s: Longest time between two poses over which frames are interpolated.
    """

    sampling_hz: float = 60.0
    latency_s: float = 0.0
    position_noise_mm: float = 0.15
    rotation_noise_deg: float = 0.1
    dropouts_per_minute: float = 0.0
    dropout_s: float = 0.3
    sensor_above_face_mm: float = 60.0
    largest_gap_s: float = 0.1

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ScanError: If one has no meaning.
        """
        if not 0 < self.sampling_hz <= HIGHEST_RATE_HZ:
            raise ScanError(
                f"sampling_hz of a tracker must be above 0 and at most {HIGHEST_RATE_HZ:g}, got"
                f" {self.sampling_hz:g}"
            )
        if not abs(self.latency_s) <= MARGIN_S:
            raise ScanError(
                f"latency_s of a tracker must be within {MARGIN_S:g} s, got {self.latency_s:g}"
            )
        if self.dropouts_per_minute > MOST_DROPOUTS:
            raise ScanError(
                f"a tracker has at most {MOST_DROPOUTS} drop-outs per minute, got"
                f" {self.dropouts_per_minute:g}"
            )
        for name in (
            "position_noise_mm",
            "rotation_noise_deg",
            "dropouts_per_minute",
            "dropout_s",
            "sensor_above_face_mm",
        ):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise ScanError(f"{name} of a tracker must be 0 or more, got {value:g}")


ELECTROMAGNETIC = TrackerSettings(latency_s=0.03)
"""Such as the paper's Polhemus at 60 Hz."""

OPTICAL = TrackerSettings(
    latency_s=0.05,
    position_noise_mm=0.1,
    rotation_noise_deg=0.15,
    dropouts_per_minute=4.0,
    sensor_above_face_mm=90.0,
)
"""Such as a small stereo camera, which loses its markers when a hand covers them."""

TRACKERS = {"electromagnetic": ELECTROMAGNETIC, "optical": OPTICAL}


@dataclass(frozen=True, eq=False)
class TrackerStream:
    """What the tracker wrote down, on its own clock.

    Attributes:
        times_s: When each pose was taken, tracker's clock: it shows ``latency_s`` less than
            the frames' clock.
        plane_to_body: The poses; the last seen one where it lost the sensor.
        valid: Where it saw the sensor.
    """

    times_s: Float[np.ndarray, " samples"]
    plane_to_body: Float[np.ndarray, "samples 4 4"]
    valid: Bool[np.ndarray, " samples"]


def record_poses(
    poses_at: PosesAt,
    duration_s: float,
    settings: TrackerSettings,
    generator: np.random.Generator,
) -> TrackerStream:
    """Return what a tracker sees of a movement, from a little before it to a little after.

    Args:
        poses_at: ``plane_to_body`` at any times on the frames' clock, such as
            :meth:`sonosweep.simulate.motion.ProbeMotion.poses_at`.
        duration_s: Time of the last frame; the first is at 0.
        settings: Of the tracker.
        generator: Draws sampling phase, noise and drop-outs.
    """
    period = 1 / settings.sampling_hz
    margin = MARGIN_S + abs(settings.latency_s)
    count = int(np.ceil((duration_s + 2 * margin) / period)) + 1
    times = period * (generator.uniform() + np.arange(count)) - margin - period
    plane_to_sensor = np.eye(4)
    plane_to_sensor[1, 3] = settings.sensor_above_face_mm
    sensor = poses_at(times) @ np.linalg.inv(plane_to_sensor)
    turns = np.deg2rad(settings.rotation_noise_deg) * generator.standard_normal((count, 3))
    sensor[:, :3, :3] = sensor[:, :3, :3] @ Rotation.from_rotvec(turns).as_matrix()
    sensor[:, :3, 3] += settings.position_noise_mm * generator.standard_normal((count, 3))
    valid = _draw_valid(times, settings, generator)
    held = np.maximum.accumulate(np.where(valid, np.arange(count), 0))
    return TrackerStream(times - settings.latency_s, sensor[held] @ plane_to_sensor, valid)


def track_frames(
    poses_at: PosesAt,
    frame_times_s: Float[np.ndarray, " frames"],
    settings: TrackerSettings,
    generator: np.random.Generator,
) -> tuple[Float[np.ndarray, "frames 4 4"], Bool[np.ndarray, " frames"]]:
    """Return the tracker's pose of each frame, and which frames have one.

    Poses of other frames hold NaN. The latency is known and taken into account.

    Raises:
        ScanError: If the tracker saw the sensor at no frame.
    """
    stream = record_poses(poses_at, float(frame_times_s[-1]), settings, generator)
    poses, tracked, _ = match_poses(
        torch.from_numpy(stream.times_s),
        torch.from_numpy(stream.plane_to_body),
        torch.from_numpy(frame_times_s),
        latency_s=settings.latency_s,
        max_gap_s=settings.largest_gap_s,
        valid=torch.from_numpy(stream.valid),
    )
    return poses.numpy(), tracked.numpy()


def _draw_valid(
    times_s: np.ndarray, settings: TrackerSettings, generator: np.random.Generator
) -> np.ndarray:
    """Return where no drop-out is; they begin at random and last exponentially long."""
    span = float(times_s[-1] - times_s[0])
    drops = generator.poisson(settings.dropouts_per_minute * span / 60)
    starts = times_s[0] + span * generator.uniform(size=drops)
    lengths = settings.dropout_s * generator.exponential(size=drops)
    valid = np.ones(len(times_s), dtype=bool)
    for start, length in zip(starts, lengths, strict=True):
        valid &= (times_s < start) | (times_s > start + length)
    return valid
