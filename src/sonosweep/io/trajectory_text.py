"""Trajectories as text that people and other programs read: csv and TUM.

The csv holds ``frame`` (its number in the scan, from 0; frames without a pose are left out),
``time_s, tx_mm, ty_mm, tz_mm, r00 ... r22`` (rotation row by row) and, if known, six
standard deviations ``std_lateral_mm ... std_roll_rad`` of the step that led to the frame
(none in the first row). Method, assumptions and settings are ``#`` lines above the header.
Every number has the digits that give back the same float64;
:func:`sonosweep.io.pose_table.read_pose_table` reads both.
"""

import json
import os

import torch

from sonosweep.geometry import quaternion_from_rotation
from sonosweep.io.atomic import write_beside
from sonosweep.io.pose_table import FIRST_LINE, ROTATION, STD, TRANSLATION
from sonosweep.scan import Trajectory


def write_trajectory_csv(trajectory: Trajectory, path: str | os.PathLike) -> None:
    """Write a trajectory as the csv described above; reading gives it back bit by bit.

    Raises:
        FormatError: If the file cannot be written.
    """
    count = len(trajectory.image_to_reference)
    header = ["frame", *(["time_s"] if trajectory.timestamps_s is not None else [])]
    header += [f"{axis}_mm" for axis in TRANSLATION] + list(ROTATION)
    header += STD if trajectory.step_std is not None else []
    with write_beside(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        print(FIRST_LINE, file=file)
        print(f"# method: {json.dumps(trajectory.method)}", file=file)
        for assumption in trajectory.assumptions:
            print(f"# assumption: {json.dumps(assumption)}", file=file)
        if trajectory.settings:
            settings = json.dumps(dict(trajectory.settings))
            print(f"# settings: {settings}", file=file)
        print(",".join(header), file=file)
        for row in range(count):
            print(",".join(_csv_cells(trajectory, row)), file=file)


def write_tum(trajectory: Trajectory, path: str | os.PathLike) -> None:
    """Write ``time tx ty tz qx qy qz qw`` lines in seconds and mm.

    Other software mostly expects metres in such files: it only scales the picture. Without
    times, the number of the frame stands in their place, and a comment says so.

    Raises:
        FormatError: If the file cannot be written.
    """
    poses, times = trajectory.image_to_reference, trajectory.timestamps_s
    quaternions = quaternion_from_rotation(poses[:, :3, :3])
    first = times if times is not None else torch.arange(len(poses), dtype=torch.float64)
    rows = torch.cat((first[:, None], poses[:, :3, 3], quaternions), dim=1)
    unit = "s" if times is not None else "(frame number)"
    with write_beside(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        print(f"# time {unit}, tx ty tz mm, qx qy qz qw", file=file)
        for row in rows.tolist():
            print(" ".join(repr(value) for value in row), file=file)


def _csv_cells(trajectory: Trajectory, row: int) -> list[str]:
    pose = trajectory.image_to_reference[row]
    numbers = [*pose[:3, 3].tolist(), *pose[:3, :3].flatten().tolist()]
    if trajectory.timestamps_s is not None:
        numbers.insert(0, float(trajectory.timestamps_s[row]))
    frame = row if trajectory.frames is None else int(trajectory.frames[row])
    cells = [str(frame), *(repr(value) for value in numbers)]
    if trajectory.step_std is None:
        return cells
    if row == 0:
        return cells + [""] * len(STD)
    return cells + [repr(value) for value in trajectory.step_std[row - 1].tolist()]
