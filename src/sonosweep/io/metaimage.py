"""Volumes as MetaImage files (``.mha``, ``.mhd``).

``TransformMatrix`` lists the axes one after the other, so its rows are the columns of ITK's
direction matrix.
"""

import os
from pathlib import Path

import numpy as np

from sonosweep.errors import FormatError, ScanError
from sonosweep.io.atomic import write_beside
from sonosweep.io.metaimage_header import (
    ELEMENT_TYPES,
    OWN_PREFIX,
    MetaImageHeader,
    element_type,
    header_numbers,
    numbers_text,
    own_fields,
    read_metaimage_header,
    write_header_and_pixels,
)
from sonosweep.io.pixel_data import read_pixels
from sonosweep.io.voxels import with_stored_type
from sonosweep.io.world import World, grid_from_lps, lps_from_grid
from sonosweep.scan import Volume

VOLUME_TYPES = frozenset(np.dtype(code).name for code in ELEMENT_TYPES.values())


def read_metaimage(path: str | os.PathLike, world: World = "ras") -> Volume:
    """Return a volume with its place in the reference.

    A file whose axes are left-handed is turned right-handed by counting its slices from the
    other end; every voxel stays where it is.

    Args:
        path: A ``.mha`` or ``.mhd`` file.
        world: How to read the file's coordinates where it does not tell itself; PLUS's
            volumes need ``"lps"``.

    Raises:
        FormatError: If it is no MetaImage volume, or not all of it is there.
    """
    header = read_metaimage_header(path)
    if len(header.size) not in (2, 3) or header.pixels is None:
        sizes = " x ".join(map(str, header.size))
        raise FormatError(f"'{path}' is {sizes}, not a volume: expected three sizes above 0")
    values = header.values
    own = {
        name.removeprefix(OWN_PREFIX): value
        for name, value in values.items()
        if name.startswith(OWN_PREFIX)
    }
    stated = own.pop("world", world)
    if stated not in ("ras", "lps"):
        raise FormatError(f"world '{stated[:60]}' in '{path}': expected ras or lps")
    voxels = read_pixels(header.pixels)
    voxels = voxels.astype(voxels.dtype.newbyteorder("="), copy=False)
    size, spacing, origin, axes = _place(header)
    if len(header.size) == 2:
        voxels = voxels[np.newaxis]
    if np.linalg.det(axes) < 0:
        origin = origin + axes[:, 2] * spacing[2] * (size[2] - 1)
        axes = axes * [1.0, 1.0, -1.0]
        voxels = np.ascontiguousarray(voxels[::-1])
    try:
        grid = grid_from_lps(size, spacing, origin, axes, "ras" if stated == "ras" else "lps")
    except ScanError as error:
        raise FormatError(f"{error}, in '{path}'") from error
    return Volume(voxels=voxels, grid=grid, settings=own)


def _place(
    header: MetaImageHeader,
) -> tuple[tuple[int, int, int], tuple[float, float, float], np.ndarray, np.ndarray]:
    """Return size, spacing, origin and axes (in columns) in three dimensions."""
    n = len(header.size)
    stated: dict[str, np.ndarray] = {}
    for names, default in (
        (("ElementSpacing", "ElementSize"), np.ones(n)),
        (("Offset", "Position", "Origin"), np.zeros(n)),
        (("TransformMatrix", "Rotation", "Orientation"), np.eye(n).ravel()),
    ):
        name = next((name for name in names if name in header.values), None)
        numbers = default if name is None else header_numbers(header.values, name, header.path)
        if len(numbers) != len(default):
            raise FormatError(
                f"{name} in '{header.path}' holds {len(numbers)} numbers, expected {len(default)}"
            )
        stated[names[0]] = np.asarray(numbers, dtype=np.float64)
    spacing, origin, axes = np.ones(3), np.zeros(3), np.eye(3)
    spacing[:n], origin[:n] = stated["ElementSpacing"], stated["Offset"]
    axes[:n, :n] = stated["TransformMatrix"].reshape(n, n).T
    x, y, z = (*header.size, 1)[:3]
    sx, sy, sz = map(float, spacing)
    return (x, y, z), (sx, sy, sz), origin, axes


def write_metaimage(
    volume: Volume, path: str | os.PathLike, world: World = "ras", compress: bool = True
) -> None:
    """Write a volume as one ``.mha`` file, with its settings and the world it is in.

    Args:
        volume: With or without channels. Its coverage is a volume of its own and is not
            written.
        path: Where to; the suffix must be ``.mha``.
        world: Which patient axes the file claims, see :mod:`sonosweep.io.world`.
        compress: Whether to compress the voxels with zlib.

    Raises:
        FormatError: If the suffix is another, MetaImage has no such voxel type, or the file
            cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() != ".mha":
        raise FormatError(f"cannot write '{path}': a MetaImage volume's name ends with .mha")
    volume = with_stored_type(volume, VOLUME_TYPES, path)
    origin, axes = lps_from_grid(volume.grid, world)
    channels = volume.voxels.shape[3] if volume.voxels.ndim == 4 else 1
    fields = {
        "ObjectType": "Image",
        "NDims": "3",
        "BinaryData": "True",
        "BinaryDataByteOrderMSB": "False",
        "CompressedData": str(compress),
        "TransformMatrix": numbers_text(axes.T.ravel()),
        "Offset": numbers_text(origin),
        "CenterOfRotation": "0 0 0",
        "ElementSpacing": numbers_text(volume.grid.spacing_mm),
        "DimSize": " ".join(map(str, volume.grid.size)),
        "ElementNumberOfChannels": str(channels),
        "ElementType": element_type(volume.voxels.dtype),
        f"{OWN_PREFIX}world": world,
        **own_fields(volume.settings),
    }
    little = volume.voxels.dtype.newbyteorder("<")
    slices = (np.ascontiguousarray(piece, little) for piece in volume.voxels)
    with write_beside(path) as temporary, temporary.open("wb") as file:
        write_header_and_pixels(file, fields, slices, compress)
