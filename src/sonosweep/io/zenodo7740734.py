"""The forearm sweeps of Li et al. 2023 (Zenodo 7740734), 19 subjects, 12 sweeps each.

Folders ``000`` to ``018`` hold PLUS sequences (``.mha``, ``ProbeToTrackerTransform``) and one
csv with the columns ``start`` and ``end``: for each sweep, sorted by the number in its name,
the frames to use, end excluded. Three traps:

- the tracker was read out late: image k belongs to transform k + 4;
- transforms whose status is not OK hold nonsense, and their frames are left out;
- ``calib_matrix.csv`` is a headerless 8 x 4 table (scaling above, image-to-probe below) for
  pixels written as (row, column) from 0, unlike those of TUS-REC.

References:
    Li et al., "Trackerless freehand ultrasound with sequence modelling and auxiliary
    transformation over past and future frames", ISBI 2023, and its code.
"""

import os
import re
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from sonosweep.errors import FormatError
from sonosweep.io.number_table import is_number, parse_numbers, read_text, split_cells
from sonosweep.io.rounded_poses import unround_poses
from sonosweep.io.sequence import read_sequence
from sonosweep.io.tusrec import find_above
from sonosweep.scan import Calibration, FrameView, Scan, calibration_from_matrix

DELAY_FRAMES = 4
CALIBRATION_NAME = "calib_matrix.csv"


def read_zenodo7740734(
    path: str | os.PathLike,
    calibration: str | os.PathLike | Calibration,
    frames_used: tuple[int, int] | None = None,
    delay_frames: int = DELAY_FRAMES,
) -> Scan:
    """Return a sweep of this set, with the pose of the image per frame.

    Args:
        path: The ``.mha`` file.
        calibration: The calibration or its csv.
        frames_used: First frame and the one after the last; ``None`` looks for the csv in
            the file's folder, and takes all frames if there is none.
        delay_frames: How many frames the transforms come late.

    Raises:
        FormatError: If a file is missing, damaged or of another layout, or no frame is
            left.
        ScanError: If its parts contradict each other.
    """
    file = Path(path)
    sequence = read_sequence(file)
    tracker = sequence.transforms.get(("Probe", "Tracker"))
    if sequence.frames is None or tracker is None:
        known = ", ".join(f"{a}To{b}" for a, b in sequence.transforms) or "none"
        raise FormatError(f"'{file.name}' needs images and ProbeToTracker; it has {known}")
    if not isinstance(calibration, Calibration):
        calibration = read_zenodo_calibration(calibration)
    if frames_used is None:
        frames_used = _frames_from_table(file)
    count = len(sequence.frames)
    first, end = frames_used if frames_used is not None else (0, count)
    if not 0 <= first < end:
        raise FormatError(f"frames {first} to {end} of '{file.name}' are none")
    images = torch.arange(first, max(first, min(end, count - delay_frames)))
    images = images[tracker.valid[images + delay_frames]]
    if len(images) == 0:
        raise FormatError(f"no frame of '{file.name}' has a valid transform {delay_frames} later")
    probe_to_tracker = unround_poses(tracker.matrices[images + delay_frames])
    left_out = min(end, count) - first - len(images)
    return Scan(
        name=file.stem,
        frames=FrameView(sequence.frames, images.numpy()),
        calibration=calibration,
        timestamps_s=None if sequence.timestamps_s is None else sequence.timestamps_s[images],
        image_to_reference=probe_to_tracker @ image_to_probe_of(calibration),
        subject=file.absolute().parent.name,
        notes={"frames": f"{left_out} frames without valid transform are left out"},
    )


def find_zenodo_calibration(path: str | os.PathLike) -> Path | None:
    """Return the set's calibration beside a file or above it; ``None`` if there is none.

    The TUS-REC sets have a file of the same name, which starts with words.
    """
    found = find_above(Path(path), CALIBRATION_NAME)
    if found is None:
        return None
    first = next(iter(read_text(found).splitlines()), "")
    cells = split_cells(first)
    return found if cells and all(is_number(cell) for cell in cells) else None


def read_zenodo_calibration(path: str | os.PathLike) -> Calibration:
    """Return the calibration of a headerless 8 x 4 table, for (row, column) pixels from 0.

    Raises:
        FormatError: If it is another table.
        ScanError: If the matrices map the image onto a line or hold NaN.
    """
    name = Path(path).name
    lines = [line for line in read_text(path).splitlines() if line.strip()]
    if lines and not is_number(split_cells(lines[0])[0]):
        raise FormatError(
            f"'{name}' has titles: Zenodo 7740734 has 8 x 4 bare numbers; a table with titles"
            " belongs to TUS-REC, which counts pixels in another way"
        )
    rows = [
        parse_numbers(split_cells(line), f"line {i} of '{name}'")
        for i, line in enumerate(lines, start=1)
    ]
    if [len(row) for row in rows] != [4] * 8:
        raise FormatError(f"'{name}' must hold 8 rows of 4 numbers")
    scaling, spatial = torch.tensor(rows, dtype=torch.float64).split(4)
    return calibration_from_matrix(spatial @ scaling, "row_column", 0)


def image_to_probe_of(calibration: Calibration) -> Float[Tensor, "4 4"]:
    """Return where the image is on the probe.

    Raises:
        FormatError: If the calibration does not tell.
    """
    if calibration.image_to_probe is None:
        raise FormatError("the calibration has no image_to_probe, which tracked poses need")
    return calibration.image_to_probe


def _frames_from_table(file: Path) -> tuple[int, int] | None:
    """Return the frames to use by the csv of the folder, or ``None`` if there is none.

    Raises:
        FormatError: If there are several csv files, or the one has no row for this sweep.
    """
    tables = sorted(file.absolute().parent.glob("*.csv"))
    tables = [table for table in tables if table.name != CALIBRATION_NAME]
    if not tables:
        return None
    sweeps = sorted(file.absolute().parent.glob("*.mha"), key=_number_in_name)
    row = [sweep.name for sweep in sweeps].index(file.name)
    name = tables[0].name
    if len(tables) > 1:
        raise FormatError(f"several csv files beside '{file.name}': say which frames to use")
    lines = [split_cells(line) for line in read_text(tables[0]).splitlines() if line.strip()]
    header = [cell.strip('"').lower() for cell in lines[0]] if lines else []
    if "start" not in header or "end" not in header or len(lines) < row + 2:
        raise FormatError(f"'{name}' needs the columns start and end and {row + 1} or more rows")
    cells = lines[row + 1]
    if len(cells) != len(header):
        raise FormatError(
            f"{len(cells)} values instead of {len(header)} in row {row + 1}, '{name}'"
        )
    chosen = [cells[header.index("start")], cells[header.index("end")]]
    first, end = parse_numbers(chosen, f"row {row + 1} of '{name}'")
    if not (first.is_integer() and end.is_integer()):
        raise FormatError(f"start and end in row {row + 1} of '{name}' must be whole numbers")
    return int(first), int(end)


def _number_in_name(path: Path) -> tuple[int, str]:
    digits = "".join(re.findall(r"\d", path.name))
    return int(digits[:18] or 0), path.name
