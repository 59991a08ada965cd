"""Sequence files of PLUS, IGSIO and 3D Slicer: frames with transforms and times.

MetaImage (``.igs.mha``, ``.mha``, ``.igs.mhd``) and NRRD (``.igs.nrrd``, ``.seq.nrrd``)
carry the same fields. Per-frame transforms are millimetres as the tracker gave them, never
turned to patient axes. ``ElementSpacing`` is 1 pixel in PLUS's files and means millimetres
only where another program wrote something else.
"""

import math
import os
import re
from collections.abc import Mapping
from collections.abc import Sequence as ListLike
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sonosweep.errors import FormatError
from sonosweep.io.image_orientation import check_orientation, turn_frames, turn_to
from sonosweep.io.metaimage_header import METAIMAGE_FIELDS, OWN_PREFIX, read_metaimage_header
from sonosweep.io.pixel_data import PixelData, StoredFrames
from sonosweep.io.sequence_fields import (
    FrameTransforms,
    TransformName,
    parse_frame_fields,
    split_frame_fields,
    transform_name,
)
from sonosweep.io.sequence_nrrd import NRRD_FIELDS, read_nrrd_header
from sonosweep.scan import Frames

SUFFIXES = (".mha", ".mhd", ".nrrd", ".nhdr")
# What core Slicer says of the list axis and of the class that shows it.
SLICER_KEY = re.compile(r"axis \d+ index |DataNodeClassName")
IMAGE_TYPES = ("BRIGHTNESS", "RF_REAL", "RF_IQ_LINE", "RF_I_LINE_Q_LINE", "RGB_COLOR")


@dataclass(frozen=True, eq=False)
class Sequence:
    """What a sequence file holds, before anyone asks where the image is on the probe.

    Attributes:
        name: What to call it, usually the file's name.
        count: Number of frames, those without image included.
        frames: Images, turned to ``MF`` (RF lines to ``FM``) where the file tells how they
            were; ``None`` in a file of transforms only. Frames without image are blank.
        transforms: Per-frame transforms by the systems they map from and to.
        static_transforms: Transforms that hold for the whole file, likewise.
        timestamps_s: Time of each frame, NaN where a frame has none; ``None`` if none has.
        image_valid: Which frames hold an image; ``None`` means all of them.
        orientation: The image orientation that the file states, or the one asked for; ``""``
            if neither.
        image_type: PLUS's word, ``"BRIGHTNESS"`` for B-mode.
        spacing_mm: Distance between neighbouring columns and rows as the file states it;
            ``None`` if it states 1, which in these files means a pixel.
        frame_fields: Every other per-frame field, ``""`` where a frame has none.
        header: Every other field of the file.
    """

    name: str
    count: int
    frames: Frames | None
    transforms: Mapping[TransformName, FrameTransforms] = field(default_factory=dict)
    static_transforms: Mapping[TransformName, Float[Tensor, "4 4"]] = field(default_factory=dict)
    timestamps_s: Float[Tensor, " frames"] | None = None
    image_valid: Bool[Tensor, " frames"] | None = None
    orientation: str = "MF"
    image_type: str = "BRIGHTNESS"
    spacing_mm: tuple[float, float] | None = None
    frame_fields: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    header: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class _Stored:
    """A header in the terms that both formats share; axes in C order, channels included."""

    values: Mapping[str, str]
    shape: tuple[int, ...]
    kinds: tuple[str, ...]
    spacing: tuple[float, ...]
    pixels: PixelData | None
    orientation: str
    image_type: str
    image_status: str


