"""PLUS device-set files (XML): fixed transforms, and how a volume is to be made.

Two elements concern us: ``CoordinateDefinitions``, whose ``Transform`` elements hold what a
calibration found (``ImageToProbe`` with the pixel size in its columns), and
``VolumeReconstruction``. The file may come from anyone: document type declarations, and with
them entities, are refused.
"""

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from math import isfinite
from pathlib import Path
from typing import Any, Literal
from xml.etree.ElementTree import Element

import torch
from jaxtyping import Float
from torch import Tensor

from sonosweep.errors import FormatError
from sonosweep.io.safe_xml import parse_xml
from sonosweep.scan import Calibration, calibration_from_matrix

# PLUS's own largest configuration is below 100 kB.
LARGEST_FILE_MB = 16
HoleFillingType = Literal[
    "GAUSSIAN", "GAUSSIAN_ACCUMULATION", "NEAREST_NEIGHBOR", "DISTANCE_WEIGHT_INVERSE", "STICK"
]


@dataclass(frozen=True)
class HoleFillingStep:
    """One way to fill holes; steps are tried in order until one fills the voxel.

    Attributes:
        type: PLUS's word for it.
        size: Edge of the kernel in voxels; 0 if it has none.
        standard_deviation: Of a Gaussian, in voxels.
        minimum_known_ratio: Part of the kernel's voxels that must be known.
        stick_length_limit: Longest gap in voxels that a stick may cross.
        sticks: How many of the shortest sticks are averaged.
    """

    type: HoleFillingType
    size: int = 0
    standard_deviation: float = 1.0
    minimum_known_ratio: float = 0.5
    stick_length_limit: int = 9
    sticks: int = 1


@dataclass(frozen=True)
class VolumeReconstructionSettings:
    """PLUS's ``VolumeReconstruction`` element; defaults are PLUS's.

    Attributes:
        output_spacing_mm: Voxel size.
        output_origin_mm: Corner of the volume in the reference; ``None`` to find it.
        output_extent: First and last voxel along x, y and z; ``None`` to find them.
        clip_origin_px: First column and row to use, in the MF-oriented image.
        clip_size_px: Columns and rows to use; ``None`` for all.
        fan_angles_deg: Sector of a curved probe, measured from straight down; ``None`` for no
            fan.
        fan_origin_px: Column and row of the sector's apex.
        fan_radius_px: Where the sector starts and stops, from the apex.
        detect_fan_angles: Whether to leave out dark sectors (poor contact).
        fan_brightness_threshold: Grey level below which a sector counts as dark.
        fan_filter_radius_px: Radius of the smoothing before that.
        pixel_rejection_threshold: Grey level below which pixels are left out; ``None`` to use
            all.
        skip_interval: Use every n-th frame.
        interpolation: How a pixel is spread over voxels.
        compounding: What a voxel does with several pixels.
        importance_mask: Weight image for ``"importance_mask"``, as named in the file.
        fill_holes: Whether to fill voxels that no pixel reached.
        hole_filling: How, in order.
        number_of_threads: 0 for all.
        image_system: Name of the image's coordinate system.
        reference_system: Name of the volume's coordinate system.
    """

    output_spacing_mm: tuple[float, float, float]
    output_origin_mm: tuple[float, float, float] | None = None
    output_extent: tuple[int, int, int, int, int, int] | None = None
    clip_origin_px: tuple[int, int] = (0, 0)
    clip_size_px: tuple[int, int] | None = None
    fan_angles_deg: tuple[float, float] | None = None
    fan_origin_px: tuple[float, float] = (0.0, 0.0)
    fan_radius_px: tuple[float, float] = (0.0, 500.0)
    detect_fan_angles: bool = False
    fan_brightness_threshold: float = 30.0
    fan_filter_radius_px: int = 10
    pixel_rejection_threshold: float | None = None
    skip_interval: int = 1
    interpolation: Literal["nearest", "linear"] = "nearest"
    compounding: Literal["mean", "latest", "maximum", "importance_mask"] = "mean"
    importance_mask: str | None = None
    fill_holes: bool = False
    hole_filling: tuple[HoleFillingStep, ...] = ()
    number_of_threads: int = 0
    image_system: str = "Image"
    reference_system: str = "Reference"


