"""Write scans, trajectories and sequences as files that PLUS, IGSIO and 3D Slicer read.

The poses of a scan go out as ``ImageToReferenceTransform`` in PLUS's sense, from pixels to
millimetres: its first two columns hold the pixel size, and the third points along x cross y
with their mean, since 3D Slicer shows a sheared slab otherwise. What PLUS has no word for
goes into header fields of our own, which others pass over.
"""

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sonosweep.errors import FormatError, ScanError
from sonosweep.io.atomic import write_beside
from sonosweep.io.image_orientation import turn_to
from sonosweep.io.metaimage_header import (
    LONGEST_WRITTEN_LINE,
    OWN_PREFIX,
    element_type,
    numbers_text,
    own_fields,
    write_header_and_pixels,
    write_pixels,
)
from sonosweep.io.sequence import Sequence
from sonosweep.io.sequence_fields import FrameFields, FrameTransforms, format_frame_fields
from sonosweep.io.sequence_nrrd import VALUE_TYPES
from sonosweep.scan import Calibration, Frames, Scan, Trajectory, pixel_to_image

# IGSIO counts the bytes of all frames in 32 bits.
LARGEST_PIXELS_BYTES = 4 << 30
IMAGE_TO_REFERENCE = ("Image", "Reference")
NOT_TRACKED = "INVALID"


def write_sequence(
    what: Scan | Trajectory | Sequence, path: str | os.PathLike, compress: bool = True
) -> None:
    """Write a scan, a trajectory or a sequence as a sequence file.

    A trajectory is written as a file of transforms without images, which needs ``.mha``.
    Companions and the mask of a region are not written: these formats have no place for them.

    Args:
        what: What to write; frames are read one after the other.
        path: Where to. The suffix chooses the format: ``.mha`` (name it ``.igs.mha`` for 3D
            Slicer), ``.mhd`` with the pixels in a second file, ``.nrrd`` with IGSIO's fields,
            ``.seq.nrrd`` with those of core 3D Slicer as well.
        compress: Whether to compress the pixels.

    Raises:
        FormatError: If the suffix is another or the file cannot be written.
        ScanError: If there are more than 4 GiB of pixels, pixels of a type the formats lack,
            or poses without a pixel size.
    """
    path = Path(path)
    sequence = _as_sequence(what)
    _check_pixels(sequence, path)
    suffix = path.suffix.lower()
    if suffix == ".mha":
        with write_beside(path) as temporary, temporary.open("wb") as file:
            _write_mha(sequence, file, compress)
    elif suffix == ".mhd" and sequence.frames is not None:
        _write_mhd(sequence, path, compress)
    elif suffix == ".nrrd" and sequence.frames is not None:
        with write_beside(path) as temporary, temporary.open("wb") as file:
            _write_nrrd(sequence, file, compress, path.name.lower().endswith(".seq.nrrd"))
    elif suffix in (".mhd", ".nrrd"):
        raise FormatError(f"cannot write '{path}': transforms without images need .igs.mha")
    else:
        raise FormatError(
            f"cannot write '{path}': a sequence's name ends with .igs.mha, .mhd, .igs.nrrd or"
            " .seq.nrrd"
        )


def _as_sequence(what: Scan | Trajectory | Sequence) -> Sequence:
    if isinstance(what, Scan):
        return sequence_from_scan(what)
    return sequence_from_trajectory(what) if isinstance(what, Trajectory) else what


def sequence_from_scan(scan: Scan) -> Sequence:
    """Return a scan in PLUS's terms.

    Raises:
        ScanError: If it has poses but no pixel size.
    """
    own: dict[str, str] = {}
    static, transforms = {}, {}
    calibration = scan.calibration
    if calibration is not None:
        own = _calibration_settings(calibration)
        if calibration.image_to_probe is not None:
            static[("Image", "Probe")] = calibration.image_to_probe @ _pixel_scale(calibration)
    if scan.image_to_reference is not None:
        if calibration is None:
            raise ScanError(
                f"'{scan.name}' has poses but no pixel size, which PLUS's ImageToReference"
                " holds: give the pixel spacing"
            )
        tracked = torch.isfinite(scan.image_to_reference).flatten(1).all(1)
        tracked = tracked if scan.tracked is None else tracked & scan.tracked
        matrices = scan.image_to_reference @ _pixel_scale(calibration)
        transforms[IMAGE_TO_REFERENCE] = _frame_transforms(matrices, tracked)
    if scan.subject is not None:
        own["subject"] = scan.subject
    if scan.region is not None:
        own["region_px"] = " ".join(map(str, scan.region.rectangle_px))
    return Sequence(
        name=scan.name,
        count=len(scan.frames),
        frames=scan.frames,
        transforms=transforms,
        static_transforms=static,
        timestamps_s=scan.timestamps_s,
        image_type="RGB_COLOR" if scan.frames.shape[3:] == (3,) else "BRIGHTNESS",
        header=own_fields(own),
    )


