"""Volumes as NIfTI-1, for ITK-SNAP, napari, FSL and everything in Python.

NIfTI counts in RAS, so under ``world="ras"`` its coordinates are our reference itself. The
place is written twice, as sform and as qform, both with the code "scanner"; the header's
numbers are float32, which is 0.01 um at 100 mm.
"""

import gzip
import io
import json
import logging
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from sonosweep.errors import FormatError
from sonosweep.io.atomic import write_beside
from sonosweep.io.guard import LARGEST_DEFLATE_RATIO, Readable, check_size, read_array, refusing
from sonosweep.io.voxels import lps_matrix, stated_world, volume_from_lps, with_stored_type
from sonosweep.io.world import World
from sonosweep.scan import Volume

TYPES = frozenset(f"{kind}{bits}" for kind in ("int", "uint") for bits in (8, 16, 32, 64))
TYPES |= {"float32", "float64"}
RGB = np.dtype([("R", "u1"), ("G", "u1"), ("B", "u1")])
LPS_TO_RAS = np.diag([-1.0, -1.0, 1.0, 1.0])
SCANNER = 1  # NIFTI_XFORM_SCANNER_ANAT: the coordinates of what recorded it
VECTOR = 1007  # NIFTI_INTENT_VECTOR: the fifth axis holds the channels
LARGEST_AXIS = 32767
COMPRESSION_LEVEL = 1  # several times faster than more, for files nearly as small
LARGEST_HEADER_BYTES = 1 << 20
# nibabel prints each oddity of a header; what matters it raises as well.
SILENT = logging.Logger("headers of others", level=logging.CRITICAL)
MM_PER_UNIT = {"meter": 1e3, "micron": 1e-3}


def write_nifti(volume: Volume, path: str | PathLike, world: World = "ras") -> None:
    """Write the voxels of a volume; its coverage is for a file of its own.

    Three channels of 8 bits are written as RGB, other channels as a vector (fifth axis).

    Args:
        volume: What to write.
        path: Ends in ``.nii`` or, compressed, in ``.nii.gz``.
        world: How our reference is stated as LPS, which NIfTI turns into RAS.

    Raises:
        FormatError: If the volume is too long for the format, the voxel type has no place
            in it, or the file cannot be written.
    """
    import nibabel

    volume = with_stored_type(volume, TYPES, path)
    if max(volume.voxels.shape) > LARGEST_AXIS:
        raise FormatError(
            f"a volume of {volume.grid.size} voxels is too long for NIfTI, which ends at"
            f" {LARGEST_AXIS} per axis: write '{Path(path).name}' as .nrrd"
        )
    affine = LPS_TO_RAS @ lps_matrix(volume.grid, world)
    voxels = _nifti_order(volume.voxels)
    image = nibabel.Nifti1Image(voxels, affine, dtype=voxels.dtype)
    if image.ndim == 5:
        image.header["intent_code"] = VECTOR
    image.header.set_xyzt_units("mm")
    image.set_sform(affine, SCANNER)
    image.set_qform(affine, SCANNER)
    record = json.dumps({"sonosweep": {"world": world, "settings": dict(volume.settings)}})
    image.header.extensions.append(
        nibabel.nifti1.Nifti1Extension("comment", record.encode("ascii"))
    )
    with write_beside(path) as temporary, temporary.open("wb") as file:
        if Path(path).suffix.lower() != ".gz":
            image.to_stream(file)
            return
        with gzip.GzipFile("", "wb", COMPRESSION_LEVEL, fileobj=file, mtime=0) as packed:
            image.to_stream(packed)


def _nifti_order(voxels: np.ndarray) -> np.ndarray:
    """Return a view ``(x, y, z)`` of RGB or of scalars, or ``(x, y, z, 1, channels)``."""
    if voxels.ndim == 3:
        return voxels.T
    if voxels.shape[3] == 3 and voxels.dtype == np.uint8:
        return np.ascontiguousarray(voxels).view(RGB)[..., 0].T
    return voxels.transpose(2, 1, 0, 3)[:, :, :, np.newaxis, :]


