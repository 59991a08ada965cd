"""The one place that looks at a path and decides which reader it needs."""

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Literal

import torch

from sonosweep.errors import FormatError, ScanError
from sonosweep.geometry import EulerOrder
from sonosweep.scan import Calibration, Scan, calibration_from_matrix

SEQUENCES = (".mha", ".mhd", ".nrrd", ".nhdr")
HDF5 = (".h5", ".hdf5", ".hdf")
VIDEOS = (".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".wmv")
IMAGES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")
DEMO_SWEEP = "demo-sweep"
KNOWN = "PLUS sequences (.mha .mhd .nrrd .nhdr), HDF5 (.h5), DICOM (.dcm), video, .mat, folders"


def open_scan(
    path: str | os.PathLike,
    *,
    plus_config: str | os.PathLike | None = None,
    pose_file: str | os.PathLike | None = None,
    spacing_mm: tuple[float, float] | None = None,
    frame_rate_hz: float | None = None,
    image_orientation: str | None = None,
    latency_s: float | None = None,
    max_gap_s: float = 0.1,
    pose_of: Literal["image", "probe"] | None = None,
    euler_order: EulerOrder | None = None,
    variable: str | None = None,
) -> Scan:
    """Return the scan in a file or folder of any format that we read.

    Frames are read when indexed, so opening is quick and small.

    Args:
        path: A file, or a folder of images or of single-frame DICOM files; ``"demo-sweep"``
            for the sweep that ships with the package, where no file has that name.
        plus_config: PLUS device set whose ImageToProbe places the image on the probe.
        pose_file: Poses beside the images (csv, TUM, ``.igs.mha``). With timestamps on both
            sides they are matched by time, else one by one.
        spacing_mm: Pixel size (lateral, axial), instead of what the file says.
        frame_rate_hz: Frames per second, instead of the file's times.
        image_orientation: PLUS's two letters (``"MF"``, ``"UF"``, ...), instead of what a
            sequence file says.
        latency_s: How much later the frame times are than the pose file's, for the same
            moment; what the scan's calibration says when ``None``, or 0 without one.
        max_gap_s: Longest time between two poses to interpolate over.
        pose_of: Whether the pose file's poses are of the image or of the probe, where the
            file does not say.
        euler_order: Order of the intrinsic turns of a pose file that holds Euler angles.
        variable: Which frames of a file that holds several: the name of an array in a
            ``.mat`` file, or ``sub003_scan07`` in a ``frames_res4.h5``.

    Raises:
        FormatError: If the file is missing, of no known format, or broken.
        ScanError: If its parts contradict each other.
    """
    file = Path(path)
    if file.name in ("", ".."):  # the folder where one is has a name too
        file = file.resolve()
    if not file.exists() and str(path) != DEMO_SWEEP:
        raise FormatError(f"there is no '{file}'")
    scan = _read(file, plus_config, image_orientation, variable)
    scan = replace(scan, name=printable(scan.name))
    if frame_rate_hz is not None:
        scan = with_frame_rate(scan, frame_rate_hz)
    if spacing_mm is not None:
        scan = with_spacing(scan, spacing_mm)
    if pose_file is not None:
        from sonosweep.io.attach_poses import attach_poses

        scan = attach_poses(scan, Path(pose_file), latency_s, max_gap_s, pose_of, euler_order)
    return scan


def printable(text: str) -> str:
    """Return text that any file can hold: bytes of a file name that are no text become ``?``."""
    return text.encode("utf-8", "replace").decode()


def with_spacing(scan: Scan, spacing_mm: tuple[float, float]) -> Scan:
    """Return the scan with another pixel size; poses stay with the first pixel."""
    calibration = scan.calibration or Calibration(spacing_mm)
    return replace(scan, calibration=replace(calibration, spacing_mm=spacing_mm))


def with_frame_rate(scan: Scan, frame_rate_hz: float) -> Scan:
    """Return the scan with frames at a steady rate from time 0.

    Raises:
        ScanError: If the rate is not positive.
    """
    if not 0 < frame_rate_hz < float("inf"):
        raise ScanError(f"the frame rate must be above 0 Hz, got {frame_rate_hz:g}")
    times = torch.arange(len(scan.frames), dtype=torch.float64) / frame_rate_hz
    return replace(scan, timestamps_s=times)


def _read(
    file: Path, plus_config: str | os.PathLike | None, orientation: str | None, variable: str | None
) -> Scan:
    suffix = file.suffix.lower()
    if not file.exists():
        from sonosweep.io.demo_sweep import read_demo_sweep

        scan = read_demo_sweep()
    elif file.is_dir():
        scan = _read_folder(file)
    elif file.stat().st_size == 0:
        raise FormatError(f"'{file.name}' is empty")
    elif suffix in SEQUENCES:
        return _read_sequence(file, plus_config, orientation)
    else:
        scan = _read_other(file, suffix, variable)
    if plus_config is not None:
        from sonosweep.io.plus_config import read_plus_config

        measured = read_plus_config(plus_config).transforms.get(("Image", "Probe"))
        if measured is not None:
            scan = replace(scan, calibration=calibration_from_matrix(measured))
    return scan


def _read_sequence(
    file: Path, plus_config: str | os.PathLike | None, orientation: str | None
) -> Scan:
    from sonosweep.io.sequence_scan import read_plus
    from sonosweep.io.zenodo7740734 import find_zenodo_calibration, read_zenodo7740734

    if plus_config is None and (calibration := find_zenodo_calibration(file)) is not None:
        return read_zenodo7740734(file, calibration)
    return read_plus(file, config=plus_config, orientation=orientation)


def _read_other(file: Path, suffix: str, variable: str | None) -> Scan:
    if suffix in HDF5:
        return _read_hdf5(file, variable)
    if suffix in VIDEOS:
        from sonosweep.io.video import read_video

        return read_video(file)
    if suffix == ".mat":
        from sonosweep.io.matlab import read_mat

        if variable is None:
            _refuse_channel_data(file)
        return read_mat(file, variable=variable)
    from sonosweep.io.dicom_cine import read_dicom_cine
    from sonosweep.io.dicom_frames import is_dicom

    if suffix in (".dcm", ".dicom", ".ima") or is_dicom(file):
        return read_dicom_cine(file)
    if suffix in IMAGES:
        raise FormatError(f"'{file.name}' is one image; give the folder that holds all of them")
    _refuse_channel_data(file)
    raise FormatError(f"'{file.name}' is of no format we know; we read {KNOWN}")


def _read_hdf5(file: Path, variable: str | None) -> Scan:
    """Ask each layout whether the file is one of its own."""
    from sonosweep.io.hdf5 import is_scan_hdf5, read_scan
    from sonosweep.io.hdf5_access import open_hdf5
    from sonosweep.io.imfusion_h5 import is_imfusion_h5, read_imfusion_h5
    from sonosweep.io.moglo import is_moglo, read_moglo
    from sonosweep.io.tusrec import is_tusrec, read_tusrec
    from sonosweep.io.zenodo7740734_h5 import (
        is_zenodo7740734_h5,
        parse_sweep_name,
        read_zenodo7740734_h5,
    )

    with open_hdf5(file):  # says it if the file is damaged, which is no question of layout
        pass
    if is_zenodo7740734_h5(file):
        subject, sweep = (0, 0) if variable is None else parse_sweep_name(variable)
        return read_zenodo7740734_h5(file, subject=subject, sweep=sweep)
    if variable is not None:
        raise FormatError(f"'{file.name}' holds one scan: leave out --variable {variable[:60]}")
    layouts: tuple[tuple[Callable[[Path], bool], Callable[[Path], Scan]], ...] = (
        (is_scan_hdf5, read_scan),
        (is_tusrec, read_tusrec),
        (is_moglo, read_moglo),
        (is_imfusion_h5, read_imfusion_h5),
    )
    for recognizes, read in layouts:
        if recognizes(file):
            return read(file)
    _refuse_channel_data(file)
    raise FormatError(f"'{file.name}' is HDF5 but of no layout we know; see docs/formats.md")


def _refuse_channel_data(path: Path) -> None:
    from sonosweep.io.open_channel_data import is_channel_data

    if is_channel_data(path):
        raise FormatError(
            f"'{path.name}' holds channel data, not images: use 'sonosweep beamform' first"
        )


def _read_folder(folder: Path) -> Scan:
    from sonosweep.io.dicom_cine import read_dicom_cine
    from sonosweep.io.dicom_frames import is_dicom
    from sonosweep.io.images import read_images

    files = sorted(child for child in folder.iterdir() if child.is_file())
    if any(child.suffix.lower() in IMAGES for child in files):
        return read_images(folder)
    if any(child.suffix.lower() == ".dcm" or is_dicom(child) for child in files):
        return read_dicom_cine(folder)
    _refuse_channel_data(folder)
    raise FormatError(f"folder '{folder.name}' holds neither images nor DICOM files")