def read_sequence(path: str | os.PathLike, orientation: str | None = None) -> Sequence:
    """Return a sequence file; its frames are read when indexed.

    Args:
        path: A ``.mha``, ``.mhd``, ``.nrrd`` or ``.nhdr`` file, with or without ``.igs`` or
            ``.seq`` before the suffix.
        orientation: How the images lie in the file, such as ``"UF"``, against what the file
            states.

    Raises:
        FormatError: If it is no sequence, is damaged, or not all of it is there.
        ScanError: If the orientation is none.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise FormatError(f"'{path}' is no sequence file: its name must end with one of {SUFFIXES}")
    stored = _read_metaimage(path) if suffix in (".mha", ".mhd") else _read_nrrd(path)
    kinds = stored.kinds or _default_kinds(len(stored.shape))
    axes = _frame_axes(kinds, stored.shape, path)
    of_frames, of_file = split_frame_fields(stored.values)
    count = stored.shape[axes[0]]
    if count == 0:
        raise FormatError(f"'{path}' holds no frame")
    described = {frame for texts in of_frames.values() for frame in texts}
    if stored.pixels is None and count != len(described):
        raise FormatError(
            f"'{path}' states {count} frames without images but describes {len(described)}: it was"
            " cut off or its header is wrong"
        )
    parsed = parse_frame_fields(of_frames, count, path, stored.image_status)
    static, header = _static_transforms(of_file, path)
    header = {name: value for name, value in header.items() if not SLICER_KEY.match(name)}
    words = stored.orientation if orientation is None else check_orientation(orientation)
    return Sequence(
        name=sequence_name(path),
        count=count,
        frames=_open_frames(stored, axes, words),
        transforms=parsed.transforms,
        static_transforms=static,
        timestamps_s=_index_times(of_file, stored, axes[0], count)
        if parsed.timestamps_s is None
        else parsed.timestamps_s,
        image_valid=parsed.image_valid,
        orientation=words,
        image_type=stored.image_type,
        spacing_mm=_stated_spacing(stored, axes),
        frame_fields=parsed.others,
        header=header,
    )


def sequence_name(path: Path) -> str:
    """Return a file's name without ``.igs.mha`` and its like."""
    stem = path.name[: -len(path.suffix)]
    return stem[:-4] if stem.lower().endswith((".igs", ".seq")) else stem


def _read_metaimage(path: Path) -> _Stored:
    header = read_metaimage_header(path)
    values, pixels = header.values, header.pixels
    shape = header.size[::-1] if pixels is None else pixels.shape
    kinds = tuple(word.lower() for word in reversed(values.get("Kinds", "").split()))
    if kinds and len(kinds) != len(header.size):
        raise FormatError(f"Kinds = {values['Kinds'][:60]} in '{path}': expected one per dimension")
    spacing = values.get("ElementSpacing", "").split()
    if len(header.size) == 2:
        # One image is a sequence of one frame.
        shape, kinds = (1, *shape), ()
        pixels = None if pixels is None else replace(pixels, shape=shape)
        spacing = [*spacing, "1"]
    channels = len(shape) - max(len(header.size), 3)
    if channels:
        kinds = (*(kinds or _default_kinds(len(shape) - 1)), "vector")
    # Slicer writes the type twice in a row.
    image_type = values.get("UltrasoundImageType", "BRIGHTNESS").upper()
    return _Stored(
        values={k: v for k, v in values.items() if k not in METAIMAGE_FIELDS},
        shape=shape,
        kinds=kinds,
        spacing=(*_floats(spacing)[::-1], *[math.nan] * channels),
        pixels=pixels,
        orientation=values.get("UltrasoundImageOrientation", ""),
        image_type=next((t for t in IMAGE_TYPES if image_type == 2 * t), image_type),
        image_status="ImageStatus",
    )


def _read_nrrd(path: Path) -> _Stored:
    header = read_nrrd_header(path)
    values = header.values
    return _Stored(
        values={k: v for k, v in values.items() if k not in NRRD_FIELDS},
        shape=header.size[::-1],
        kinds=tuple(kind.lower() for kind in reversed(header.kinds)),
        spacing=header.spacing[::-1],
        pixels=header.pixels,
        orientation=values.get("ultrasound image orientation", ""),
        image_type=values.get("ultrasound image type", "BRIGHTNESS").upper(),
        image_status="Status",
    )