def sequence_from_trajectory(trajectory: Trajectory) -> Sequence:
    """Return a trajectory in PLUS's terms: transforms without images.

    ``ImageToReference`` is rigid here, from image millimetres: there are no pixels to scale.
    """
    count = len(trajectory.image_to_reference)
    own = {"method": trajectory.method}
    own |= {f"assumption_{k}": text for k, text in enumerate(trajectory.assumptions)}
    own |= {f"setting_{name}": text for name, text in trajectory.settings.items()}
    fields = {}
    if trajectory.step_std is not None:
        rows = [numbers_text(row) for row in trajectory.step_std.tolist()]
        fields["NextStepStd"] = (*rows, "")
    everywhere = torch.ones(count, dtype=torch.bool)
    return Sequence(
        name="trajectory",
        count=count,
        frames=None,
        transforms={
            IMAGE_TO_REFERENCE: _frame_transforms(trajectory.image_to_reference, everywhere)
        },
        timestamps_s=trajectory.timestamps_s,
        image_valid=~everywhere,
        frame_fields=fields,
        header=own_fields(own),
    )


def _calibration_settings(calibration: Calibration) -> dict[str, str]:
    """Return what the transforms do not hold, or hold only for tracked scans."""
    return {
        "spacing_mm": numbers_text(calibration.spacing_mm),
        "shear": numbers_text([calibration.shear]),
        "latency_s": numbers_text([calibration.latency_s]),
        "pixel_axes": calibration.pixel_axes,
        "pixel_origin": str(calibration.pixel_origin),
    }


def _pixel_scale(calibration: Calibration) -> Float[Tensor, "4 4"]:
    """Return pixel to image with a third axis as long as a mean pixel."""
    scale = pixel_to_image(calibration)
    scale[2, 2] = sum(calibration.spacing_mm) / 2
    return scale


def _frame_transforms(
    matrices: Float[Tensor, "frames 4 4"], tracked: Bool[Tensor, " frames"]
) -> FrameTransforms:
    statuses = tuple("OK" if seen else NOT_TRACKED for seen in tracked.tolist())
    return FrameTransforms(matrices.to(torch.float64), statuses)


def _check_pixels(sequence: Sequence, path: Path) -> None:
    if sequence.frames is None:
        return
    shape, dtype = sequence.frames.shape, np.dtype(sequence.frames.dtype)
    frame_bytes = int(np.prod(shape[1:], dtype=object)) * dtype.itemsize
    if frame_bytes * shape[0] > LARGEST_PIXELS_BYTES:
        most = LARGEST_PIXELS_BYTES // frame_bytes
        raise ScanError(
            f"{shape[0]} frames of {frame_bytes / 1e6:.3g} MB are more than the 4 GiB that"
            f" readers of '{path.name}' can count: split the sweep into parts of at most {most}"
            " frames"
        )
    element_type(dtype)


def _orientation(sequence: Sequence) -> str:
    """Return how the frames lie now: they were turned on reading if it was known how."""
    wanted = "FM" if sequence.image_type.startswith("RF_") else "MF"
    return sequence.orientation if turn_to(wanted, sequence.orientation) is None else wanted


def _frame_pieces(frames: Frames) -> Iterator[np.ndarray]:
    little = np.dtype(frames.dtype).newbyteorder("<")
    for index in range(len(frames)):
        yield np.ascontiguousarray(frames[index], little)


def _metaimage_fields(sequence: Sequence, compress: bool) -> dict[str, str]:
    frames = sequence.frames
    shape = (sequence.count, 0, 0) if frames is None else frames.shape
    fields = {
        "ObjectType": "Image",
        "NDims": "3",
        "AnatomicalOrientation": "RAI",
        "BinaryData": "True",
        "BinaryDataByteOrderMSB": "False",
        "CenterOfRotation": "0 0 0",
        "CompressedData": str(compress),
        "DimSize": f"{shape[2]} {shape[1]} {shape[0]}",
        "Kinds": "domain domain list",
        "ElementNumberOfChannels": str(shape[3] if len(shape) == 4 else 1),
        "ElementSpacing": "1 1 1",
        "ElementType": "MET_UCHAR" if frames is None else element_type(np.dtype(frames.dtype)),
        "Offset": "0 0 0",
        "TransformMatrix": "1 0 0 0 1 0 0 0 1",
        "UltrasoundImageOrientation": _orientation(sequence),
        "UltrasoundImageType": sequence.image_type,
    }
    return {**fields, **_described(sequence, "ImageStatus")}


