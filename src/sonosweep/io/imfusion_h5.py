"""HDF5 files with ``images``, ``image_to_world_mm``, ``timestamps_s`` and ``spacing_mm``.

The layout in which sweeps exported from ImFusion's software travel. Its image origin is
the *centre* of the image, x right, y down: pixel (column, row) lies at
``((column - (columns - 1) / 2) * sx, (row - (rows - 1) / 2) * sy, 0)``. Our origin is the
centre of the first pixel, so every pose is moved by half the image.
"""

import os
from pathlib import Path

import torch

from sonosweep.geometry import pose_from_parts
from sonosweep.io.hdf5_access import (
    frames_from_dataset,
    get_dataset,
    hdf5_holds,
    open_hdf5,
    read_array,
)
from sonosweep.scan import Calibration, Scan


def is_imfusion_h5(path: str | os.PathLike) -> bool:
    """Say whether a file has this layout."""
    return hdf5_holds(path, "images", "image_to_world_mm", "spacing_mm")


def read_imfusion_h5(path: str | os.PathLike) -> Scan:
    """Return the tracked scan of a file in this layout; frames are read when indexed.

    Raises:
        FormatError: If it has another layout or is damaged.
        ScanError: If its parts contradict each other.
    """
    with open_hdf5(path) as file:
        frames = frames_from_dataset(get_dataset(file, "images"))
        count = len(frames)
        centered = torch.from_numpy(read_array(file, "image_to_world_mm", (None, 4, 4), count))
        x_mm, y_mm = read_array(file, "spacing_mm", (2,))
        times = None
        if "timestamps_s" in file:
            times = torch.from_numpy(read_array(file, "timestamps_s", (None,), count))
    calibration = Calibration(spacing_mm=(float(x_mm), float(y_mm)))
    rows, columns = frames.shape[1:3]
    first_pixel = [-(columns - 1) / 2 * float(x_mm), -(rows - 1) / 2 * float(y_mm), 0.0]
    first_pixel_to_center = pose_from_parts(
        torch.eye(3, dtype=torch.float64), torch.tensor(first_pixel, dtype=torch.float64)
    )
    return Scan(
        name=Path(path).stem,
        frames=frames,
        calibration=calibration,
        timestamps_s=times,
        image_to_reference=centered @ first_pixel_to_center,
    )