def read_nifti(path: str | PathLike, world: World = "ras") -> Volume:
    """Return the volume in a NIfTI-1 or NIfTI-2 file.

    The sform counts if there is one, otherwise the qform. Scaled voxels come as float32.

    Args:
        path: Ends in ``.nii`` or ``.nii.gz``.
        world: How to read the coordinates of a file that does not tell itself.

    Raises:
        FormatError: If it is no NIfTI volume, or damaged, or one of many over time.
    """
    with refusing(path, "a NIfTI volume"), Path(path).open("rb") as file:
        stored = file.seek(0, 2)
        file.seek(0)
        packed = file.read(2) == b"\x1f\x8b"
        file.seek(0)
        stream: Readable = gzip.GzipFile(fileobj=file) if packed else file
        header = _read_header(stream, path)
        voxels = _read_voxels(header, stream, stored, LARGEST_DEFLATE_RATIO if packed else 1, path)
        record = _our_record(header)
        unit = MM_PER_UNIT.get(header.get_xyzt_units()[0], 1.0)
        affine = np.diag([unit, unit, unit, 1.0]) @ header.get_best_affine()
        settings = {str(k): str(v) for k, v in dict(record.get("settings", {})).items()}
        turned = LPS_TO_RAS @ affine
        return volume_from_lps(voxels, turned, stated_world(record.get("world"), world), settings)


def _read_header(stream: Readable, path: str | PathLike) -> Any:
    """Return nibabel's header, made from the first bytes alone so that its size is bounded."""
    from nibabel.nifti1 import Nifti1Header
    from nibabel.nifti2 import Nifti2Header

    start = stream.read(LARGEST_HEADER_BYTES)
    lengths = {int.from_bytes(start[:4], "little"), int.from_bytes(start[:4], "big")}
    kinds: dict[int, Any] = {Nifti1Header.sizeof_hdr: Nifti1Header, 540: Nifti2Header}
    kind = next((kinds[length] for length in lengths if length in kinds), None)
    if kind is None:
        raise FormatError(f"'{path}' is no NIfTI volume: its first number is not 348 or 540")
    header = kind.from_fileobj(io.BytesIO(start), check=False)
    header.check_fix(logger=SILENT)
    if not header["magic"].item().startswith(b"n+"):
        raise FormatError(f"'{path}' is a header without its image: give the .nii file")
    return header


def _read_voxels(
    header: Any, stream: Readable, stored_bytes: int, ratio: int, path: str | PathLike
) -> np.ndarray:
    """Return voxels ``(z, y, x[, channels])``, scaled as the header says."""
    shape = tuple(int(n) for n in header.get_data_shape())
    dtype = header.get_data_dtype()
    if len(shape) not in (3, 4, 5) or min(shape) < 1 or shape[3:4] not in ((), (1,)):
        raise FormatError(
            f"'{path}' has axes of {shape}; a volume has three of space and none of time"
        )
    if dtype.base not in (RGB,) and (dtype.kind not in "iuf" or dtype.itemsize > 8):
        raise FormatError(f"'{path}' has voxels of type {dtype}; expected numbers or RGB")
    count = int(np.prod([*shape], dtype=object))
    check_size(count * dtype.itemsize, stored_bytes, ratio, path)
    stream.seek(int(header.get_data_offset()))
    values = read_array(stream, count, dtype, path).reshape(shape[::-1])
    if dtype == RGB:
        return values.view(np.uint8).reshape(*shape[2::-1], 3)
    if len(shape) == 5:
        values = np.moveaxis(values[:, 0], 0, -1)
    elif len(shape) == 4:
        values = values[0]
    return _scaled(values, header)


def _scaled(values: np.ndarray, header: Any) -> np.ndarray:
    slope, intercept = header.get_slope_inter()
    if slope in (None, 1.0) and intercept in (None, 0.0):
        return values
    return (values * np.float64(slope) + np.float64(intercept)).astype(np.float32)


def _our_record(header: Any) -> Mapping[str, Any]:
    """Return what we wrote about the volume; empty for files of others."""
    for extension in header.extensions:
        if extension.get_code() == 6:
            try:
                record = json.loads(bytes(extension.content).rstrip(b"\0"))
            except ValueError:
                continue
            if isinstance(record, dict) and isinstance(record.get("sonosweep"), dict):
                return record["sonosweep"]
    return {}
