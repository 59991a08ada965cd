"""The ``frames_res4.h5`` that the code of Li et al. 2023 makes of Zenodo 7740734.

One file for all sweeps, frames at a quarter of the size: ``sub000_scan00_frame0000`` uint8
(120, 160) and ``sub000_scan00_tform0000`` float32 (4, 4), probe to tracker, with
``num_frames`` (subjects, sweeps), ``sub_folders`` and ``frame_size``. Delay and status of
the tracker are already dealt with. A subject's code is its number in this file, which need not
be the number of its folder.

Differs:
    That code places a pixel of the small images at 4 times its index. They were made by
    averaging around 4 times the index plus 1.5, and that is where we place it.
"""

import os
import re
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import torch

from sonosweep.errors import FormatError
from sonosweep.geometry import pose_from_parts
from sonosweep.io.hdf5_access import (
    LARGEST_FRAME_BYTES,
    get_dataset,
    hdf5_holds,
    open_hdf5,
    read_array,
)
from sonosweep.io.rounded_poses import unround_poses
from sonosweep.io.zenodo7740734 import (
    CALIBRATION_NAME,
    image_to_probe_of,
    read_zenodo_calibration,
)
from sonosweep.scan import Calibration, LazyFrames, Scan, pixel_to_image

SHRINK = 4
LARGEST_COUNT = 100_000
SWEEP_NAME = re.compile(r"sub(\d{3,6})_scan(\d{2,6})")


def is_zenodo7740734_h5(path: str | os.PathLike) -> bool:
    """Say whether a file is a ``frames_res4.h5``."""
    return hdf5_holds(path, "num_frames", "sub_folders", "frame_size")


def read_zenodo7740734_h5(
    path: str | os.PathLike,
    calibration: str | os.PathLike | Calibration | None = None,
    subject: int = 0,
    sweep: int = 0,
) -> Scan:
    """Return one sweep of a ``frames_res4.h5``; frames are read when indexed.

    Args:
        path: The file.
        calibration: The calibration of the full-size images or its csv; ``None`` looks for
            ``calib_matrix.csv`` beside the file. Without one there are no poses.
        subject: Which subject, from 0.
        sweep: Which of the subject's sweeps, from 0.

    Raises:
        FormatError: If a file is missing, damaged or of another layout, or there is no
            such sweep.
        ScanError: If its parts contradict each other.
    """
    small = _small_calibration(Path(path), calibration)
    prefix = f"sub{subject:03d}_scan{sweep:02d}"
    with open_hdf5(path) as file:
        count, sweeps = _count_frames(file, subject, sweep)
        frames = _open_frames(file, f"{prefix}_frame", count)
        tforms = [read_array(file, f"{prefix}_tform{i:04d}", (4, 4)) for i in range(count)]
    poses = None
    if small is not None:
        poses = unround_poses(torch.from_numpy(np.stack(tforms))) @ image_to_probe_of(small)
    notes = {} if small else {"poses": f"not used: no {CALIBRATION_NAME} beside the file"}
    if sweeps > 1:
        notes["sweeps"] = f"this is {prefix}, one of {sweeps} in the file"
    return Scan(
        name=prefix,
        frames=frames,
        calibration=small,
        image_to_reference=poses,
        subject=f"sub{subject:03d}",
        notes=notes,
    )


def parse_sweep_name(name: str) -> tuple[int, int]:
    """Return subject and sweep of a name such as ``sub003_scan07``, both from 0.

    Raises:
        FormatError: If it is no such name.
    """
    found = SWEEP_NAME.fullmatch(name.strip())
    if found is None:
        raise FormatError(f"'{name[:60]}' names no sweep: expected a name such as sub003_scan07")
    return int(found[1]), int(found[2])


def shrink_calibration(calibration: Calibration, factor: int) -> Calibration:
    """Return the calibration of images shrunk by a factor, edges kept where they were."""
    columns, rows = pixel_to_image(calibration)[:3, 0], pixel_to_image(calibration)[:3, 1]
    shift = (columns + rows) * ((factor - 1) / 2)
    moved = pose_from_parts(torch.eye(3, dtype=torch.float64), shift)
    return replace(
        calibration,
        spacing_mm=(calibration.spacing_mm[0] * factor, calibration.spacing_mm[1] * factor),
        image_to_probe=image_to_probe_of(calibration) @ moved,
    )


class NumberedFrames(LazyFrames):
    """Frames that are one data set each, ``PREFIX0000`` and on, read when indexed.

    Args:
        path: The HDF5 file.
        prefix: Name of the data sets without the four digits.
        shape: Frames, rows and columns.
        dtype: Type of a pixel.
    """

    def __init__(
        self, path: Path, prefix: str, shape: tuple[int, int, int], dtype: np.dtype
    ) -> None:
        super().__init__(shape, dtype)
        self._path, self._prefix = path, prefix

    def _read(self, frame: int) -> np.ndarray:
        with open_hdf5(self._path) as file:
            stored = read_array(file, f"{self._prefix}{frame:04d}", self._shape[1:])
        return stored.astype(self._dtype)


def _small_calibration(
    path: Path, calibration: str | os.PathLike | Calibration | None
) -> Calibration | None:
    """Return the calibration of the small images; ``None`` if none was given or found."""
    beside = path.absolute().parent / CALIBRATION_NAME
    if calibration is None and beside.is_file():
        calibration = beside
    if calibration is None:
        return None
    if not isinstance(calibration, Calibration):
        calibration = read_zenodo_calibration(calibration)
    return shrink_calibration(calibration, SHRINK)


def _open_frames(file: h5py.File, prefix: str, count: int) -> NumberedFrames:
    path = Path(file.filename)
    first = get_dataset(file, f"{prefix}0000")
    if len(first.shape) != 2 or first.nbytes > LARGEST_FRAME_BYTES:
        raise FormatError(f"the frames of '{path.name}' are of shape {first.shape}")
    rows, columns = first.shape
    return NumberedFrames(path.resolve(), prefix, (count, rows, columns), first.dtype)


def _count_frames(file: h5py.File, subject: int, sweep: int) -> tuple[int, int]:
    """Return how many frames a sweep has, and how many sweeps with frames the file has."""
    counts = read_array(file, "num_frames", (None, None))
    name = Path(file.filename).name
    if not (0 <= subject < counts.shape[0] and 0 <= sweep < counts.shape[1]):
        raise FormatError(
            f"'{name}' holds {counts.shape[0]} subjects of {counts.shape[1]} sweeps, counted from"
            f" 0; there is no sweep {sweep} of subject {subject}"
        )
    count = float(counts[subject, sweep])
    if not (count.is_integer() and 0 < count <= LARGEST_COUNT):
        raise FormatError(f"sweep {sweep} of subject {subject} in '{name}' has {count:g} frames")
    return int(count), int(np.count_nonzero(counts))
