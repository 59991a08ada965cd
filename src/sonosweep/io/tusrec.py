"""The forearm sweeps of the TUS-REC challenges 2024 and 2025.

===================================== ========================================================
``frames_transfs/000/LH_Par_C_DtP.h5``  training: ``frames`` uint8 (N, 480, 640) and ``tforms``
                                        float32 (N, 4, 4), tracked tool to camera, mm
``frames/050/LH_Par_C_DtP.h5``          validation and test: ``frames`` only, with
``transfs/050/LH_Par_C_DtP.h5``         ``tforms`` in a file of the same name
``landmarks/landmark_000.h5``           one data set per scan (``landmark/`` in validation):
                                        frame from 0, column and row from 1
``calib_matrix.csv``                    pixel size and image-to-tool pose
===================================== ========================================================

Pixels are (column, row) counted from 1 there, so a pixel of ours lies at
``tforms @ C @ S @ (column + 1, row + 1, 0, 1)``. The 2025 set has the same layout with two
rotating scans per subject. Frames came at 20 per second; the files hold no times.
"""

import os
import re
from pathlib import Path

import h5py
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from sonosweep.errors import FormatError
from sonosweep.geometry import invert_pose, pose_from_parts
from sonosweep.io.atomic import write_beside
from sonosweep.io.disk_sink import DiskSink
from sonosweep.io.hdf5 import is_scan_hdf5
from sonosweep.io.hdf5_access import (
    HDF5Frames,
    frames_from_dataset,
    get_dataset,
    hdf5_holds,
    open_hdf5,
    read_array,
)
from sonosweep.io.number_table import is_number, parse_numbers, read_text, split_cells
from sonosweep.io.rounded_poses import unround_poses
from sonosweep.scan import Calibration, Scan, calibration_from_matrix, pixel_to_image

CALIBRATION_NAME = "calib_matrix.csv"
SCALING_TITLE = "scaling_from_pixel_to_mm"
SPATIAL_TITLE = (
    "spatial_calibration_from_image_coordinate_system_to_tracking_tool_coordinate_system"
)
FOLDERS_UP = 4  # how far above a scan its calibration and landmarks may lie
SUBJECT = re.compile(r"(simulated-)?\d{3,}")


def is_tusrec(path: str | os.PathLike) -> bool:
    """Say whether a file is a scan of these sets: HDF5 with ``frames``, and not ours."""
    return hdf5_holds(path, "frames") and not is_scan_hdf5(path)


def list_tusrec(folder: str | os.PathLike) -> list[Path]:
    """Return all scan files below a folder, in the order of their names.

    Archives unpack into different folders, so everything below is searched.

    Raises:
        FormatError: If there is none.
    """
    scans = [path for path in sorted(Path(folder).rglob("*.h5")) if is_tusrec(path)]
    if not scans:
        raise FormatError(f"no TUS-REC scan (.h5 with 'frames') in or below '{folder}'")
    return scans


def read_tusrec(
    path: str | os.PathLike, calibration: str | os.PathLike | Calibration | None = None
) -> Scan:
    """Return a scan of these sets, with the pose of the image (not of the tool) per frame.

    Args:
        path: The file that holds ``frames``.
        calibration: The calibration or its csv; ``None`` looks for ``calib_matrix.csv``
            beside the file and in the folders above. Without one the scan has no pixel
            size and no poses, and its notes say so.

    Raises:
        FormatError: If a file has another layout or is damaged.
        ScanError: If its parts contradict each other.
    """
    file = Path(path)
    frames, tool_to_camera = _read_parts(file)
    if not isinstance(calibration, Calibration):
        table = calibration if calibration is not None else find_above(file, CALIBRATION_NAME)
        calibration = None if table is None else read_tusrec_calibration(table)
    notes = {"time": "the file has no times; the set was recorded at 20 frames/s"}
    poses = None
    if calibration is None:
        notes["poses"] = f"not used: no {CALIBRATION_NAME} beside the file or above it"
    elif tool_to_camera is None:
        notes["poses"] = "the file has no tforms, and there is no file of its name in transfs"
    elif calibration.image_to_probe is not None:
        poses = unround_poses(tool_to_camera) @ calibration.image_to_probe
    return Scan(
        name=file.stem,
        frames=frames,
        calibration=calibration,
        image_to_reference=poses,
        subject=_subject(file),
        notes=notes,
    )