@dataclass(frozen=True, eq=False)
class PlusConfig:
    """What a PLUS configuration says about geometry and reconstruction.

    Attributes:
        path: The file.
        transforms: Fixed From-to-To matrices by the systems they map from and to.
        reconstruction: How to make the volume; ``None`` if the file does not say.
        ignored: Attributes and elements of the reconstruction that have no effect here.
    """

    path: Path
    transforms: Mapping[tuple[str, str], Float[Tensor, "4 4"]]
    reconstruction: VolumeReconstructionSettings | None = None
    ignored: tuple[str, ...] = field(default=())

    @property
    def calibration(self) -> Calibration | None:
        """Pixel size and place of the image on the probe, if the file holds ImageToProbe."""
        matrix = self.transforms.get(("Image", "Probe"))
        return None if matrix is None else calibration_from_matrix(matrix)


def read_plus_config(path: str | os.PathLike) -> PlusConfig:
    """Return the transforms and the reconstruction settings of a PLUS configuration.

    Raises:
        FormatError: If it is no XML, declares a document type, or holds a value that cannot
            be.
    """
    path = Path(path)
    root = parse_xml(path, "PLUS configuration", LARGEST_FILE_MB)
    transforms = {}
    for element in root.iterfind(".//CoordinateDefinitions/Transform"):
        key, matrix = _read_transform(element, path)
        transforms[key] = matrix
    found = root.find(".//VolumeReconstruction")
    if root.tag == "VolumeReconstruction":
        found = root
    if not transforms and found is None:
        raise FormatError(
            f"'{path}' is no PLUS configuration: it has neither CoordinateDefinitions nor"
            " VolumeReconstruction"
        )
    if found is None:
        return PlusConfig(path, transforms)
    settings, ignored = _read_reconstruction(found, path)
    return PlusConfig(path, transforms, settings, ignored)


def _read_transform(element: Element, path: Path) -> tuple[tuple[str, str], Tensor]:
    names = element.get("From", ""), element.get("To", "")
    if not all(names):
        raise FormatError(f"a Transform in '{path}' lacks From or To")
    numbers = _floats(16)(element.get("Matrix", ""))
    matrix = None if numbers is None else torch.tensor(numbers, dtype=torch.float64).reshape(4, 4)
    if matrix is None or matrix[3].tolist() != [0, 0, 0, 1] or float(torch.det(matrix)) == 0:
        raise FormatError(
            f"the matrix of {names[0]}To{names[1]} in '{path}' must be 16 numbers that end with"
            f" 0 0 0 1 and can be inverted, got '{element.get('Matrix', '')[:80]}'"
        )
    return names, matrix


def _floats(count: int) -> Callable[[str], tuple[float, ...] | None]:
    """Return a reader of exactly ``count`` finite numbers; it gives ``None`` for anything else."""

    def read(text: str) -> tuple[float, ...] | None:
        try:
            numbers = tuple(float(word) for word in text.split())
        except ValueError:
            return None
        return numbers if len(numbers) == count and all(map(isfinite, numbers)) else None

    return read


def _ints(count: int) -> Callable[[str], tuple[int, ...] | None]:
    def read(text: str) -> tuple[int, ...] | None:
        numbers = _floats(count)(text)
        whole = numbers is not None and all(number == int(number) for number in numbers)
        return tuple(int(number) for number in numbers) if numbers is not None and whole else None

    return read


