"""Sequence files in the dialects that PLUS, IGSIO, 3D Slicer and Ibis write."""

import gzip
import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np

IDENTITY = "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"


def shift(x: float, y: float = 0, z: float = 0) -> str:
    """Return a transform that only moves, as these files write it."""
    return f"1 0 0 {x} 0 1 0 {y} 0 0 1 {z} 0 0 0 1"


def some_pixels(frames: int = 3, rows: int = 4, columns: int = 5, channels: int = 1) -> np.ndarray:
    """Return random frames of bytes."""
    shape = (frames, rows, columns) + ((channels,) if channels > 1 else ())
    return np.random.default_rng(7).integers(0, 256, shape, dtype=np.uint8)


def write_mha(
    path: Path,
    pixels: np.ndarray,
    fields: Mapping[str, str] | None = None,
    without: tuple[str, ...] = (),
    compress: bool = False,
) -> Path:
    """Write a sequence as PLUS does, with these fields changed or added.

    Args:
        path: Where to.
        pixels: Frames, rows, columns and, for colour, channels.
        fields: Further header fields, or others than usual.
        without: Header fields to leave out.
        compress: Whether to compress the pixels.
    """
    count, rows, columns = pixels.shape[:3]
    data = zlib.compress(pixels.tobytes()) if compress else pixels.tobytes()
    header = {
        "ObjectType": "Image",
        "NDims": "3",
        "AnatomicalOrientation": "RAI",
        "BinaryData": "True",
        "BinaryDataByteOrderMSB": "False",
        "CompressedData": str(compress),
        "DimSize": f"{columns} {rows} {count}             ",
        "Kinds": "domain domain list",
        "ElementNumberOfChannels": str(pixels.shape[3] if pixels.ndim == 4 else 1),
        "ElementSpacing": "1 1 1",
        "ElementType": {"uint8": "MET_UCHAR", "int16": "MET_SHORT"}[pixels.dtype.name],
        "UltrasoundImageOrientation": "MF",
        "UltrasoundImageType": "BRIGHTNESS",
        **(fields or {}),
    }
    lines = [f"{name} = {text}\n" for name, text in header.items() if name not in without]
    path.write_bytes(("".join(lines) + "ElementDataFile = LOCAL\n").encode() + data)
    return path


def write_nrrd(
    path: Path,
    stored: np.ndarray,
    kinds: str,
    keys: Mapping[str, str],
    encoding: str = "raw",
    fields: Mapping[str, str] | None = None,
) -> Path:
    """Write an NRRD file.

    Args:
        path: Where to.
        stored: Pixels with the slowest axis first.
        kinds: What each axis is, the fastest first.
        keys: Keys and values.
        encoding: ``"raw"`` or ``"gz"``.
        fields: Further fields, or others than usual.
    """
    header = {
        "type": "unsigned char",
        "dimension": str(stored.ndim),
        "sizes": " ".join(map(str, reversed(stored.shape))),
        "kinds": kinds,
        "endian": "little",
        "encoding": encoding,
        **(fields or {}),
    }
    text = "NRRD0004\n# a comment\n"
    text += "".join(f"{name}: {value}\n" for name, value in header.items())
    text += "".join(f"{name}:={value}\n" for name, value in keys.items()) + "\n"
    data = gzip.compress(stored.tobytes()) if encoding == "gz" else stored.tobytes()
    path.write_bytes(text.encode() + data)
    return path