def read_tusrec_calibration(path: str | os.PathLike) -> Calibration:
    """Return the calibration of a ``calib_matrix.csv``: two titled 4 x 4 matrices.

    Raises:
        FormatError: If it is another table.
        ScanError: If the matrices map the image onto a line or hold NaN.
    """
    name = Path(path).name
    titles: list[str] = []
    rows: list[list[float]] = []
    for i, line in enumerate(read_text(path).splitlines(), start=1):
        cells = split_cells(line)
        if cells and not is_number(cells[0]):
            titles.append(cells[0])
        elif cells:
            rows.append(parse_numbers(cells, f"line {i} of '{name}'"))
    if not titles:
        raise FormatError(
            f"'{name}' has no titles: TUS-REC names its two matrices; a table of 8 x 4 bare"
            " numbers belongs to Zenodo 7740734, which counts pixels in another way"
        )
    if titles != [SCALING_TITLE, SPATIAL_TITLE] or [len(row) for row in rows] != [4] * 8:
        raise FormatError(f"'{name}' must hold '{SCALING_TITLE}' and '{SPATIAL_TITLE}', 4 x 4 each")
    scaling, spatial = torch.tensor(rows, dtype=torch.float64).split(4)
    return calibration_from_matrix(spatial @ scaling, "column_row", 1)


def read_tusrec_landmarks(
    scan_path: str | os.PathLike, landmarks: str | os.PathLike | None = None
) -> Int[Tensor, "landmarks frame_column_row=3"]:
    """Return the landmarks of a scan as (frame, column, row), all counted from 0.

    Args:
        scan_path: The scan file; its name is the name of the data set.
        landmarks: The landmark file; ``None`` looks for it in the folders above.

    Raises:
        FormatError: If there is none, or it holds no landmarks of this scan.
    """
    scan = Path(scan_path)
    if landmarks is None:
        landmarks = find_tusrec_landmarks(scan)
        if landmarks is None:
            raise FormatError(
                f"no landmarks/landmark_{scan.parent.name}.h5 in the folders above '{scan}'"
            )
    with open_hdf5(landmarks) as file:
        counted = read_array(file, scan.stem, (None, 3))
    if not np.isfinite(counted).all() or (np.abs(counted) > 2**31).any():
        raise FormatError(f"the landmarks of '{scan.stem}' are not all whole numbers")
    return torch.from_numpy(counted).to(torch.int64) - torch.tensor([0, 1, 1])


def find_tusrec_landmarks(scan_path: str | os.PathLike) -> Path | None:
    """Return the landmark file of a scan's subject in the folders above; ``None`` if absent."""
    scan = Path(scan_path)
    name = f"landmark_{scan.absolute().parent.name}.h5"
    found = [find_above(scan, f"{folder}/{name}") for folder in ("landmarks", "landmark")]
    return next((path for path in found if path is not None), None)


