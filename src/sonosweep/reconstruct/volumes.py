"""The volumes of a scan: B-mode and every companion, on one grid, from one trajectory."""

import math
from dataclasses import dataclass
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from sonosweep.errors import ScanError
from sonosweep.estimators.estimator import Progress
from sonosweep.reconstruct.clip import Fan
from sonosweep.reconstruct.companions import image_companions
from sonosweep.reconstruct.compound import Method, compound_frames
from sonosweep.reconstruct.fill import FillMethod
from sonosweep.reconstruct.forward import Compounding, Interpolation
from sonosweep.reconstruct.grid import grid_of_sweep
from sonosweep.scan import Companion, Scan, Trajectory, Volume, VolumeGrid, pixel_to_image

B_MODE = "b_mode"
MOST_VOXELS_BY_DEFAULT = 64e6  # a file of 64 MB, quick to make, to load and to turn


@dataclass(frozen=True)
class VolumeSettings:
    """How to make volumes.

    Attributes:
        voxel_mm: Size of a voxel, one for all axes or one each; ``None`` chooses twice the
            pixel, or larger so that the volume stays below 64 million voxels.
        grid: Where the voxels are, instead of the box that holds the sweep.
        oriented: Whether to turn the box with the sweep.
        interpolation: PLUS's forward interpolation; ``None`` with ``compounding`` ``None``
            takes the gather engine.
        compounding: PLUS's compounding; ``None`` as above.
        rectangle_px: Use only this ``(column, row, width, height)`` of each frame.
        fan: Use only this sector.
        reject_below: Leave out darker pixels.
        skip: Use every so many frames.
        fill: How to fill holes; not at all if ``None``.
        fill_mm: Width of the widest hole to fill; nine voxels if ``None``.
        radius_mm: Of the gather: how far from its plane a frame counts; ``None`` adapts it
            to the gap between frames.
        threads: As many as there are cores if ``None``.
    """

    voxel_mm: float | tuple[float, float, float] | None = None
    grid: VolumeGrid | None = None
    oriented: bool = False
    interpolation: Interpolation | None = None
    compounding: Compounding | None = None
    rectangle_px: tuple[int, int, int, int] | None = None
    fan: Fan | None = None
    reject_below: float | None = None
    skip: int = 1
    fill: FillMethod | None = None
    fill_mm: float | None = None
    radius_mm: float | None = None
    threads: int | None = None


def reconstruct_scan(
    scan: Scan,
    trajectory: Trajectory,
    settings: VolumeSettings | None = None,
    progress: Progress | None = None,
) -> dict[str, Volume]:
    """Return the B-mode volume (``"b_mode"``) and one per companion, all on one grid.

    Companions that are no images, such as IQ, are left out, see
    :func:`sonosweep.reconstruct.companions.left_out`.

    Args:
        scan: What was recorded, with its pixel spacing.
        trajectory: One pose for each of its frames.
        settings: How; the defaults adapt to the scan.
        progress: Called with (done, total), once over for each volume.

    Raises:
        ScanError: If the scan has no pixel spacing, counts differ, or the volume is too
            large for the memory.
    """
    chosen = settings or VolumeSettings()
    poses = trajectory.image_to_reference
    pixels = _pixel_to_image(scan)
    if len(poses) != len(scan.frames):
        raise ScanError(
            f"{len(scan.frames)} frames in '{scan.name}' but {len(poses)} poses in the trajectory"
        )
    grid = chosen.grid or sweep_grid(scan, trajectory, chosen)
    into_grid = partial(
        compound_frames,
        image_to_reference=poses,
        grid=grid,
        method=engine(chosen),
        interpolation=chosen.interpolation or "nearest",
        compounding=chosen.compounding or "mean",
        skip=chosen.skip,
        radius_mm=chosen.radius_mm or "auto",
        fill=chosen.fill,
        fill_mm=chosen.fill_mm,
        threads=chosen.threads,
        progress=progress,
    )
    mask = None if scan.region is None else scan.region.mask
    volumes = {
        B_MODE: into_grid(
            scan.frames,
            pixel_to_image=pixels,
            rectangle_px=_rectangle(scan, chosen),
            fan=chosen.fan,
            mask=mask,
            reject_below=chosen.reject_below,
        )
    }
    coverage = volumes[B_MODE].coverage
    if coverage is not None and not coverage.any():
        raise ScanError(
            f"nothing of '{scan.name}' is left in the volume: are the clips or the darkest gray"
            " level that counts (--reject-below) too narrow?"
        )
    for name, companion in image_companions(scan).items():
        volumes[name] = into_grid(companion.frames, pixel_to_image=_companion_to_image(companion))
    return volumes


def engine(settings: VolumeSettings) -> Method:
    """Return the engine that is meant: forward if a word of PLUS's forward way was given."""
    gathers = settings.interpolation is None and settings.compounding is None
    return "gather" if gathers else "forward"


def sweep_grid(scan: Scan, trajectory: Trajectory, settings: VolumeSettings) -> VolumeGrid:
    """Return the grid that holds the sweep, with the voxel size chosen if none is given."""
    rows, columns = scan.frames.shape[1:3]
    rectangle = _rectangle(scan, settings)
    pixels = _pixel_to_image(scan)

    def box(voxel_mm: float | tuple[float, float, float]) -> VolumeGrid:
        return grid_of_sweep(
            trajectory.image_to_reference,
            pixels,
            rows,
            columns,
            voxel_mm,
            rectangle,
            settings.oriented,
        )

    if settings.voxel_mm is not None:
        return box(settings.voxel_mm)
    assert scan.calibration is not None
    twice_the_pixel = _two_digits(sum(scan.calibration.spacing_mm))
    voxels = math.prod(box(twice_the_pixel).size)
    if voxels <= MOST_VOXELS_BY_DEFAULT:
        return box(twice_the_pixel)
    return box(_two_digits(twice_the_pixel * (voxels / MOST_VOXELS_BY_DEFAULT) ** (1 / 3)))


def _rectangle(scan: Scan, settings: VolumeSettings) -> tuple[int, int, int, int] | None:
    """Return the part of a frame to use: what was asked for, else where the image is."""
    if settings.rectangle_px is not None or scan.region is None:
        return settings.rectangle_px
    return scan.region.rectangle_px


def _two_digits(value: float) -> float:
    """Round up to two significant digits, for voxel sizes that people can say."""
    unit = 10.0 ** (math.floor(math.log10(value)) - 1)
    return round(math.ceil(value / unit - 1e-9) * unit, 12)


def _pixel_to_image(scan: Scan) -> Float[Tensor, "4 4"]:
    if scan.calibration is None:
        reason = scan.notes.get("calibration", "the file does not say")
        raise ScanError(
            f"the pixel size of '{scan.name}' is not known ({reason}): give it with"
            " --pixel-spacing LATERAL AXIAL in mm"
        )
    return pixel_to_image(scan.calibration)


def _companion_to_image(companion: Companion) -> Float[Tensor, "4 4"]:
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[0, 0], matrix[1, 1] = companion.spacing_mm
    matrix[0, 3], matrix[1, 3] = companion.origin_mm
    return matrix
