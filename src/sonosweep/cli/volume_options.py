"""Options that say how volumes are made, in PLUS's words."""

import math
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Group, Parameter

from sonosweep.cli.whole_number import WHOLE

if TYPE_CHECKING:
    from sonosweep.io.plus_config import PlusConfig, VolumeReconstructionSettings
    from sonosweep.reconstruct import VolumeSettings
    from sonosweep.scan import VolumeGrid

DEFAULT_FAN_RADIUS_PX = (0.0, 500.0)  # PLUS's
VOLUME = Group("Volume", sort_key=2)


@Parameter(name="*", group=VOLUME)
@dataclass(frozen=True)
class VolumeOptions:
    """How to make volumes.

    Attributes:
        voxel_mm: Size of a voxel; twice the pixel otherwise.
        interpolation: PLUS's forward interpolation; without it and --compounding, voxels
            gather from the frames near them, which leaves no holes.
        compounding: What a voxel makes of the pixels that fall into it, forward.
        fill_holes: Fill holes up to nine voxels wide (sticks, as PLUS).
        clip_rectangle: Part of the frame to use: column, row, width, height in pixels.
        fan_angles_deg: Sector to use: left and right edge from straight down.
        fan_origin_px: Column and row where the sector's edges meet.
        fan_radius_px: Radii where the sector starts and stops.
        reject_below: Leave out darker pixels.
        skip_interval: Use every so many frames.
        oriented: Turn the volume's box with the sweep; it is smaller then.
        threads: As many as there are cores otherwise; the result is the same.
    """

    voxel_mm: float | None = None
    interpolation: Literal["nearest", "linear"] | None = None
    compounding: Literal["mean", "latest", "maximum", "median"] | None = None
    fill_holes: bool | None = None
    clip_rectangle: tuple[int, int, int, int] | None = None
    fan_angles_deg: tuple[float, float] | None = None
    fan_origin_px: tuple[float, float] | None = None
    fan_radius_px: tuple[float, float] | None = None
    reject_below: float | None = None
    skip_interval: Annotated[int | None, WHOLE] = None
    oriented: bool = False
    threads: Annotated[int | None, WHOLE] = None


def volume_settings(options: VolumeOptions, config: "PlusConfig | None") -> "VolumeSettings":
    """Return the settings of a PLUS configuration, if any, with the options on top.

    Raises:
        ScanError: If options contradict each other.
    """
    from sonosweep.errors import ScanError
    from sonosweep.reconstruct import Fan, VolumeSettings

    settings = VolumeSettings()
    if config is not None and config.reconstruction is not None:
        settings = _from_plus(config.reconstruction)
        _say_what_is_not_followed(config.reconstruction, config.ignored, config.path)
    if (options.fan_angles_deg is None) != (options.fan_origin_px is None):
        raise ScanError("a fan needs both --fan-angles-deg and --fan-origin-px")
    if options.fan_radius_px is not None and options.fan_angles_deg is None:
        raise ScanError("--fan-radius-px needs --fan-angles-deg and --fan-origin-px too")
    if options.reject_below is not None and not math.isfinite(options.reject_below):
        raise ScanError(f"--reject-below must be a gray level, got {options.reject_below:g}")
    if options.fan_angles_deg is not None and options.fan_origin_px is not None:
        settings = replace(
            settings,
            fan=Fan(
                options.fan_angles_deg,
                options.fan_origin_px,
                *(options.fan_radius_px or DEFAULT_FAN_RADIUS_PX),
            ),
        )
    if options.fill_holes is not None:
        settings = replace(settings, fill="stick" if options.fill_holes else None, fill_mm=None)
    given: dict[str, Any] = {  # Any: each field has its own type
        "voxel_mm": options.voxel_mm,
        "interpolation": options.interpolation,
        "compounding": options.compounding,
        "rectangle_px": options.clip_rectangle,
        "reject_below": options.reject_below,
        "skip": options.skip_interval,
        "oriented": options.oriented or None,
        "threads": options.threads,
    }
    if options.voxel_mm is not None or options.oriented:
        settings = replace(settings, grid=None)
    return replace(settings, **{name: value for name, value in given.items() if value is not None})