def write_tusrec(scan: Scan, folder: str | os.PathLike) -> Path:
    """Write a tracked scan in the training layout and return its file.

    ``frames_transfs/SUBJECT/NAME.h5`` and, if it is not there yet, ``calib_matrix.csv``.
    A scan without ``image_to_probe`` is written as if the probe were the image.

    Raises:
        FormatError: If the scan has no poses or pixel size, frames that are not 8-bit
            gray, or another calibration than the one in the folder.
    """
    tracked = scan.tracked is None or bool(scan.tracked.all())
    if scan.calibration is None or scan.image_to_reference is None or not tracked:
        raise FormatError(
            f"'{scan.name}' needs a pixel size and a valid pose for each frame to be written as"
            " TUS-REC"
        )
    if scan.frames.dtype != np.uint8 or len(scan.frames.shape) != 3:
        raise FormatError(f"TUS-REC frames are 8-bit gray, those of '{scan.name}' are not")
    root, subject = Path(folder), scan.subject or "000"
    for part in (scan.name, subject):
        if Path(part).name != part:
            raise FormatError(f"'{part}' cannot be the name of a file or folder: rename the scan")
    _write_calibration(scan.calibration, root / CALIBRATION_NAME)
    image_to_tool = _image_to_tool(scan.calibration)
    tool_to_camera = scan.image_to_reference @ invert_pose(image_to_tool)
    path = root / "frames_transfs" / subject / f"{scan.name}.h5"
    with write_beside(path) as temporary, DiskSink(temporary) as sink:
        with h5py.File(sink, "w") as file:
            file["tforms"] = tool_to_camera.to(torch.float32).numpy()
            frames = file.create_dataset(
                "frames", scan.frames.shape, np.uint8, chunks=(1, *scan.frames.shape[1:])
            )
            for i in range(len(scan.frames)):
                frames[i] = scan.frames[i]
                sink.check()
        sink.check()
    return path


def _read_parts(file: Path) -> tuple[HDF5Frames, Float[Tensor, "frames 4 4"] | None]:
    """Return the frames, and the tracker's poses from this file or the one in transfs."""
    with open_hdf5(file) as opened:
        frames = frames_from_dataset(get_dataset(opened, "frames"))
        if "tforms" in opened:
            return frames, torch.from_numpy(read_array(opened, "tforms", (None, 4, 4), len(frames)))
    parts = list(file.parts)
    if len(parts) < 3 or parts[-3] != "frames":
        return frames, None
    parts[-3] = "transfs"
    beside = Path(*parts)
    if not beside.is_file():
        return frames, None
    with open_hdf5(beside) as opened:
        return frames, torch.from_numpy(read_array(opened, "tforms", (None, 4, 4), len(frames)))


def find_above(file: Path, name: str) -> Path | None:
    """Return the file of that name in the nearest folder above, at most four up."""
    for folder in list(file.absolute().parents)[:FOLDERS_UP]:
        if (folder / name).is_file():
            return folder / name
    return None


def _subject(file: Path) -> str | None:
    folder = file.absolute().parent.name
    return folder if SUBJECT.fullmatch(folder) else None


def _image_to_tool(calibration: Calibration) -> Float[Tensor, "4 4"]:
    if calibration.image_to_probe is None:
        return torch.eye(4, dtype=torch.float64)
    return calibration.image_to_probe


def _write_calibration(calibration: Calibration, path: Path) -> None:
    """Write the two matrices, for pixels counted from 1, or check that they are there."""
    scaling = pixel_to_image(calibration)
    before_first = pose_from_parts(
        torch.eye(3, dtype=torch.float64), -(scaling[:3, 0] + scaling[:3, 1])
    )
    spatial = _image_to_tool(calibration) @ before_first
    lines = []
    for title, matrix in ((SCALING_TITLE, scaling), (SPATIAL_TITLE, spatial)):
        lines += [title, *(",".join(repr(value) for value in row) for row in matrix.tolist())]
    text = "\r\n".join(lines) + "\r\n"
    if path.is_file():
        if not _same(read_tusrec_calibration(path), calibration):
            raise FormatError(
                f"'{path}' is the calibration of other scans: write this one to its own folder"
            )
        return
    with write_beside(path) as temporary:
        temporary.write_bytes(text.encode())


def _same(one: Calibration, other: Calibration) -> bool:
    return bool(
        torch.allclose(pixel_to_image(one), pixel_to_image(other), rtol=0, atol=1e-9)
        and torch.allclose(_image_to_tool(one), _image_to_tool(other), rtol=0, atol=1e-6)
    )