def _one(read: Callable[[str], tuple | None]) -> Callable[[str], Any]:
    """Return a reader of one number; its type is that of the tuple's entries."""

    def first(text: str) -> Any:  # int or float, as ``read`` gives
        numbers = read(text)
        return None if numbers is None else numbers[0]

    return first


def _switch(text: str) -> bool | None:
    return {"ON": True, "TRUE": True, "1": True, "OFF": False, "FALSE": False, "0": False}.get(
        text.strip().upper()
    )


def _word(choices: Mapping[str, str]) -> Callable[[str], str | None]:
    return lambda text: choices.get(text.strip().upper())


FLOAT, INT = _one(_floats(1)), _one(_ints(1))
# Attribute, our field, how to read it. An old name stands before the new one, which wins.
ATTRIBUTES: tuple[tuple[str, str, Callable[[str], Any]], ...] = (
    ("ImageCoordinateFrame", "image_system", str),
    ("ReferenceCoordinateFrame", "reference_system", str),
    ("OutputSpacing", "output_spacing_mm", _floats(3)),
    ("OutputOrigin", "output_origin_mm", _floats(3)),
    ("OutputExtent", "output_extent", _ints(6)),
    ("ClipRectangleOrigin", "clip_origin_px", _ints(2)),
    ("ClipRectangleSize", "clip_size_px", _ints(2)),
    ("FanAngles", "fan_angles_deg", _floats(2)),
    ("FanAnglesDeg", "fan_angles_deg", _floats(2)),
    ("FanOrigin", "fan_origin_px", _floats(2)),
    ("FanOriginPixel", "fan_origin_px", _floats(2)),
    ("FanRadiusStartPixel", "fan_start", FLOAT),
    ("FanDepth", "fan_stop", FLOAT),
    ("FanRadiusStopPixel", "fan_stop", FLOAT),
    ("EnableFanAnglesAutoDetect", "detect_fan_angles", _switch),
    ("FanAnglesAutoDetectBrightnessThreshold", "fan_brightness_threshold", FLOAT),
    ("FanAnglesAutoDetectFilterRadiusPixel", "fan_filter_radius_px", INT),
    ("PixelRejectionThreshold", "pixel_rejection_threshold", FLOAT),
    ("SkipInterval", "skip_interval", INT),
    (
        "Interpolation",
        "interpolation",
        _word({"NEAREST_NEIGHBOR": "nearest", "LINEAR": "linear"}),
    ),
    ("Compounding", "compounding", _word({"ON": "mean", "OFF": "latest"})),
    # A weighted average is what Compounding already says.
    ("Calculation", "calculation", _word({"WEIGHTED_AVERAGE": "", "MAXIMUM": "maximum"})),
    (
        "CompoundingMode",
        "compounding_mode",
        _word(
            {
                "MEAN": "mean",
                "LATEST": "latest",
                "MAXIMUM": "maximum",
                "IMPORTANCE_MASK": "importance_mask",
            }
        ),
    ),
    ("ImportanceMaskFilename", "importance_mask", str),
    ("FillHoles", "fill_holes", _switch),
    ("NumberOfThreads", "number_of_threads", INT),
)
HOLE_FILLING_ATTRIBUTES: tuple[tuple[str, str, Callable[[str], Any]], ...] = (
    (
        "Type",
        "type",
        _word(
            {
                word: word
                for word in (
                    "GAUSSIAN",
                    "GAUSSIAN_ACCUMULATION",
                    "NEAREST_NEIGHBOR",
                    "DISTANCE_WEIGHT_INVERSE",
                    "STICK",
                )
            }
        ),
    ),
    ("Size", "size", INT),
    ("Stdev", "standard_deviation", FLOAT),
    ("MinimumKnownVoxelsRatio", "minimum_known_ratio", FLOAT),
    ("StickLengthLimit", "stick_length_limit", INT),
    ("NumberOfSticksToUse", "sticks", INT),
)
# Speed only: the result is the same.
WITHOUT_EFFECT = ("Optimization",)


