"""MATLAB files: frames as ``rows x columns x frames``, or ``rows x columns x 3 x frames``.

The largest numeric array with three or four axes is taken for the frames, unless another is
named; one inside a struct is named ``scan.frames``. Beside it (in the same struct, or
outside) we look for

- ``timestamps_s``: one time per frame, s;
- ``image_to_reference``: ``4 x 4 x frames``, mm, in our image coordinates;
- ``spacing_mm``: lateral and axial pixel size, or one number for both.

Files saved with ``-v7.3`` are HDF5 and read frame by frame. Older ones can only be read
whole: that happens when the first frame is asked for.
"""

import os
from pathlib import Path

import h5py
import numpy as np
import torch
from torch import Tensor

from sonosweep.errors import FormatError
from sonosweep.io.hdf5_access import LARGEST_ARRAY_BYTES
from sonosweep.io.matlab_variables import Variable, explaining, list_new, list_old
from sonosweep.scan import Calibration, Scan

LISTED = 12  # variables that a message names
OPTIONAL = ("timestamps_s", "image_to_reference", "spacing_mm")


def read_mat(path: str | os.PathLike, variable: str | None = None) -> Scan:
    """Return the frames of a MATLAB file as a scan.

    Args:
        path: A ``.mat`` file of any version since 5.
        variable: Name of the frames; ``None`` takes the largest array.

    Raises:
        FormatError: If there are no frames or several equally large ones, or the file is
            damaged; the message lists what it holds.
        ScanError: If its parts contradict each other.
    """
    file = Path(path)
    if not file.is_file():
        raise FormatError(f"there is no file '{file}'")
    with explaining(file):
        is_new = bool(h5py.is_hdf5(str(file)))
    variables = list_new(file) if is_new else list_old(file, variable)
    name = _choose(variables, variable, file)
    frames = variables[name].frames()
    count = len(frames)
    found = {part: _beside(variables, name, part) for part in OPTIONAL}
    return Scan(
        name=file.stem,
        frames=frames,
        calibration=_calibration(found["spacing_mm"], file),
        timestamps_s=_times(found["timestamps_s"], count, file),
        image_to_reference=_poses(found["image_to_reference"], count, file),
    )


def _choose(variables: dict[str, Variable], wanted: str | None, file: Path) -> str:
    """Return the name of the frames."""
    known = ", ".join(
        f"{name} ({' x '.join(map(str, v.shape))})" for name, v in list(variables.items())[:LISTED]
    )
    if wanted is not None:
        if wanted not in variables:
            raise FormatError(f"'{file.name}' has no variable '{wanted}'; it holds {known}")
        if not _may_be_frames(variables[wanted]):
            raise FormatError(
                f"'{wanted}' in '{file.name}' cannot be frames: needed are real numbers, rows x"
                f" columns x frames or rows x columns x 3 x frames; the file holds {known}"
            )
        return wanted
    sizes = {
        name: float(np.prod(v.shape, dtype=float))
        for name, v in variables.items()
        if _may_be_frames(v)
    }
    if not sizes:
        raise FormatError(
            f"'{file.name}' holds no numbers of shape rows x columns x frames; it holds"
            f" {known or 'nothing'}; if they are in a struct, name them like 'scan.frames'"
        )
    largest = [name for name, size in sizes.items() if size == max(sizes.values())]
    if len(largest) > 1:
        raise FormatError(
            f"'{file.name}' holds several equally large arrays: say which of"
            f" {', '.join(largest[:LISTED])} are the frames"
        )
    return largest[0]


def _may_be_frames(variable: Variable) -> bool:
    shape = variable.shape
    channels = len(shape) == 3 or (len(shape) == 4 and shape[2] in (1, 3, 4))
    return variable.numeric and channels and min(shape) > 0


def _beside(variables: dict[str, Variable], name: str, part: str) -> Variable | None:
    """Return an optional variable from the frames' struct, or from outside of it."""
    struct = name.rpartition(".")[0]
    candidates = [f"{struct}.{part}", part] if struct else [part]
    return next((variables[c] for c in candidates if c in variables), None)


def _load_numbers(variable: Variable, what: str, file: Path) -> np.ndarray:
    if not variable.numeric or np.prod(variable.shape, dtype=float) * 8 > LARGEST_ARRAY_BYTES:
        raise FormatError(f"'{what}' in '{file.name}' must hold real numbers")
    values = variable.load()
    if np.iscomplexobj(values):
        raise FormatError(f"'{what}' in '{file.name}' must hold real numbers")
    return values.astype(np.float64)


def _calibration(variable: Variable | None, file: Path) -> Calibration | None:
    if variable is None:
        return None
    values = _load_numbers(variable, "spacing_mm", file).ravel()
    if len(values) not in (1, 2):
        raise FormatError(
            f"'spacing_mm' in '{file.name}' must be 1 or 2 numbers, not {len(values)}"
        )
    return Calibration((float(values[0]), float(values[-1])))


def _times(variable: Variable | None, count: int, file: Path) -> Tensor | None:
    if variable is None:
        return None
    times = _load_numbers(variable, "timestamps_s", file).ravel()
    if len(times) != count:
        raise FormatError(f"{count} frames but {len(times)} timestamps_s in '{file.name}'")
    return torch.from_numpy(np.ascontiguousarray(times))


def _poses(variable: Variable | None, count: int, file: Path) -> Tensor | None:
    if variable is None:
        return None
    poses = _load_numbers(variable, "image_to_reference", file)
    if poses.shape != (4, 4, count):
        raise FormatError(
            f"'image_to_reference' in '{file.name}' must be 4 x 4 x {count}, but is"
            f" {' x '.join(map(str, poses.shape))}"
        )
    return torch.from_numpy(np.ascontiguousarray(np.moveaxis(poses, -1, 0)))
