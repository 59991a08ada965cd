"""Our own scan file: one HDF5 file that holds everything a :class:`Scan` does.

======================== ==================================================================
``/`` attributes         ``format`` = ``"sonosweep scan"``, ``format_version`` = 1,
                         ``written_by``, ``name``, ``subject`` (if known)
``frames``               (frames, rows, columns[, channels]), chunks of one frame
``timestamps_s``         float64 (frames)
``image_to_reference``   float64 (frames, 4, 4), mm; NaN where the tracker missed a frame
``tracked``              bool (frames): which poses are valid
``calibration/``         attributes ``spacing_mm`` (lateral, axial), ``shear``,
                         ``latency_s``, ``pixel_axes``, ``pixel_origin``; data set
                         ``image_to_probe`` (4, 4) if known
``region/``              attribute ``rectangle_px`` (column, row, width, height); data set
                         ``mask`` bool (rows, columns) if it is not the whole rectangle
``companions/NAME/``     ``frames`` as above, or with two channels: real and imaginary part;
                         attributes ``spacing_mm``, ``origin_mm``
``notes``                JSON text: what the reader of the original file found, by subject
======================== ==================================================================

All but ``frames`` and the first two attributes may be absent. Text has a fixed length and is
UTF-8. Coordinates are those of
:mod:`sonosweep.scan`. Frames are not compressed unless asked: speckle saves about 10 %.
"""

import json
import os
from importlib.metadata import version
from pathlib import Path
from typing import Literal

import h5py
import numpy as np
import torch
from torch import Tensor

from sonosweep.errors import FormatError, SonosweepError
from sonosweep.io.disk_sink import DiskSink
from sonosweep.io.hdf5_access import (
    frames_from_dataset,
    get_dataset,
    open_hdf5,
    read_array,
    read_number_attribute,
    read_text_attribute,
)
from sonosweep.io.new_hdf5 import new_hdf5
from sonosweep.scan import Calibration, Companion, Frames, Region, Scan

FORMAT_NAME = "sonosweep scan"
FORMAT_VERSION = 1
LARGEST_NOTES_BYTES = 2**20

Compression = Literal["lzf", "gzip"]


def is_scan_hdf5(path: str | os.PathLike) -> bool:
    """Say whether a file is one of ours, of any version."""
    try:
        with open_hdf5(path) as file:
            return read_text_attribute(file, "format") == FORMAT_NAME
    except SonosweepError:
        return False


def write_scan(scan: Scan, path: str | os.PathLike, compression: Compression | None = None) -> None:
    """Write a scan to one HDF5 file; frames pass through memory one at a time.

    Args:
        scan: What was recorded; float64 and integers come back bit by bit.
        path: The file to make; it appears only when it is complete.
        compression: ``"lzf"`` is fast, ``"gzip"`` smaller and readable everywhere.

    Raises:
        FormatError: If the scan has no frames or holds what HDF5 cannot, or the disk is
            full.
    """
    if len(scan.frames) == 0:
        raise FormatError(f"'{scan.name}' has no frames: there is nothing to write")
    with new_hdf5(path) as (file, sink):
        _write_parts(file, scan, compression, sink)


def read_scan(path: str | os.PathLike) -> Scan:
    """Return the scan of one of our files; frames are read when indexed.

    Raises:
        FormatError: If it is not one of our files, is damaged, or is of a later version.
        ScanError: If its parts contradict each other.
    """
    with open_hdf5(path) as file:
        _check_version(file, Path(path).name)
        frames = frames_from_dataset(get_dataset(file, "frames"))
        count = len(frames)
        times = _optional(file, "timestamps_s", (None,), count)
        poses = _optional(file, "image_to_reference", (None, 4, 4), count)
        tracked = _optional(file, "tracked", (None,), count)
        parts = {
            "name": read_text_attribute(file, "name") or Path(path).stem,
            "subject": read_text_attribute(file, "subject"),
            "calibration": _read_calibration(file),
            "region": _read_region(file, frames.shape),
            "companions": _read_companions(file),
            "notes": read_notes(file),
        }
    return Scan(
        frames=frames,
        timestamps_s=times,
        image_to_reference=poses,
        tracked=None if tracked is None else tracked != 0,
        **parts,  # type: ignore[arg-type]
    )


def _write_parts(
    file: h5py.File, scan: Scan, compression: Compression | None, sink: DiskSink
) -> None:
    _set_text(file, "format", FORMAT_NAME)
    file.attrs["format_version"] = FORMAT_VERSION
    _set_text(file, "written_by", f"sonosweep {version('sonosweep')}")
    _set_text(file, "name", scan.name)
    if scan.subject is not None:
        _set_text(file, "subject", scan.subject)
    _write_frames(file, scan.frames, compression, sink)
    for name in ("timestamps_s", "image_to_reference", "tracked"):
        values = getattr(scan, name)
        if values is not None:
            file[name] = values.numpy()
    if scan.calibration is not None:
        _write_calibration(file.create_group("calibration"), scan.calibration)
    if scan.region is not None:
        region = file.create_group("region")
        region.attrs["rectangle_px"] = scan.region.rectangle_px
        if scan.region.mask is not None:
            region["mask"] = scan.region.mask
    for name, companion in scan.companions.items():
        if not name or "/" in name or name == ".":
            raise FormatError(f"a companion cannot be named '{name}' in an HDF5 file: rename it")
        group = file.create_group(f"companions/{name}")
        group.attrs["spacing_mm"] = companion.spacing_mm
        group.attrs["origin_mm"] = companion.origin_mm
        _write_frames(group, companion.frames, compression, sink)
    if scan.notes:
        file["notes"] = fixed_text(json.dumps(dict(scan.notes)))


