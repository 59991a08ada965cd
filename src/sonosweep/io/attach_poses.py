"""Poses from a file of their own, given to the frames they belong to."""

from dataclasses import replace
from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sonosweep.errors import ScanError
from sonosweep.geometry import EulerOrder
from sonosweep.io.pose_table import FIRST_LINE, read_pose_table
from sonosweep.io.trajectories import read_trajectory
from sonosweep.scan import Scan, Trajectory, match_poses

TABLES = (".csv", ".txt", ".tum")
PoseOf = Literal["image", "probe"]


def attach_poses(
    scan: Scan,
    pose_file: Path,
    latency_s: float | None = None,
    max_gap_s: float = 0.1,
    pose_of: PoseOf | None = None,
    euler_order: EulerOrder | None = None,
) -> Scan:
    """Return the scan with the poses of a file.

    A table with a column ``frame`` says itself where its poses belong. Otherwise, with
    times on both sides, poses are matched by time and interpolated; without, they are taken
    one by one.

    Args:
        scan: What was recorded.
        pose_file: csv, TUM, ``.igs.mha`` or ``.tfm``.
        latency_s: How much later frame times are than pose times for the same moment;
            what the scan's calibration says when ``None``, or 0 without one.
        max_gap_s: Longest time between two samples to interpolate over.
        pose_of: What the poses are of; ``None`` takes the file's word, and the image where
            the scan does not say where the image is on the probe.
        euler_order: Order of the intrinsic turns of a table that holds Euler angles.

    Raises:
        FormatError: If the file is not a list of poses.
        ScanError: If poses and frames do not fit together, or it is open whether the poses
            are the image's or the probe's.
    """
    samples, indices = _read(pose_file, euler_order)
    if latency_s is None:
        latency_s = 0.0 if scan.calibration is None else scan.calibration.latency_s
    poses, tracked, notes = _poses_of_frames(
        scan, samples, indices, pose_file.name, latency_s, max_gap_s
    )
    image_to_probe = None if scan.calibration is None else scan.calibration.image_to_probe
    owner = pose_of or _owner(samples, pose_file, image_to_probe is not None)
    if owner == "probe":
        if image_to_probe is None:
            raise ScanError(
                f"'{pose_file.name}' holds poses of the probe, and where the image is on it is"
                " not known: give --plus-config with its ImageToProbe"
            )
        poses = poses @ image_to_probe
    if tracked is not None and bool(tracked.all()):
        tracked = None
    return replace(scan, image_to_reference=poses, tracked=tracked, notes={**scan.notes, **notes})


def spread_poses(
    poses: Float[Tensor, "poses 4 4"], frames: Int[Tensor, " poses"], count: int
) -> tuple[Float[Tensor, "frames 4 4"], Bool[Tensor, " frames"]]:
    """Return one pose for each of ``count`` frames, NaN where there is none, and which."""
    every = torch.full((count, 4, 4), torch.nan, dtype=torch.float64)
    tracked = torch.zeros(count, dtype=torch.bool)
    every[frames], tracked[frames] = poses, True
    return every, tracked


def _owner(samples: Trajectory, pose_file: Path, calibrated: bool) -> PoseOf:
    """Return what a file's poses are of, by its own word or because there is no choice."""
    if samples.settings.get("pose_of") == "Probe":
        return "probe"
    if not calibrated or pose_file.suffix.lower() not in TABLES or _is_ours(pose_file):
        return "image"
    raise ScanError(
        f"'{pose_file.name}' does not say whether its poses are of the image or of the probe:"
        " say so with --pose-of"
    )


def _is_ours(pose_file: Path) -> bool:
    with pose_file.open(errors="replace") as stream:
        return stream.readline(len(FIRST_LINE) + 2).strip() == FIRST_LINE


def _poses_of_frames(
    scan: Scan,
    samples: Trajectory,
    indices: Tensor | None,
    file_name: str,
    latency_s: float,
    max_gap_s: float,
) -> tuple[Tensor, Tensor | None, dict[str, str]]:
    frames, poses = len(scan.frames), samples.image_to_reference
    if indices is not None:
        if int(indices.max()) >= frames:
            raise ScanError(
                f"{frames} frames in '{scan.name}' but a pose of frame {int(indices.max())} in"
                f" '{file_name}'"
            )
        return *spread_poses(poses, indices, frames), {}
    if scan.timestamps_s is not None and samples.timestamps_s is not None:
        matched, tracked, report = match_poses(
            samples.timestamps_s, poses, scan.timestamps_s, latency_s, max_gap_s
        )
        return matched, tracked, {"matching": f"matched by time: {report}"}
    if frames != len(poses):
        raise ScanError(
            f"{frames} frames in '{scan.name}' but {len(poses)} poses in '{file_name}', and"
            " without times on both sides they cannot be matched: give --frame-rate-hz, or a"
            " pose file with a column for time or frame"
        )
    return poses, None, {}


def _read(pose_file: Path, euler_order: EulerOrder | None) -> tuple[Trajectory, Tensor | None]:
    if pose_file.suffix.lower() in TABLES and pose_file.is_file():
        table = read_pose_table(pose_file, euler_order)
        return table.trajectory, table.frame_indices
    return read_trajectory(pose_file), None