def _floats(words: ListLike[str]) -> tuple[float, ...]:
    try:
        return tuple(float(word) for word in words)
    except ValueError:
        return ()


def _default_kinds(axes: int) -> tuple[str, ...]:
    return ("list",) + ("domain",) * (axes - 1)


def _frame_axes(kinds: tuple[str, ...], shape: tuple[int, ...], path: Path) -> tuple[int, ...]:
    """Return which stored axes are frames, rows, columns and, if any, channels."""
    lists = [axis for axis, kind in enumerate(kinds) if kind in ("list", "time")]
    spatial = [axis for axis, kind in enumerate(kinds) if kind in ("domain", "space")]
    other = [axis for axis in range(len(kinds)) if axis not in lists + spatial and shape[axis] != 1]
    if not lists and len(spatial) == 3:
        raise FormatError(
            f"'{path}' is a volume, not a sequence: none of its axes is of kind list; if its last"
            " axis counts frames, let its kinds be 'domain domain list'"
        )
    # 3D Slicer stores every frame as a volume of one slice.
    excess = [axis for axis in spatial if shape[axis] == 1][: max(len(spatial) - 2, 0)]
    spatial = [axis for axis in spatial if axis not in excess]
    if len(lists) != 1 or len(spatial) != 2 or len(other) > 1:
        raise FormatError(
            f"'{path}' is no sequence of 2D frames: its axes are {' '.join(reversed(kinds))} of"
            f" {' x '.join(map(str, reversed(shape)))}"
        )
    return (*lists, *spatial, *other)


def _open_frames(stored: _Stored, axes: tuple[int, ...], orientation: str) -> Frames | None:
    if stored.pixels is None:
        return None
    wanted = "FM" if stored.image_type.startswith("RF_") else "MF"
    return turn_frames(StoredFrames(stored.pixels, axes), turn_to(wanted, orientation))


def _stated_spacing(stored: _Stored, axes: tuple[int, ...]) -> tuple[float, float] | None:
    if len(stored.spacing) != len(stored.shape):
        return None
    rows, columns = stored.spacing[axes[1]], stored.spacing[axes[2]]
    plausible = all(math.isfinite(value) and value > 0 for value in (rows, columns))
    return (columns, rows) if plausible and (columns, rows) != (1.0, 1.0) else None


def _static_transforms(
    values: Mapping[str, str], path: Path
) -> tuple[dict[TransformName, Tensor], dict[str, str]]:
    """Return the transforms among the fields of the file, and the other fields."""
    transforms, others = {}, {}
    for name, value in values.items():
        key = transform_name(name) if name.endswith("Transform") else None
        if key is None or not key[1]:
            others[name] = value
            continue
        numbers = _floats(value.split())
        if len(numbers) != 16 or not all(map(math.isfinite, numbers)):
            raise FormatError(f"{name} in '{path}' is not 16 numbers: '{value[:80]}'")
        transforms[key] = torch.tensor(numbers, dtype=torch.float64).reshape(4, 4)
    return transforms, others


def _index_times(
    values: Mapping[str, str], stored: _Stored, frame_axis: int, count: int
) -> Float[Tensor, " frames"] | None:
    """Return the times that core Slicer keeps as the values of the list axis."""
    axis = len(stored.shape) - 1 - frame_axis
    texts = values.get(f"axis {axis} index values", "").split()
    numbers = _floats(texts)
    if values.get(f"axis {axis} index type", "numeric") != "numeric" or len(numbers) != count:
        return None
    return torch.tensor(numbers, dtype=torch.float64)


def own_header(sequence: Sequence) -> dict[str, str]:
    """Return what sonosweep wrote into a sequence beside PLUS's fields."""
    return {
        name.removeprefix(OWN_PREFIX): value
        for name, value in sequence.header.items()
        if name.startswith(OWN_PREFIX)
    }