def _described(sequence: Sequence, image_status: str) -> dict[str, str]:
    """Return the fields of the file and of its frames.

    Raises:
        ScanError: If a line is longer than readers take.
    """
    valid = sequence.image_valid
    if valid is None:
        valid = torch.ones(sequence.count, dtype=torch.bool)
    parts = FrameFields(sequence.transforms, sequence.timestamps_s, valid, sequence.frame_fields)
    header = dict(sequence.header)
    if sequence.spacing_mm is not None:
        header.setdefault(OWN_PREFIX + "spacing_mm", numbers_text(sequence.spacing_mm))
    for (a, b), matrix in sequence.static_transforms.items():
        header[f"{a}To{b}Transform"] = numbers_text(matrix.flatten().tolist())
    fields = {**header, **format_frame_fields(parts, image_status)}
    for name, value in fields.items():
        if len(f"{name} = {value}".encode()) > LONGEST_WRITTEN_LINE or "\n" in value:
            raise ScanError(
                f"{name} of '{sequence.name}' does not fit into a line of {LONGEST_WRITTEN_LINE}"
                f" bytes: shorten '{value[:40]}...'"
            )
    return fields


def _write_mha(sequence: Sequence, file: IO[bytes], compress: bool) -> None:
    compress = compress and sequence.frames is not None
    pieces = iter(()) if sequence.frames is None else _frame_pieces(sequence.frames)
    write_header_and_pixels(file, _metaimage_fields(sequence, compress), pieces, compress)


def _write_mhd(sequence: Sequence, path: Path, compress: bool) -> None:
    """Write the pixels first, so that a header never lacks them."""
    assert sequence.frames is not None
    pixels = path.with_suffix(".zraw" if compress else ".raw")
    fields = _metaimage_fields(sequence, compress)
    with write_beside(pixels) as temporary, temporary.open("wb") as file:
        write_pixels(file, _frame_pieces(sequence.frames), compress)
        length = file.tell()
    if compress:
        fields["CompressedDataSize"] = str(length)
    fields["ElementDataFile"] = pixels.name
    text = "".join(f"{name} = {value}\n" for name, value in fields.items())
    with write_beside(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")


def _write_nrrd(sequence: Sequence, file: IO[bytes], compress: bool, for_slicer: bool) -> None:
    frames = sequence.frames
    assert frames is not None
    lines = ["NRRD0004", *_nrrd_axes(sequence, frames.shape, for_slicer)]
    lines += [f"type: {_nrrd_type(np.dtype(frames.dtype))}", "endian: little"]
    lines.append(f"encoding: {'gz' if compress else 'raw'}")
    keys: Mapping[str, str] = {
        "ultrasound image orientation": _orientation(sequence),
        "ultrasound image type": sequence.image_type,
        **(_slicer_keys(sequence, len(frames.shape)) if for_slicer else {}),
        **_described(sequence, "Status"),
    }
    lines += [f"{name}:={value}" for name, value in keys.items()]
    file.write("\n".join([*lines, "", ""]).encode())
    write_pixels(file, _frame_pieces(frames), compress, gzip=True)


def _nrrd_axes(sequence: Sequence, shape: tuple[int, ...], for_slicer: bool) -> list[str]:
    """Return size, kind and direction of each axis; core Slicer wants volumes of one slice."""
    count, rows, columns, *channels = shape
    spatial = (columns, rows, 1) if for_slicer else (columns, rows)
    n = len(spatial)
    x, y = _slicer_spacing(sequence) if for_slicer else (1.0, 1.0)
    directions = [
        "(" + ",".join(numbers_text([step if a == b else 0.0]) for b in range(n)) + ")"
        for a, step in zip(range(n), (x, y, (x + y) / 2), strict=False)
    ]
    vector = ["vector"] if channels else []
    none = ["none"] if channels else []
    return [
        f"dimension: {len(channels) + n + 1}",
        "space: left-posterior-superior" if for_slicer else "space dimension: 2",
        f"sizes: {' '.join(map(str, (*channels, *spatial, count)))}",
        f"space directions: {' '.join((*none, *directions, 'none'))}",
        f"kinds: {' '.join((*vector, *['domain'] * n, 'list'))}",
        f"space origin: ({','.join(['0'] * n)})",
    ]


def _slicer_spacing(sequence: Sequence) -> tuple[float, float]:
    words = sequence.header.get(OWN_PREFIX + "spacing_mm", "1 1").split()
    return sequence.spacing_mm or (float(words[0]), float(words[1]))


def _slicer_keys(sequence: Sequence, axis: int) -> dict[str, str]:
    """Return core Slicer's keys; without times the frames are numbered, as text."""
    times = sequence.timestamps_s
    known = times is not None and bool(torch.isfinite(times).all())
    values = times.tolist() if times is not None and known else map(float, range(sequence.count))
    colour = axis == 4
    return {
        "DataNodeClassName": "vtkMRMLVectorVolumeNode" if colour else "vtkMRMLScalarVolumeNode",
        f"axis {axis} index type": "numeric" if known else "text",
        f"axis {axis} index values": numbers_text(values),
    }


def _nrrd_type(dtype: np.dtype) -> str:
    # "unsigned char" and its like: the words that every reader knows.
    return VALUE_TYPES[dtype.str[1:]][0]
