"""``sonosweep convert``: a sequence from one's own images and poses, or back."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from sonosweep.cli.inputs import Force, InputOptions, Json, read
from sonosweep.cli.whole_number import WHOLE

if TYPE_CHECKING:
    from sonosweep.scan import Scan


def convert(
    scan: Path,
    output: Path,
    /,
    *,
    crop: tuple[int, int, int, int] | None = None,
    resize: tuple[int, int] | None = None,
    first: Annotated[int, WHOLE] = 0,
    last: Annotated[int | None, WHOLE] = None,
    step: Annotated[int, WHOLE] = 1,
    anonymize: bool = True,
    inputs: InputOptions | None = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """Write a scan in another format: what is in the file comes along, with added poses.

    The suffix of OUTPUT chooses: .igs.mha, .igs.nrrd (PLUS and 3D Slicer), .seq.nrrd, .h5
    (ours), .dcm (DICOM cine), .mp4 or .mkv (each with poses in a csv beside it), or no
    suffix for a folder of PNG images and poses.csv.

    Args:
        scan: File or folder of the sweep.
        output: Where to write.
        crop: Part of the frame to keep, as column, row, width, height in pixels.
        resize: New width and height in pixels; the field of view stays.
        first: First frame to keep, counted from 0.
        last: Last frame to keep; to the end otherwise.
        step: Keep every so many frames.
        anonymize: Leave out who was scanned.
    """
    from sonosweep.cli.output import check_free, say
    from sonosweep.io import write_scan_as
    from sonosweep.io.open import HDF5
    from sonosweep.io.write_scan import poses_beside

    check_free(output, force)
    recorded = _change(read(scan, inputs), crop, resize, range_of(first, last, step))
    beside = poses_beside(output)
    if beside is not None and recorded.image_to_reference is not None:
        check_free(beside, force)
    files = write_scan_as(recorded, output, keep_subject=not anonymize)
    frames, rows, columns = recorded.frames.shape[:3]
    names = ", ".join(str(file) for file in files)
    left_out = [] if output.suffix.lower() in HDF5 else sorted(recorded.companions)
    lost = f"; {', '.join(left_out)} left out: only .h5 holds companions" if left_out else ""
    say(
        f"{recorded.name}: {frames} frames of {columns} x {rows} pixels -> {names}{lost}",
        {
            "scan": recorded.name,
            "frames": frames,
            "outputs": [str(file) for file in files],
            "left_out": left_out,
        },
        json,
    )


def range_of(first: int, last: int | None, step: int) -> slice:
    """Return the slice of frames that the options ask for.

    Raises:
        ScanError: If a number makes no sense.
    """
    from sonosweep.errors import ScanError

    if first < 0 or step < 1 or (last is not None and last < first):
        raise ScanError(
            f"frames from {first} to {last} in steps of {step}: count from 0, forward, by 1 or more"
        )
    return slice(first, None if last is None else last + 1, step)


def _change(
    scan: "Scan",
    crop: tuple[int, int, int, int] | None,
    resize: tuple[int, int] | None,
    frames: slice,
) -> "Scan":
    from sonosweep.scan import crop_scan, resample_scan, select_frames

    if frames != slice(0, None, 1):
        scan = select_frames(scan, range(len(scan.frames))[frames])
    if crop is not None:
        scan = crop_scan(scan, crop)
    return scan if resize is None else resample_scan(scan, *resize)
