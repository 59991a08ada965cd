"""Trajectories as ITK transform files (``.tfm``): one affine transform per frame.

ITK stores *resampling* transforms: from the fixed system to the moving one, in LPS. The
fixed system is our reference and the moving one the image, so each entry is the inverse of
the frame's pose, with x and y of both systems turned by the world rule::

    entry = turn @ inverse(image_to_reference) @ turn

3D Slicer inverts a transform on loading, so that a frame's entry places its image there.
SimpleITK's ``ReadTransform`` gives the first of a list, ITK's ``transformread`` all. To see
the whole sweep in Slicer, write ``.mrk.json`` or ``.igs.mha``. The times are in comments.
"""

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sonosweep.errors import FormatError
from sonosweep.geometry import invert_pose
from sonosweep.io.atomic import write_beside
from sonosweep.io.guard import refusing
from sonosweep.io.voxels import stated_world
from sonosweep.io.world import World, reference_to_lps
from sonosweep.scan import Trajectory

FIRST_LINE = "#Insight Transform File V1.0"
WORLD_LINE = "# sonosweep: each transform is reference to image in LPS; world="
TIME_LINE = "# time_s="
KINDS = ("AffineTransform", "MatrixOffsetTransformBase", "Rigid3DTransform")
LARGEST_FILE_BYTES = 1 << 28  # half a million frames


def write_itk_transforms(
    trajectory: Trajectory, path: str | os.PathLike, world: World = "ras"
) -> None:
    """Write the poses as the transforms described above, with all their digits.

    Raises:
        FormatError: If the file cannot be written.
    """
    entries = _turned(invert_pose(trajectory.image_to_reference), world)
    with write_beside(path) as temporary, temporary.open("w", encoding="ascii") as file:
        print(FIRST_LINE, file=file)
        print(WORLD_LINE + world, file=file)
        for frame, matrix in enumerate(entries):
            numbers = [*matrix[:3, :3].flatten().tolist(), *matrix[:3, 3].tolist()]
            print(f"#Transform {frame}", file=file)
            if trajectory.timestamps_s is not None:
                print(f"{TIME_LINE}{float(trajectory.timestamps_s[frame])!r}", file=file)
            print("Transform: AffineTransform_double_3_3", file=file)
            print("Parameters: " + " ".join(repr(number) for number in numbers), file=file)
            print("FixedParameters: 0 0 0", file=file)


def _turned(a_to_b: Float[Tensor, "frames 4 4"], world: World) -> Float[Tensor, "frames 4 4"]:
    turn = torch.eye(4, dtype=torch.float64)
    turn[:3, :3] = torch.from_numpy(reference_to_lps(world).copy())
    return turn @ a_to_b.to(torch.float64) @ turn


def read_itk_transforms(path: str | os.PathLike, world: World = "ras") -> Trajectory:
    """Return the trajectory in an ITK text transform file of rigid transforms.

    Args:
        path: Ends in ``.tfm``.
        world: How to read the coordinates of a file that does not tell itself.

    Raises:
        FormatError: If it is no such file, or a transform in it is not rigid.
    """
    with refusing(path, "ITK transforms"):
        if Path(path).stat().st_size > LARGEST_FILE_BYTES:
            raise FormatError(f"'{path}' is too large for a list of transforms")
        lines = Path(path).read_text("ascii", "replace").splitlines()
        if not lines or not lines[0].startswith("#Insight Transform File"):
            raise FormatError(f"'{path}' is no ITK transform file: expected '{FIRST_LINE}' on top")
        told = next((ln.removeprefix(WORLD_LINE) for ln in lines if ln.startswith(WORLD_LINE)), "")
        entries = list(_entries(lines, path))
        if not entries:
            raise FormatError(f"'{path}' holds no transform")
        matrices = torch.from_numpy(np.stack([entry.matrix for entry in entries]))
        times = [entry.time_s for entry in entries]
        known = torch.tensor([t for t in times if t is not None], dtype=torch.float64)
        poses = invert_pose(_turned(matrices, stated_world(told, world)))
        return Trajectory(
            image_to_reference=poses,
            timestamps_s=known if len(known) == len(times) else None,
        )


@dataclass(frozen=True)
class _Entry:
    """One transform of a file."""

    matrix: Float[np.ndarray, "4 4"]
    time_s: float | None


def _entries(lines: list[str], path: str | os.PathLike) -> Iterator[_Entry]:
    """Give the matrix, and the time if stated, of each transform."""
    time_s: float | None = None
    parameters: list[float] | None = None
    for line in lines:
        name, _, value = line.partition(":")
        if line.startswith(TIME_LINE):
            time_s = float(line.removeprefix(TIME_LINE))
        elif name == "Transform":
            kind = re.match(r"\s*([A-Za-z0-9]*)_(double|float)_3_3\s*$", value)
            if kind is None or kind[1] not in KINDS:
                raise FormatError(
                    f"'{path}' holds a '{value.strip()[:60]}'; expected AffineTransform_double_3_3"
                )
        elif name == "Parameters":
            parameters = _numbers(value, 12, path)
        elif name == "FixedParameters" and parameters is not None:
            yield _Entry(_matrix(parameters, _numbers(value, 3, path)), time_s)
            parameters = time_s = None
    if parameters is not None:
        raise FormatError(f"'{path}' is cut short: its last transform has no FixedParameters")


def _numbers(text: str, count: int, path: str | os.PathLike) -> list[float]:
    words = text.split()
    if len(words) != count:
        raise FormatError(f"{len(words)} parameters in '{path}', expected {count}")
    return [float(word) for word in words]


def _matrix(parameters: list[float], center: list[float]) -> Float[np.ndarray, "4 4"]:
    """Return the matrix of ``A (x - center) + center + translation``."""
    matrix = np.eye(4)
    matrix[:3, :3] = np.reshape(parameters[:9], (3, 3))
    matrix[:3, 3] = np.asarray(parameters[9:]) + center - matrix[:3, :3] @ center
    return matrix
