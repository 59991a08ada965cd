"""Tables of poses: comma-separated values, TUM text, and bare numbers.

A csv has a header. Columns we read, in any order, others are ignored:

- ``frame`` (from 0), and ``time_s`` or ``timestamp`` (seconds);
- ``tx ty tz`` (or ``tx_mm`` ...) with one of
  ``qx qy qz qw`` (unit quaternion), ``r00 r01 ... r22`` (rotation, row by row), or
  ``rx_deg ry_deg rz_deg`` / ``rx_rad ry_rad rz_rad`` (intrinsic Euler angles about x, y, z,
  whose order must be given);
- or ``m00 m01 ... m33``, the whole 4 x 4 matrix, row by row.

Without a header, rows of 8 numbers are TUM (``time tx ty tz qx qy qz qw``), 7 the same
without time, 12 and 16 matrices row by row, 17 time and matrix. Lines that start with ``#``
are comments. Lengths are mm; give ``scale=1000`` for a table in metres.

What :func:`sonosweep.io.trajectory_text.write_trajectory_csv` writes comes back bit by bit.
"""

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from sonosweep.errors import FormatError, ScanError
from sonosweep.geometry import (
    MOTION_NAMES,
    EulerOrder,
    is_rigid,
    pose_from_parts,
    rotation_from_euler,
    rotation_from_quaternion,
)
from sonosweep.io.number_table import is_number, parse_numbers, read_text, split_cells
from sonosweep.io.rounded_poses import unround_poses
from sonosweep.scan import Trajectory

FIRST_LINE = "# sonosweep trajectory 1"
TRANSLATION = ("tx", "ty", "tz")
QUATERNION = ("qx", "qy", "qz", "qw")
ROTATION = tuple(f"r{i}{j}" for i in range(3) for j in range(3))
MATRIX = tuple(f"m{i}{j}" for i in range(4) for j in range(4))
STD = tuple(f"std_{n}_{'mm' if i < 3 else 'rad'}" for i, n in enumerate(MOTION_NAMES))
HEADERLESS = {
    7: (*TRANSLATION, *QUATERNION),
    8: ("time_s", *TRANSLATION, *QUATERNION),
    12: MATRIX[:12],
    16: MATRIX,
    17: ("time_s", *MATRIX),
}
TIME_NAMES = {"timestamp": "time_s", "time": "time_s", "timestamp_s": "time_s", "t": "time_s"}
QUATERNION_LENGTH_ERROR = 0.01  # two printed digits; more means another order of columns


@dataclass(frozen=True, eq=False)
class PoseTable:
    """The poses of a table, and which frames they belong to.

    Attributes:
        trajectory: Poses and, if the table has them, times and step deviations.
        frame_indices: The frame of each pose, from 0; ``None`` if the table tells none.
    """

    trajectory: Trajectory
    frame_indices: Int[Tensor, " poses"] | None = None


def read_pose_table(
    path: str | os.PathLike, euler_order: EulerOrder | None = None, scale: float = 1.0
) -> PoseTable:
    """Return the poses of a csv, TUM or bare table.

    Args:
        path: The table; the layouts are listed above.
        euler_order: Order of the intrinsic turns, needed for Euler angles only.
        scale: What to multiply translations with to get mm.

    Raises:
        FormatError: If it is no such table, or a pose in it is not rigid or not a number.
    """
    name = Path(path).name
    comments, header, rows = _split_table(read_text(path), name)
    columns = {column: rows[:, i] for i, column in enumerate(header)}
    ours = bool(comments) and comments[0].strip() == FIRST_LINE
    poses = _poses_from_columns(columns, euler_order, name)
    frames = _frame_indices(columns, name)
    everyone = frames is None or torch.equal(frames, torch.arange(len(frames)))
    if not ours:
        poses = unround_poses(poses)
    # With exactly 1 nothing may change, not even the sign of a zero.
    if scale != 1.0:
        poses[:, :3, 3] *= scale
    try:
        trajectory = Trajectory(
            image_to_reference=poses,
            timestamps_s=_times(columns, name),
            step_std=_step_std(columns),
            frames=None if everyone else frames,
            **_read_comments(comments, name),  # type: ignore[arg-type]
        )
    except ScanError as error:
        raise FormatError(f"{error}, in '{name}'{_hint(poses)}") from error
    return PoseTable(trajectory, frames)


def _split_table(text: str, name: str) -> tuple[list[str], list[str], np.ndarray]:
    """Return comment lines, the names of the columns, and the numbers (rows, columns)."""
    comments: list[str] = []
    header: list[str] | None = None
    rows: list[list[float]] = []
    for i, line in enumerate(text.splitlines(), start=1):
        if line.lstrip().startswith("#"):
            comments.append(line.lstrip())
        elif line.strip():
            cells = split_cells(line.strip())
            if header is None:
                header = _header(cells, name)
                if not is_number(cells[0]):
                    continue
            rows.append(_row(cells, len(header), i, name))
    if header is None or not rows:
        raise FormatError(f"'{name}' holds no poses")
    return comments, header, np.array(rows, dtype=np.float64)


def _header(cells: list[str], name: str) -> list[str]:
    if not is_number(cells[0]):
        columns = [_column(cell) for cell in cells]
        twice = [column for column in columns if columns.count(column) > 1 and column]
        if twice:
            raise FormatError(f"column '{twice[0][:40]}' occurs twice in '{name}'")
        return columns
    if len(cells) not in HEADERLESS:
        raise FormatError(
            f"rows of {len(cells)} numbers in '{name}' are no poses we know: without a header"
            f" there must be {', '.join(map(str, HEADERLESS))}"
        )
    return list(HEADERLESS[len(cells)])