def _read_attributes(
    element: Element, table: tuple[tuple[str, str, Callable[[str], Any]], ...], path: Path
) -> dict[str, Any]:
    """Return the values of an element by our names; the types are those of the table."""
    values = {}
    for name, ours, read in table:
        text = element.get(name)
        if text is None:
            continue
        value = read(text)
        if value is None:
            raise FormatError(f"{name}='{text[:60]}' of {element.tag} in '{path}' makes no sense")
        values[ours] = value
    return values


def _read_reconstruction(
    element: Element, path: Path
) -> tuple[VolumeReconstructionSettings, tuple[str, ...]]:
    values = _read_attributes(element, ATTRIBUTES, path)
    if "output_spacing_mm" not in values:
        raise FormatError(
            f"VolumeReconstruction in '{path}' has no OutputSpacing, which is required"
        )
    default = VolumeReconstructionSettings.fan_radius_px
    values["fan_radius_px"] = (
        values.pop("fan_start", default[0]),
        values.pop("fan_stop", default[1]),
    )
    old = values.pop("calculation", "") or values.get("compounding", "mean")
    values["compounding"] = values.pop("compounding_mode", old)
    # PLUS writes zeros for "not used".
    for name in ("clip_size_px", "fan_angles_deg"):
        if not any(values.get(name, ())):
            values[name] = None
    values["skip_interval"] = max(1, values.get("skip_interval", 1))
    values["hole_filling"] = tuple(
        HoleFillingStep(**_read_attributes(_with_type(step, path), HOLE_FILLING_ATTRIBUTES, path))
        for step in element.iterfind("./HoleFilling/HoleFillingElement")
    )
    _check_settings(values, path)
    known = {name for name, _, _ in ATTRIBUTES}.union(WITHOUT_EFFECT)
    ignored = [name for name in element.attrib if name not in known]
    ignored += [f"<{child.tag}>" for child in element if child.tag != "HoleFilling"]
    return VolumeReconstructionSettings(**values), tuple(ignored)


def _with_type(step: Element, path: Path) -> Element:
    if step.get("Type") is None:
        raise FormatError(f"a HoleFillingElement in '{path}' has no Type")
    return step


def _check_settings(values: Mapping[str, Any], path: Path) -> None:
    """Refuse numbers that are numbers but cannot be.

    Raises:
        FormatError: If one cannot.
    """
    if min(values["output_spacing_mm"]) <= 0:
        raise FormatError(f"OutputSpacing in '{path}' must be above 0 mm")
    if values["clip_size_px"] is not None and min(values["clip_size_px"]) <= 0:
        raise FormatError(f"ClipRectangleSize in '{path}' must be above 0 pixels, or 0 0 for all")
    angles = values["fan_angles_deg"]
    if angles is not None and not -180 <= angles[0] < angles[1] <= 180:
        raise FormatError(f"FanAnglesDeg in '{path}' must rise from left to right, got {angles}")
    start, stop = values["fan_radius_px"]
    if not 0 <= start < stop:
        raise FormatError(f"the fan in '{path}' stops at {stop:g} pixels but starts at {start:g}")
    extent = values.get("output_extent")
    if extent is not None and any(a > b for a, b in zip(extent[::2], extent[1::2], strict=True)):
        raise FormatError(f"OutputExtent in '{path}' ends before it starts: {extent}")
    if values.get("fill_holes", False):
        _check_hole_filling(values["hole_filling"], path)


def _check_hole_filling(steps: tuple[HoleFillingStep, ...], path: Path) -> None:
    if not steps:
        raise FormatError(f"'{path}' fills holes but has no HoleFillingElement that says how")
    for step in steps:
        if step.type != "STICK" and not 0 < step.size <= 99:
            raise FormatError(
                f"HoleFillingElement {step.type} in '{path}' needs a Size of 1 to 99 voxels"
            )
