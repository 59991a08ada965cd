"""Options that say how to read a scan, shared by the verbs."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Group, Parameter

if TYPE_CHECKING:
    from sonosweep.scan import Scan

INPUT = Group("Reading the scan", sort_key=2)
OUTPUT = Group("Output", sort_key=3)

Json = Annotated[bool, Parameter(negative="", group=OUTPUT, help="Print the summary as JSON.")]
Force = Annotated[bool, Parameter(negative="", group=OUTPUT, help="Overwrite existing output.")]


@Parameter(name="*", group=INPUT)
@dataclass(frozen=True)
class InputOptions:
    """How to read a scan.

    Attributes:
        plus_config: PLUS device set (.xml): its ImageToProbe places the image on the probe.
        pose_file: Poses beside the images: csv, TUM text or .igs.mha.
        pixel_spacing: Pixel size in mm, lateral then axial, instead of the file's.
        frame_rate_hz: Frames per second, instead of the file's times.
        image_orientation: PLUS's letters (MF, UF, ...), instead of what a sequence says.
        latency_ms: How much later frame times are than pose times for the same moment;
            what the scan's calibration says otherwise, usually 0.
        max_gap_ms: Longest time between two poses to interpolate over.
        pose_of: Whether the pose file's poses are of the image or of the probe, where the
            file does not say.
        euler_order: Order of the intrinsic turns, for a pose file with Euler angles.
        variable: Which frames of a file that holds several: the name of an array in a .mat
            file, or sub003_scan07 in a frames_res4.h5.
    """

    plus_config: Path | None = None
    pose_file: Path | None = None
    pixel_spacing: tuple[float, float] | None = None
    frame_rate_hz: float | None = None
    image_orientation: str | None = None
    latency_ms: float | None = None
    max_gap_ms: float = 100.0
    pose_of: Literal["image", "probe"] | None = None
    euler_order: Literal["XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX"] | None = None
    variable: str | None = None


def read(path: Path, options: InputOptions | None) -> "Scan":
    """Return the scan of a path, read as the options say.

    Raises:
        ScanError: If an option has nothing to act on: nobody shall think that it did.
    """
    from sonosweep.io import open_scan

    chosen = options or InputOptions()
    _refuse_idle(path, chosen)
    return open_scan(
        path,
        plus_config=chosen.plus_config,
        pose_file=chosen.pose_file,
        spacing_mm=chosen.pixel_spacing,
        frame_rate_hz=chosen.frame_rate_hz,
        image_orientation=chosen.image_orientation,
        latency_s=None if chosen.latency_ms is None else chosen.latency_ms / 1000,
        max_gap_s=chosen.max_gap_ms / 1000,
        pose_of=chosen.pose_of,
        euler_order=chosen.euler_order,
        variable=chosen.variable,
    )


def _refuse_idle(path: Path, options: InputOptions) -> None:
    from sonosweep.errors import ScanError
    from sonosweep.io.open import HDF5, SEQUENCES

    usual = InputOptions()
    needs_poses = {
        "--latency-ms": options.latency_ms != usual.latency_ms,
        "--max-gap-ms": options.max_gap_ms != usual.max_gap_ms,
        "--pose-of": options.pose_of is not None,
        "--euler-order": options.euler_order is not None,
    }
    idle = next((name for name, given in needs_poses.items() if given), None)
    if idle is not None and options.pose_file is None:
        raise ScanError(f"{idle} is about the poses of a --pose-file: give that too")
    suffix = path.suffix.lower()
    if options.variable is not None and suffix not in (".mat", *HDF5):
        raise ScanError(
            f"--variable chooses an array of a .mat or .h5 file, and '{path.name}' is none"
        )
    if options.image_orientation is not None and suffix not in SEQUENCES:
        raise ScanError(
            f"--image-orientation says how the images of a PLUS sequence lie, and '{path.name}'"
            " is none"
        )