def _column(cell: str) -> str:
    """Return our name for a column."""
    plain = cell.strip().strip('"').lower()
    plain = TIME_NAMES.get(plain, plain)
    return plain.removesuffix("_mm") if plain.startswith("t") else plain


def _row(cells: list[str], width: int, line: int, name: str) -> list[float]:
    where = f"line {line} of '{name}'"
    if len(cells) != width:
        raise FormatError(f"{len(cells)} values instead of {width} in {where}")
    return parse_numbers([cell or "nan" for cell in cells], where)


def _poses_from_columns(
    columns: dict[str, np.ndarray], euler_order: EulerOrder | None, name: str
) -> Float[Tensor, "frames 4 4"]:
    if all(column in columns for column in MATRIX[:12]):
        return _poses_from_matrix(columns)
    if not all(column in columns for column in TRANSLATION):
        known = ", ".join(columns)[:200]
        raise FormatError(f"'{name}' needs the columns tx, ty, tz (or m00 to m33); it has {known}")
    return pose_from_parts(
        _rotations_from_columns(columns, euler_order, name), _stack(columns, TRANSLATION)
    )


def _poses_from_matrix(columns: dict[str, np.ndarray]) -> Float[Tensor, "frames 4 4"]:
    matrix = torch.zeros(len(columns["m00"]), 4, 4, dtype=torch.float64)
    matrix[:, 3, 3] = 1
    for i in range(4):
        for j in range(4):
            if f"m{i}{j}" in columns:
                matrix[:, i, j] = torch.from_numpy(columns[f"m{i}{j}"].copy())
    return matrix


def _rotations_from_columns(
    columns: dict[str, np.ndarray], euler_order: EulerOrder | None, name: str
) -> Float[Tensor, "frames 3 3"]:
    if all(column in columns for column in ROTATION):
        return _stack(columns, ROTATION).unflatten(-1, (3, 3))
    if all(column in columns for column in QUATERNION):
        return _rotations_from_quaternions(_stack(columns, QUATERNION), name)
    for unit, factor in (("rad", 1.0), ("deg", np.pi / 180)):
        angles = tuple(f"r{axis}_{unit}" for axis in "xyz")
        if all(column in columns for column in angles):
            if euler_order is None:
                raise FormatError(
                    f"'{name}' holds Euler angles: say in which order the turns follow, one of"
                    f" {', '.join(get_args(EulerOrder))}"
                )
            return rotation_from_euler(_stack(columns, angles) * factor, euler_order)
    raise FormatError(
        f"'{name}' needs a rotation: qx, qy, qz, qw, or r00 to r22, or rx_deg, ry_deg, rz_deg;"
        f" it has {', '.join(columns)[:200]}"
    )


def _rotations_from_quaternions(
    quaternions: Float[Tensor, "frames xyzw=4"], name: str
) -> Float[Tensor, "frames 3 3"]:
    lengths = torch.linalg.vector_norm(quaternions, dim=-1)
    wrong = ~((lengths - 1).abs() <= QUATERNION_LENGTH_ERROR)
    if bool(wrong.any()):
        row = int(wrong.nonzero()[0])
        raise FormatError(
            f"the quaternion of pose {row} in '{name}' has length {float(lengths[row]):.4g}"
            " instead of 1: are the columns qx, qy, qz, qw?"
        )
    return rotation_from_quaternion(quaternions)


def _stack(columns: dict[str, np.ndarray], names: tuple[str, ...]) -> Float[Tensor, "frames n"]:
    return torch.from_numpy(np.stack([columns[name] for name in names], axis=-1))


def _times(columns: dict[str, np.ndarray], name: str) -> Float[Tensor, " frames"] | None:
    if "time_s" not in columns:
        return None
    times = torch.from_numpy(columns["time_s"].copy())
    if not bool(torch.isfinite(times).all()):
        raise FormatError(f"a time in '{name}' is missing or not a number")
    return times


def _step_std(columns: dict[str, np.ndarray]) -> Float[Tensor, "steps motion=6"] | None:
    if not all(column in columns for column in STD):
        return None
    return _stack(columns, STD)[1:]


def _frame_indices(columns: dict[str, np.ndarray], name: str) -> Int[Tensor, " frames"] | None:
    if "frame" not in columns:
        return None
    values = columns["frame"]
    whole = np.isfinite(values) & (values >= 0) & (values < 2**53) & (values == np.floor(values))
    if not whole.all() or len(np.unique(values)) != len(values):
        raise FormatError(f"the frame column of '{name}' must hold different whole numbers from 0")
    return torch.from_numpy(values.astype(np.int64))


def _read_comments(comments: list[str], name: str) -> dict[str, object]:
    """Return what our own comment lines say of a trajectory; others are ignored."""
    if not comments or comments[0].strip() != FIRST_LINE:
        return {"method": "unknown"}
    found: dict[str, list] = {"method": [], "assumption": [], "settings": []}
    for line in comments[1:]:
        subject, _, text = line.lstrip("# ").partition(": ")
        if subject in found:
            try:
                found[subject].append(json.loads(text))
            except (ValueError, RecursionError):
                raise FormatError(f"the comment '{line[:60]}' in '{name}' is damaged") from None
    settings = found["settings"][-1] if found["settings"] else {}
    if not isinstance(settings, dict):
        raise FormatError(f"the settings in '{name}' are damaged")
    return {
        "method": str(found["method"][-1]) if found["method"] else "unknown",
        "assumptions": tuple(str(assumption) for assumption in found["assumption"]),
        "settings": {str(key): str(value) for key, value in settings.items()},
    }


def _hint(poses: Float[Tensor, "frames 4 4"]) -> str:
    """Return what may have happened to poses that are not rigid."""
    if bool(is_rigid(poses.mT).all()):
        return "; the matrices are written column by column: transpose them"
    return ""
