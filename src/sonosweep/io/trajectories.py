"""The one place that looks at a trajectory's path and decides on its format."""

import os
from dataclasses import replace
from pathlib import Path

from sonosweep.errors import FormatError, ScanError
from sonosweep.io.world import World
from sonosweep.scan import Trajectory

TUM = (".txt", ".tum")
ENDINGS_OUT = (".csv", *TUM, ".mha", ".tfm", ".mrk.json")
KNOWN_OUT = ".csv, .txt or .tum (TUM), .igs.mha, .tfm, .mrk.json"
KNOWN_IN = ".csv, .txt or .tum (TUM), .tfm, and PLUS sequences (.igs.mha)"
SEQUENCES = (".mha", ".mhd", ".nrrd", ".nhdr")


def read_trajectory(path: str | os.PathLike, world: World = "ras") -> Trajectory:
    """Return the trajectory in a file.

    A sequence file gives the poses of the image or, if it does not say where the image is,
    those of the probe; ``settings["pose_of"]`` then says ``"Probe"``. Poses that the
    tracker missed are left out.

    Args:
        path: ``.csv``, ``.txt`` or ``.tum``, ``.tfm``, or a PLUS sequence.
        world: How to read a ``.tfm`` that does not tell itself; the other formats hold our
            reference as it is.

    Raises:
        FormatError: If the file is missing, of no known format, or broken.
        ScanError: If a sequence holds no poses.
    """
    file = Path(path)
    suffix = file.suffix.lower()
    if not file.is_file():
        raise FormatError(f"there is no file '{file}'")
    if suffix == ".csv" or suffix in TUM:
        from sonosweep.io.pose_table import read_pose_table

        return read_pose_table(file).trajectory
    if suffix == ".tfm":
        from sonosweep.io.itk_transform import read_itk_transforms

        return read_itk_transforms(file, world)
    if suffix in SEQUENCES:
        return _read_from_sequence(file)
    raise FormatError(f"'{file.name}' is no trajectory that we read; known are {KNOWN_IN}")


def _read_from_sequence(file: Path) -> Trajectory:
    from sonosweep.io.sequence import read_sequence
    from sonosweep.io.sequence_scan import trajectory_from_sequence

    sequence = read_sequence(file)
    try:
        return trajectory_from_sequence(sequence)
    except ScanError as no_image:
        try:
            probe = trajectory_from_sequence(sequence, image="Probe")
        except ScanError:
            raise no_image from None
        return replace(probe, settings={**probe.settings, "pose_of": "Probe"})


def write_trajectory(
    trajectory: Trajectory,
    path: str | os.PathLike,
    world: World = "ras",
    point_mm: tuple[float, float] = (0.0, 0.0),
) -> None:
    """Write a trajectory in the format that the suffix names.

    Args:
        trajectory: What to write.
        path: ``.csv`` (everything is kept), ``.txt`` or ``.tum`` (TUM), ``.igs.mha``,
            ``.tfm`` or ``.mrk.json`` (a curve for 3D Slicer, which cannot be read back).
        world: How our reference is stated in ``.tfm`` and ``.mrk.json``; the other formats
            hold it as it is.
        point_mm: Which point of the image (lateral, axial) the curve of ``.mrk.json``
            follows; the center of the frame shows best.

    Raises:
        FormatError: If the suffix is not known, or the file cannot be written.
    """
    file = Path(path)
    check_name(file)
    name = file.name.lower()
    if name.endswith(".csv"):
        from sonosweep.io.trajectory_text import write_trajectory_csv

        write_trajectory_csv(trajectory, file)
    elif name.endswith(TUM):
        from sonosweep.io.trajectory_text import write_tum

        write_tum(trajectory, file)
    elif name.endswith(".mha"):
        from sonosweep.io.sequence_write import write_sequence

        write_sequence(trajectory, file)
    elif name.endswith(".tfm"):
        from sonosweep.io.itk_transform import write_itk_transforms

        write_itk_transforms(trajectory, file, world)
    else:
        from sonosweep.io.slicer_markups import write_slicer_curve

        write_slicer_curve(trajectory, file, world, point_mm)


def check_name(path: str | os.PathLike) -> None:
    """Refuse a name that :func:`write_trajectory` cannot write, before the work is done.

    Raises:
        FormatError: If the suffix is not known.
    """
    file = Path(path)
    if not file.name.lower().endswith(ENDINGS_OUT):
        raise FormatError(f"cannot write a trajectory as '{file.name}'; known are {KNOWN_OUT}")
