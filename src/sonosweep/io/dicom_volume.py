"""Volumes as a DICOM series: a folder of single-frame files with exact geometry.

No DICOM object for ultrasound volumes is read with its geometry by common software, and
this series is. NRRD and NIfTI remain the better choice where DICOM is not demanded.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float
from pydicom import Dataset
from pydicom.uid import SecondaryCaptureImageStorage, UltrasoundImageStorage
from pydicom.valuerep import format_number_as_ds

from sonosweep.errors import FormatError
from sonosweep.io.atomic_folder import write_folder_beside
from sonosweep.io.dicom_frames import DicomFrames, is_dicom, open_dicom
from sonosweep.io.dicom_new import (
    describe_pixels,
    describe_rgb,
    dicom_bytes,
    new_dicom,
    new_uid,
)
from sonosweep.io.guard import refusing
from sonosweep.io.voxels import lps_matrix, stated_world, volume_from_lps, with_stored_type
from sonosweep.io.world import World
from sonosweep.scan import Volume

Modality = Literal["US", "OT"]
SOP_CLASSES = {"US": UltrasoundImageStorage, "OT": SecondaryCaptureImageStorage}
TYPES = frozenset(("uint8", "int8", "uint16", "int16", "float32", "float64"))
SLICE_NAME = "slice_{:05d}.dcm"
SLICE_PATTERN = "slice_*.dcm"
WORLD_RECORD = "volume compounded from a sweep by sonosweep; reference written as world="
LARGEST_SIDE = 65535
# Positions are decimal strings of 16 characters, and other programs write fewer.
EVEN_MM = 1e-2
LARGEST_LEVEL = 65535


def write_dicom_volume(
    volume: Volume,
    path: str | PathLike,
    world: World = "ras",
    modality: Modality = "US",
) -> None:
    """Write a series of one file per slice into a folder, naming nobody and no date.

    Real numbers are written as 16 bits with a rescale slope, which rounds by up to 1 part
    in 131070 of the range.

    Args:
        volume: Gray, or RGB of 8 bits.
        path: A new or empty folder, or one that holds such a series, which is replaced.
        world: How our reference is stated as LPS.
        modality: ``"US"`` (US Image Storage), or ``"OT"`` (Secondary Capture) for viewers
            that show an ultrasound series as many single images.

    Raises:
        FormatError: If the voxels cannot be written as DICOM, the folder holds something
            else, or it cannot be written to.
    """
    volume = with_stored_type(volume, TYPES, path)
    _check_writable(volume, path)
    slope, intercept = _rescale(volume.voxels, path)
    common = _series_header(volume, world, modality)
    if slope is not None:
        common.RescaleSlope, common.RescaleIntercept = _decimal(slope), _decimal(intercept)
    matrix = lps_matrix(volume.grid, world)
    with write_folder_beside(path, (SLICE_PATTERN,)) as folder:
        for index, piece in enumerate(volume.voxels):
            if slope is not None:
                levels = np.rint((piece.astype(np.float64) - intercept) / slope)
                piece = np.clip(levels, 0, LARGEST_LEVEL).astype(np.uint16)
            _state_slice(common, index, matrix)
            _state_pixels(common, piece)
            (folder / SLICE_NAME.format(index)).write_bytes(dicom_bytes(common))


def _check_writable(volume: Volume, path: str | PathLike) -> None:
    channels = volume.voxels.shape[3:]
    if channels and (channels != (3,) or volume.voxels.dtype != np.uint8):
        raise FormatError(
            f"cannot write {channels[0]} channels of {volume.voxels.dtype} to '{path}'; DICOM"
            " takes gray, and RGB of 8 bits"
        )
    if max(volume.grid.size[:2]) > LARGEST_SIDE:
        raise FormatError(
            f"slices of {volume.grid.size[:2]} voxels do not fit in DICOM, which ends at"
            f" {LARGEST_SIDE}"
        )


def _rescale(voxels: np.ndarray, path: str | PathLike) -> tuple[float | None, float]:
    """Return slope and intercept that take 16-bit levels to real voxels; none for whole ones."""
    if voxels.dtype.kind != "f":
        return None, 0.0
    low, high = float(voxels.min()), float(voxels.max())
    if not (np.isfinite(low) and np.isfinite(high)):
        raise FormatError(f"cannot write voxels that are not numbers to '{path}'")
    slope = float(_decimal((high - low) / LARGEST_LEVEL)) or 1.0
    return slope, float(_decimal(low))


def _decimal(value: float) -> str:
    """Return a number as DICOM's decimal string, as exact as its 16 characters allow."""
    return format_number_as_ds(float(value) + 0.0)


def _series_header(volume: Volume, world: World, modality: Modality) -> Dataset:
    """Return what all slices share."""
    header = new_dicom(SOP_CLASSES[modality], modality)
    x_mm, y_mm, z_mm = volume.grid.spacing_mm
    direction = lps_matrix(volume.grid, world)[:3, :3] / np.asarray(volume.grid.spacing_mm)
    header.ImageType = ["DERIVED", "SECONDARY"]
    header.SeriesNumber = 1
    header.SeriesDescription = "sonosweep volume"
    header.DerivationDescription = WORLD_RECORD + world
    header.FrameOfReferenceUID = new_uid()
    header.PositionReferenceIndicator = None
    header.PixelSpacing = [_decimal(y_mm), _decimal(x_mm)]  # between rows, between columns
    header.SliceThickness = header.SpacingBetweenSlices = _decimal(z_mm)
    header.ImageOrientationPatient = [_decimal(n) for n in (*direction[:, 0], *direction[:, 1])]
    if modality == "OT":
        header.ConversionType = "WSD"  # made at a workstation
    else:
        header.UltrasoundColorDataPresent = int(volume.voxels.ndim == 4)
    return header


