"""The one place that looks at an output path and decides how a scan is written."""

import os
from dataclasses import replace
from pathlib import Path

from sonosweep.errors import FormatError
from sonosweep.scan import Scan, Trajectory, select_tracked

KNOWN = ".igs.mha, .igs.nrrd, .seq.nrrd, .h5, .dcm, .mp4, .mkv, or a folder for PNG images"


def write_scan_as(
    scan: Scan, path: str | os.PathLike, keep_subject: bool = False
) -> tuple[Path, ...]:
    """Write a scan in the format that the suffix names, and return the files written.

    Video and images cannot hold poses: those go to a csv beside them.

    Args:
        scan: What to write.
        path: ``.igs.mha``, ``.igs.nrrd``, ``.seq.nrrd``, ``.h5``, ``.dcm``, ``.mp4``,
            ``.mkv``, or no suffix for a folder of PNG images.
        keep_subject: Whether to write who was scanned.

    Raises:
        FormatError: If the suffix is not known, or the file cannot be written.
    """
    file = Path(path)
    if not keep_subject:
        scan = replace(scan, subject=None)
    suffix = file.suffix.lower()
    if suffix in (".mha", ".nrrd"):
        from sonosweep.io.sequence_write import write_sequence

        write_sequence(scan, file)
    elif suffix in (".h5", ".hdf5"):
        from sonosweep.io.hdf5 import write_scan

        write_scan(scan, file)
    elif suffix == ".dcm":
        from sonosweep.io.dicom_cine import write_dicom_cine

        write_dicom_cine(scan, file)
    else:
        return _write_pictures(scan, file, suffix)
    return (file,)


def _write_pictures(scan: Scan, file: Path, suffix: str) -> tuple[Path, ...]:
    if suffix in (".mp4", ".mkv"):
        from sonosweep.io.video_write import write_video

        write_video(scan.frames, scan.timestamps_s, file)
        poses = file.with_name(f"{file.stem}_poses.csv")
    elif not suffix:
        from sonosweep.io.images import write_images

        write_images(scan.frames, file)
        poses = file / "poses.csv"
    else:
        raise FormatError(f"cannot write a scan as '{file.name}'; known are {KNOWN}")
    if scan.image_to_reference is None:
        return (file,)
    _write_poses(scan, poses)
    return (file, poses)


def _write_poses(scan: Scan, path: Path) -> None:
    from sonosweep.io.trajectory_text import write_trajectory_csv

    tracked = select_tracked(scan)
    assert tracked.image_to_reference is not None
    if len(tracked.frames) != len(scan.frames) and scan.timestamps_s is None:
        raise FormatError(
            f"some frames of '{scan.name}' have no pose and there are no times to tell which:"
            " give --frame-rate-hz, or write .h5 or .igs.mha"
        )
    write_trajectory_csv(Trajectory(tracked.image_to_reference, tracked.timestamps_s), path)