def _write_frames(
    group: h5py.Group, frames: Frames, compression: Compression | None, sink: DiskSink
) -> None:
    shape = tuple(frames.shape)
    dataset = group.create_dataset(
        "frames", shape, frames.dtype, chunks=(1, *shape[1:]), compression=compression
    )
    for i in range(len(frames)):
        dataset[i] = frames[i]
        sink.check()


def _write_calibration(group: h5py.Group, calibration: Calibration) -> None:
    for name in ("spacing_mm", "shear", "latency_s", "pixel_origin"):
        group.attrs[name] = getattr(calibration, name)
    _set_text(group, "pixel_axes", calibration.pixel_axes)
    if calibration.image_to_probe is not None:
        group["image_to_probe"] = calibration.image_to_probe.numpy()


def _check_version(file: h5py.File, name: str) -> None:
    if read_text_attribute(file, "format") != FORMAT_NAME:
        known = ", ".join(list(file)[:12]) or "nothing"
        raise FormatError(f"'{name}' is not a sonosweep scan file; it holds {known}")
    found = read_number_attribute(file, "format_version", 1)[0]
    if found > FORMAT_VERSION:
        raise FormatError(
            f"'{name}' is of format version {found:g}, but this sonosweep reads up to"
            f" {FORMAT_VERSION}: update sonosweep"
        )


def _optional(
    group: h5py.Group, name: str, shape: tuple[int | None, ...], frames: int | None = None
) -> Tensor | None:
    """Return a data set as float64, or ``None`` if there is none of this name."""
    return torch.from_numpy(read_array(group, name, shape, frames)) if name in group else None


def _read_calibration(file: h5py.File) -> Calibration | None:
    if "calibration" not in file:
        return None
    group = file["calibration"]
    axes, origin = (
        read_text_attribute(group, "pixel_axes"),
        read_number_attribute(group, "pixel_origin", 1)[0],
    )
    if axes not in ("column_row", "row_column") or origin not in (0, 1):
        raise FormatError(
            f"pixels must be counted (column_row or row_column) from 0 or 1, not ({axes}) from"
            f" {origin}, in '{Path(file.filename).name}'"
        )
    return Calibration(
        spacing_mm=_pair(group, "spacing_mm"),
        shear=read_number_attribute(group, "shear", 1)[0],
        image_to_probe=_optional(group, "image_to_probe", (4, 4)),
        latency_s=read_number_attribute(group, "latency_s", 1)[0],
        pixel_axes=axes,  # type: ignore[arg-type]
        pixel_origin=int(origin),  # type: ignore[arg-type]
    )


def _read_region(file: h5py.File, shape: tuple[int, ...]) -> Region | None:
    if "region" not in file:
        return None
    group = file["region"]
    column, row, width, height = (
        int(value) for value in read_number_attribute(group, "rectangle_px", 4)
    )
    mask = read_array(group, "mask", shape[1:3]) != 0 if "mask" in group else None
    return Region((column, row, width, height), mask)


def _read_companions(file: h5py.File) -> dict[str, Companion]:
    return {
        str(name): Companion(
            frames=frames_from_dataset(get_dataset(group, "frames"), channels=(2, 3, 4)),  # 2: IQ
            spacing_mm=_pair(group, "spacing_mm"),
            origin_mm=_pair(group, "origin_mm"),
        )
        for name, group in file.get("companions", {}).items()
    }


def read_notes(file: h5py.File) -> dict[str, str]:
    """Return the notes of a file of ours, none if it has none.

    Raises:
        FormatError: If they are no text.
    """
    if "notes" not in file:
        return {}
    dataset = file["notes"]
    is_text = isinstance(dataset, h5py.Dataset) and dataset.dtype.kind == "S"
    if not is_text or dataset.shape != () or dataset.dtype.itemsize > LARGEST_NOTES_BYTES:
        raise FormatError(f"the notes of '{Path(file.filename).name}' are not a short text")
    text = bytes(dataset[()])
    return {str(subject): str(note) for subject, note in json.loads(text).items()}


def _pair(group: h5py.Group, name: str) -> tuple[float, float]:
    first, second = read_number_attribute(group, name, 2)
    return first, second


def _set_text(group: h5py.Group, name: str, text: str) -> None:
    group.attrs[name] = fixed_text(text)


def fixed_text(text: str) -> np.ndarray:
    """Return text of a fixed length, see :func:`read_text_attribute`.

    Raises:
        FormatError: If it holds a zero byte.
    """
    encoded = text.encode("utf-8")
    if b"\0" in encoded:
        raise FormatError(f"a text with a zero byte cannot be stored: {text[:40]!r}")
    return np.array(encoded, h5py.string_dtype("utf-8", max(len(encoded), 1)))
