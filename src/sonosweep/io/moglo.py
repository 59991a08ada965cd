"""The HDF5 files of the code released with MoGLo-Net (``data/001/LH_uS1_an31.h5``).

========= =====================================================================
``img_B``  B-mode (N, 1, 256, 256), 0 to 255
``y_rel``  (N - 1, 6) motion from each frame to the next: cm, then degrees
``y_abs``  (N, 6) the same numbers of ``inv(T[0]) T[n]``, or of a tracker's pose
========= =====================================================================

The six numbers are intrinsic ``YZX`` angles and translations along (rows, columns, out of
plane), see :func:`sonosweep.geometry.step_from_moglo`. Pixels are 38/256 mm in both
directions and the files do not say so.

The poses are those of the magnetic *sensor*, its axes taken as parallel to the image. The
released code moves its grid points by (-20, 0, -7) mm (rows, columns, out of plane) from the
sensor, a constant that no file holds. Ask for it with ``sensor_offset=True``; otherwise the
sensor is taken to sit at the first pixel. Rotations do not depend on this; translations,
and every error in mm, do.
"""

import os
import re
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from sonosweep.errors import FormatError
from sonosweep.geometry import pose_from_parts, poses_from_steps, step_from_moglo
from sonosweep.io.hdf5_access import (
    frames_from_dataset,
    get_dataset,
    hdf5_holds,
    open_hdf5,
    read_array,
)
from sonosweep.scan import Calibration, Scan

SPACING_MM = 38 / 256
# The released code's (rows, columns, out of plane) in our axes: rows and columns change
# places and out of plane changes sign.
SENSOR_OFFSET_MM = (0.0, -20.0, 7.0)
AGREEMENT_MM = 0.1  # far above float32 round-off over 1000 steps, far below a step
SUBJECT = re.compile(r"\d{3,}")


def is_moglo(path: str | os.PathLike) -> bool:
    """Say whether a file has this layout."""
    return hdf5_holds(path, "img_B")


def read_moglo(path: str | os.PathLike, sensor_offset: bool = False) -> Scan:
    """Return a scan of this layout with poses chained from ``y_rel``.

    Where ``y_abs`` does not lead to the same places, ``notes["poses"]`` says by how much.

    Args:
        path: The file.
        sensor_offset: Whether to place the image on the sensor as the released code does.

    Raises:
        FormatError: If it has another layout or is damaged.
        ScanError: If its parts contradict each other.
    """
    file = Path(path)
    notes = {"time": "the file has no times; the paper's sweeps have 20 frames/s"}
    with open_hdf5(file) as opened:
        stored = get_dataset(opened, "img_B")
        axes = (1, 2, 0) if len(stored.shape) == 4 else None
        frames = frames_from_dataset(stored, axes)
        relative = absolute = None
        if "y_rel" in opened:
            relative = torch.from_numpy(read_array(opened, "y_rel", (None, 6)))
        if "y_abs" in opened:
            absolute = torch.from_numpy(read_array(opened, "y_abs", (None, 6), len(frames)))
    poses = _sensor_poses(relative, absolute, len(frames), file.name)
    if poses is None:
        notes["poses"] = "the file has neither y_rel nor y_abs"
    elif relative is not None and absolute is not None:
        notes.update(_compare(poses, step_from_moglo(absolute)))
    image_to_sensor = None
    if sensor_offset:
        image_to_sensor = pose_from_parts(
            torch.eye(3, dtype=torch.float64), torch.tensor(SENSOR_OFFSET_MM, dtype=torch.float64)
        )
        poses = None if poses is None else poses @ image_to_sensor
    folder = file.absolute().parent.name
    return Scan(
        name=file.stem,
        frames=frames,
        calibration=Calibration((SPACING_MM, SPACING_MM), image_to_probe=image_to_sensor),
        image_to_reference=poses,
        subject=folder if SUBJECT.fullmatch(folder) else None,
        notes=notes,
    )


def _sensor_poses(
    relative: Float[Tensor, "steps motion=6"] | None,
    absolute: Float[Tensor, "frames motion=6"] | None,
    count: int,
    name: str,
) -> Float[Tensor, "frames 4 4"] | None:
    if relative is None:
        return None if absolute is None else step_from_moglo(absolute)
    if len(relative) != count - 1:
        raise FormatError(
            f"{count} frames need {count - 1} motions, but '{name}' has {len(relative)} in y_rel"
        )
    first = torch.eye(4, dtype=torch.float64)
    if absolute is not None:
        first = step_from_moglo(absolute[0])
    return poses_from_steps(step_from_moglo(relative), first)


def _compare(
    chained: Float[Tensor, "frames 4 4"], absolute: Float[Tensor, "frames 4 4"]
) -> dict[str, str]:
    """Return a note if the chained poses and the absolute ones part."""
    apart = torch.linalg.vector_norm(chained[:, :3, 3] - absolute[:, :3, 3], dim=-1)
    if not bool(apart.max() > AGREEMENT_MM):
        return {}
    return {
        "poses": f"chained from y_rel; y_abs is up to {float(apart.max()):.1f} mm away from them"
        f" (frame {int(apart.argmax())})"
    }