def _from_plus(plus: "VolumeReconstructionSettings") -> "VolumeSettings":
    """Return our settings for a PLUS VolumeReconstruction element.

    Raises:
        ScanError: If it asks for what we do not have.
    """
    from sonosweep.errors import ScanError
    from sonosweep.reconstruct import Fan, VolumeSettings

    if plus.compounding == "importance_mask":
        raise ScanError(
            "CompoundingMode IMPORTANCE_MASK is not supported: use MEAN with --reject-below, or"
            " another --compounding"
        )
    fan = None
    if plus.fan_angles_deg is not None:
        fan = Fan(plus.fan_angles_deg, plus.fan_origin_px, *plus.fan_radius_px)
    rectangle = None
    if plus.clip_size_px is not None:
        rectangle = (*plus.clip_origin_px, *plus.clip_size_px)
    fill, fill_mm = _filling(plus)
    return VolumeSettings(
        voxel_mm=plus.output_spacing_mm,
        grid=_grid(plus),
        interpolation=plus.interpolation,
        compounding=plus.compounding,
        rectangle_px=rectangle,
        fan=fan,
        reject_below=plus.pixel_rejection_threshold,
        skip=plus.skip_interval,
        fill=fill,
        fill_mm=fill_mm,
        threads=plus.number_of_threads or None,
    )


def _say_what_is_not_followed(
    plus: "VolumeReconstructionSettings", unknown: tuple[str, ...], file: Path
) -> None:
    """Name on standard error what a PLUS configuration asks for and we do not do."""
    names = list(unknown)
    if plus.detect_fan_angles:
        names.append("EnableFanAnglesAutoDetect (the sector stays as FanAnglesDeg says)")
    if plus.fill_holes:
        first, *others = plus.hole_filling
        if first.type.startswith("GAUSSIAN"):
            names.append(f"{first.type} (holes are filled by inverse distance)")
        names += [f"{step.type} (only the first way to fill holes is used)" for step in others]
    if names:
        print(f"not followed from {file.name}: {', '.join(names)}", file=sys.stderr)


def _filling(
    plus: "VolumeReconstructionSettings",
) -> tuple[Literal["stick", "nearest", "inverse_distance"] | None, float | None]:
    if not plus.fill_holes or not plus.hole_filling:
        return None, None
    first, voxel = plus.hole_filling[0], max(plus.output_spacing_mm)
    if first.type == "STICK":
        return "stick", first.stick_length_limit * voxel
    if first.type == "NEAREST_NEIGHBOR":
        return "nearest", first.size * voxel
    return "inverse_distance", first.size * voxel


def _grid(plus: "VolumeReconstructionSettings") -> "VolumeGrid | None":
    """Return the grid that OutputOrigin and OutputExtent fix, if they do."""
    from sonosweep.scan import VolumeGrid

    if plus.output_extent is None:
        return None
    x0, x1, y0, y1, z0, z1 = plus.output_extent
    origin = plus.output_origin_mm or (0.0, 0.0, 0.0)
    spacing = plus.output_spacing_mm
    first = (x0, y0, z0)
    return VolumeGrid(
        size=(x1 - x0 + 1, y1 - y0 + 1, z1 - z0 + 1),
        spacing_mm=spacing,
        origin_mm=(
            origin[0] + first[0] * spacing[0],
            origin[1] + first[1] * spacing[1],
            origin[2] + first[2] * spacing[2],
        ),
    )


def describe_bytes(count: int) -> str:
    """Return a size in memory as people say it."""
    power = min(int(math.log(max(count, 1), 1000)), 3)
    return f"{count / 1000**power:.3g} {('B', 'kB', 'MB', 'GB')[power]}"
