"""The one place that looks at an output path and decides how a scan is written."""

import os
from dataclasses import replace
from pathlib import Path

from sonosweep.errors import FormatError
from sonosweep.scan import Scan, Trajectory, select_tracked

KNOWN = ".igs.mha, .igs.nrrd, .seq.nrrd, .h5, .dcm, .mp4, .mkv, or a folder for PNG images"
SUFFIXES = (".mha", ".nrrd", ".h5", ".hdf5", ".dcm", ".mp4", ".mkv", "")
POSES_NAME = "poses.csv"  # where the reader of a folder of images looks


def write_scan_as(
    scan: Scan, path: str | os.PathLike, keep_subject: bool = False
) -> tuple[Path, ...]:
    """Write a scan in the format that the suffix names, and return the files written.

    Video, images and DICOM cine cannot hold poses: those go to a csv beside them. A folder
    of images that we wrote before is replaced, with its poses.

    Args:
        scan: What to write.
        path: ``.igs.mha``, ``.igs.nrrd``, ``.seq.nrrd``, ``.h5``, ``.dcm``, ``.mp4``,
            ``.mkv``, or no suffix for a folder of PNG images.
        keep_subject: Whether to write who was scanned.

    Raises:
        FormatError: If the suffix is not known, or the file cannot be written.
    """
    check_suffix(path)
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
    elif not suffix:
        return _write_folder(scan, file)
    else:
        return _write_pictures(scan, file, suffix)
    return (file,)


def check_suffix(path: str | os.PathLike) -> None:
    """Refuse a path that :func:`write_scan_as` cannot write, before frames are made for it.

    Raises:
        FormatError: If the suffix is not known.
    """
    if Path(path).suffix.lower() not in SUFFIXES:
        raise FormatError(f"cannot write a scan as '{Path(path).name}'; known are {KNOWN}")


def poses_beside(path: str | os.PathLike) -> Path | None:
    """Return where :func:`write_scan_as` puts the poses that a format cannot hold itself."""
    file = Path(path)
    if file.suffix.lower() not in (".mp4", ".mkv", ".dcm"):
        return None
    return file.with_name(f"{file.stem}_poses.csv")


def _write_pictures(scan: Scan, file: Path, suffix: str) -> tuple[Path, ...]:
    if suffix in (".mp4", ".mkv"):
        from sonosweep.io.video_write import write_video

        write_video(scan.frames, scan.timestamps_s, file)
    else:
        from sonosweep.io.dicom_cine import write_dicom_cine

        write_dicom_cine(scan, file)
    poses = poses_beside(file)
    if scan.image_to_reference is None or poses is None:
        return (file,)
    _write_poses(scan, poses)
    return (file, poses)


def _write_folder(scan: Scan, folder: Path) -> tuple[Path, ...]:
    from sonosweep.io.atomic_folder import write_folder_beside
    from sonosweep.io.images import FRAME_PATTERN, write_images

    with write_folder_beside(folder, (FRAME_PATTERN, POSES_NAME)) as temporary:
        write_images(scan.frames, temporary)
        if scan.image_to_reference is not None:
            _write_poses(scan, temporary / POSES_NAME)
    return (folder,) if scan.image_to_reference is None else (folder, folder / POSES_NAME)


def _write_poses(scan: Scan, path: Path) -> None:
    from sonosweep.io.trajectory_text import write_trajectory_csv

    seen = select_tracked(scan)
    assert seen.image_to_reference is not None
    frames = None if scan.tracked is None else scan.tracked.nonzero()[:, 0]
    poses = Trajectory(seen.image_to_reference, seen.timestamps_s, frames=frames)
    write_trajectory_csv(poses, path)
