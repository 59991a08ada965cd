"""Poses from a file of their own, given to the frames they belong to."""

from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sonosweep.errors import ScanError
from sonosweep.io.pose_table import read_pose_table
from sonosweep.io.trajectories import read_trajectory
from sonosweep.scan import Scan, Trajectory, match_poses

TABLES = (".csv", ".txt", ".tum")


def attach_poses(
    scan: Scan, pose_file: Path, latency_s: float = 0.0, max_gap_s: float = 0.1
) -> Scan:
    """Return the scan with the poses of a file.

    A table with a column ``frame`` says itself where its poses belong. Otherwise, with
    times on both sides, poses are matched by time and interpolated; without, they are taken
    one by one. If the calibration says where the image is on the probe, the file's poses
    are the probe's, else the image's.

    Args:
        scan: What was recorded.
        pose_file: csv, TUM, ``.igs.mha`` or ``.tfm``.
        latency_s: How much later frame times are than pose times for the same moment.
        max_gap_s: Longest time between two samples to interpolate over.

    Raises:
        FormatError: If the file is not a list of poses.
        ScanError: If poses and frames do not fit together.
    """
    poses, tracked, notes = _poses_of_frames(scan, pose_file, latency_s, max_gap_s)
    if scan.calibration is not None and scan.calibration.image_to_probe is not None:
        poses = poses @ scan.calibration.image_to_probe
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


def _poses_of_frames(
    scan: Scan, pose_file: Path, latency_s: float, max_gap_s: float
) -> tuple[Tensor, Tensor | None, dict[str, str]]:
    samples, indices = _read(pose_file)
    frames, poses = len(scan.frames), samples.image_to_reference
    if indices is not None:
        if int(indices.max()) >= frames:
            raise ScanError(
                f"{frames} frames in '{scan.name}' but a pose of frame {int(indices.max())} in"
                f" '{pose_file.name}'"
            )
        return *spread_poses(poses, indices, frames), {}
    if scan.timestamps_s is not None and samples.timestamps_s is not None:
        matched, tracked, report = match_poses(
            samples.timestamps_s, poses, scan.timestamps_s, latency_s, max_gap_s
        )
        note = f"matched by time; {report.without_pose} of {frames} frames have no pose"
        return matched, tracked, {"matching": note}
    if frames != len(poses):
        raise ScanError(
            f"{frames} frames in '{scan.name}' but {len(poses)} poses in '{pose_file.name}', and"
            " without times on both sides they cannot be matched: give --frame-rate-hz, or a"
            " pose file with a column for time or frame"
        )
    return poses, None, {}


def _read(pose_file: Path) -> tuple[Trajectory, Tensor | None]:
    if pose_file.suffix.lower() in TABLES and pose_file.is_file():
        table = read_pose_table(pose_file)
        return table.trajectory, table.frame_indices
    return read_trajectory(pose_file), None