def _state_slice(header: Dataset, index: int, voxel_to_lps: Float[np.ndarray, "4 4"]) -> None:
    header.SOPInstanceUID = new_uid()
    header.InstanceNumber = index + 1
    position = voxel_to_lps[:3, 3] + index * voxel_to_lps[:3, 2]
    header.ImagePositionPatient = [_decimal(n) for n in position]


def _state_pixels(header: Dataset, piece: np.ndarray) -> None:
    rows, columns = piece.shape[:2]
    if piece.ndim == 3:
        describe_rgb(header, rows, columns)
    else:
        describe_pixels(header, rows, columns, piece.itemsize * 8, piece.dtype.kind == "i")
    little = piece.astype(piece.dtype.newbyteorder("little"), copy=False)
    stored = little.tobytes()
    header.PixelData = stored + b"\0" * (len(stored) % 2)
    header["PixelData"].VR = "OB" if piece.itemsize == 1 else "OW"


@dataclass(frozen=True, eq=False)
class _Slice:
    """One file of a series, with its place."""

    header: Dataset
    frames: DicomFrames
    position_mm: Float[np.ndarray, "xyz=3"]


def read_dicom_volume(path: str | PathLike, world: World = "ras") -> Volume:
    """Return the volume in a folder that holds one series of parallel slices.

    Args:
        path: The folder. Files in it that are not DICOM are passed over.
        world: How to read the coordinates of a file that does not tell itself.

    Raises:
        FormatError: If there is no such series, several, a slice missing or damaged, or
            its geometry is not stated.
    """
    with refusing(path, "a DICOM series"):
        names = [p for p in sorted(Path(path).iterdir()) if p.name != "DICOMDIR" and is_dicom(p)]
        if not names:
            raise FormatError(f"no DICOM file in folder '{path}'")
        slices = [_open_slice(name) for name in names]
        _check_series(slices, path)
        first = slices[0].header
        x, y = np.asarray(first.ImageOrientationPatient, dtype=np.float64).reshape(2, 3)
        normal = np.cross(x, y)
        slices.sort(key=lambda one: float(one.position_mm @ normal))
        matrix = np.eye(4)
        matrix[:3, 0] = x * float(first.PixelSpacing[1])
        matrix[:3, 1] = y * float(first.PixelSpacing[0])
        matrix[:3, 2] = _slice_step(slices, normal, path)
        matrix[:3, 3] = slices[0].position_mm
        told = str(first.get("DerivationDescription", "")).removeprefix(WORLD_RECORD)
        voxels = np.stack([_read_slice(one) for one in slices])
        return volume_from_lps(voxels, matrix, stated_world(told, world))


def _open_slice(name: Path) -> _Slice:
    header, frames = open_dicom(name)
    wanted = ("ImagePositionPatient", "ImageOrientationPatient", "PixelSpacing")
    missing = [keyword for keyword in wanted if not header.get(keyword)]
    if missing or len(frames) != 1:
        raise FormatError(
            f"'{name}' is no slice of a volume: it has {len(frames)} frames and no"
            f" {' and no '.join(missing) or 'place for each'}"
        )
    return _Slice(header, frames, np.asarray(header.ImagePositionPatient, dtype=np.float64))


def _check_series(slices: Sequence[_Slice], path: str | PathLike) -> None:
    """Refuse slices that do not make one stack."""
    first = slices[0]
    for other in slices[1:]:
        if other.header.get("SeriesInstanceUID") != first.header.get("SeriesInstanceUID"):
            raise FormatError(f"'{path}' holds several series; put each into a folder of its own")
        same = (
            other.frames.shape == first.frames.shape
            and other.frames.dtype == first.frames.dtype
            and np.allclose(
                [*other.header.ImageOrientationPatient, *other.header.PixelSpacing],
                [*first.header.ImageOrientationPatient, *first.header.PixelSpacing],
                atol=1e-4,
            )
        )
        if not same:
            raise FormatError(
                f"'{other.frames.path.name}' and '{first.frames.path.name}' in '{path}' are not"
                " parallel slices of the same size"
            )


def _slice_step(
    slices: Sequence[_Slice], normal: Float[np.ndarray, "xyz=3"], path: str | PathLike
) -> Float[np.ndarray, "xyz=3"]:
    """Return the way from one slice to the next, in mm."""
    if len(slices) == 1:
        header = slices[0].header
        stated = header.get("SpacingBetweenSlices") or header.get("SliceThickness") or 1.0
        return normal * float(stated)
    positions = np.stack([one.position_mm for one in slices])
    steps = np.diff(positions, axis=0)
    mean = (positions[-1] - positions[0]) / (len(positions) - 1)
    worst = int(np.linalg.norm(steps - mean, axis=1).argmax())
    if not np.linalg.norm(steps[worst] - mean) <= EVEN_MM:
        raise FormatError(
            f"the slices in '{path}' are not evenly spaced: number {worst + 1} and the next are"
            f" {np.linalg.norm(steps[worst]):.3f} mm apart, all others about"
            f" {np.median(np.linalg.norm(steps, axis=1)):.3f} mm; is a file missing?"
        )
    return mean


def _read_slice(one: _Slice) -> np.ndarray:
    slope = float(one.header.get("RescaleSlope") or 1.0)
    intercept = float(one.header.get("RescaleIntercept") or 0.0)
    piece = one.frames[0]
    if slope == 1.0 and intercept == 0.0:
        return piece
    return (piece * slope + intercept).astype(np.float32)
