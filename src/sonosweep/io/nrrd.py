"""Volumes as NRRD, which 3D Slicer opens first.

The header is text that anybody can read; the voxels follow it, compressed as one gzip
member. We write ``space: left-posterior-superior`` by the world rule
(:mod:`sonosweep.io.world`) and keep how the volume was made under ``sonosweep ...`` keys.
"""

import gzip
import json
from collections.abc import Iterator, Mapping
from os import PathLike
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from jaxtyping import Float

from sonosweep.errors import FormatError
from sonosweep.io.atomic import write_beside
from sonosweep.io.guard import LARGEST_DEFLATE_RATIO, Readable, check_size, read_array, refusing
from sonosweep.io.sequence_nrrd import VALUE_TYPES
from sonosweep.io.voxels import lps_matrix, stated_world, volume_from_lps, with_stored_type
from sonosweep.io.world import World
from sonosweep.scan import Volume

# NumPy's name of each voxel type and the names that NRRD has for it; we write the first.
TYPES = {np.dtype(code).name: words for code, words in VALUE_TYPES.items()}
# Level 1 is five times faster than the usual 9 and the file is as small.
COMPRESSION_LEVEL = 1
LARGEST_HEADER_BYTES = 1 << 24
SPACES_TO_LPS = {
    "left-posterior-superior": (1.0, 1.0, 1.0),
    "lps": (1.0, 1.0, 1.0),
    "right-anterior-superior": (-1.0, -1.0, 1.0),
    "ras": (-1.0, -1.0, 1.0),
    "left-anterior-superior": (1.0, -1.0, 1.0),
    "las": (1.0, -1.0, 1.0),
}


def write_nrrd(volume: Volume, path: str | PathLike, world: World = "ras") -> None:
    """Write the voxels of a volume; its coverage is for a file of its own.

    Slices are compressed one by one, so that a volume on disk need not fit in memory.

    Args:
        volume: What to write. Channels become the first (fastest) axis.
        path: Ends in ``.nrrd``.
        world: How our reference is stated as LPS.

    Raises:
        FormatError: If NRRD has no such voxel type, or the file cannot be written.
    """
    volume = with_stored_type(volume, frozenset(TYPES), path)
    with write_beside(path) as temporary, temporary.open("wb") as file:
        file.write(_header_text(volume, world).encode("ascii"))
        with gzip.GzipFile("", "wb", COMPRESSION_LEVEL, fileobj=file, mtime=0) as packed:
            for piece in volume.voxels:
                little = piece.astype(piece.dtype.newbyteorder("little"), copy=False)
                packed.write(np.ascontiguousarray(little).data)


def _header_text(volume: Volume, world: World) -> str:
    matrix = lps_matrix(volume.grid, world)
    channels = volume.voxels.shape[3:]
    vectors = [_vector_text(matrix[:3, axis]) for axis in range(3)]
    settings = json.dumps(dict(volume.settings))
    lines = [
        "NRRD0004",
        f"type: {TYPES[volume.voxels.dtype.name][0]}",
        f"dimension: {volume.voxels.ndim}",
        "space: left-posterior-superior",
        "sizes: " + " ".join(str(n) for n in (*channels, *volume.grid.size)),
        "space directions: " + " ".join(["none"] * len(channels) + vectors),
        "kinds: " + " ".join(["vector"] * len(channels) + ["domain"] * 3),
        "endian: little",
        "encoding: gzip",
        'space units: "mm" "mm" "mm"',
        f"space origin: {_vector_text(matrix[:3, 3])}",
        f"sonosweep world:={world}",
        f"sonosweep settings:={settings}",
    ]
    return "\n".join(lines) + "\n\n"


def _vector_text(vector: Float[np.ndarray, "xyz=3"]) -> str:
    # Adding 0 turns -0 into 0; 17 digits hold a float64 exactly.
    return "(" + ",".join(f"{value + 0.0:.17g}" for value in vector) + ")"


def read_nrrd(path: str | PathLike, world: World = "ras") -> Volume:
    """Return the volume in a NRRD file: raw or gzip, attached or with a separate data file.

    Files that name no space are taken as LPS, as ITK does.

    Args:
        path: Ends in ``.nrrd`` or ``.nhdr``.
        world: How to read the coordinates of a file that does not tell itself.

    Raises:
        FormatError: If it is no NRRD volume, or damaged.
    """
    import nrrd

    with refusing(path, "a NRRD volume"), Path(path).open("rb") as file:
        header: dict[str, Any] = nrrd.read_header(_header_lines(file, path))
        voxels = _read_voxels(header, file, path)
        return volume_from_lps(
            voxels,
            _lps_from_header(header, path),
            stated_world(header.get("sonosweep world"), world),
            _settings_from_header(header),
        )


def _header_lines(file: BinaryIO, path: str | PathLike) -> Iterator[str]:
    """Give the lines up to the empty one, which is where the voxels begin."""
    left = LARGEST_HEADER_BYTES
    while left > 0:
        line = file.readline(left)
        left -= len(line)
        yield line.decode("ascii", "ignore")
        if not line.strip():
            return
    raise FormatError(f"the header of '{path}' does not end; a NRRD header ends in an empty line")


def _read_voxels(header: Mapping[str, Any], file: BinaryIO, path: str | PathLike) -> np.ndarray:
    """Return voxels ``(z, y, x[, channels])``."""
    sizes = [int(n) for n in header["sizes"]]
    if header["dimension"] != len(sizes) or min(sizes, default=0) < 1:
        raise FormatError(f"sizes {sizes} do not suit dimension {header['dimension']} in '{path}'")
    axis = _channel_axis(header, sizes, path)
    voxels = _read_stored(header, sizes, file, path).reshape(sizes[::-1])
    return voxels if axis is None else np.moveaxis(voxels, len(sizes) - 1 - axis, -1)


def _channel_axis(header: Mapping[str, Any], sizes: list[int], path: str | PathLike) -> int | None:
    """Return which axis holds channels; ``None`` if there are three axes and all are space."""
    if len(sizes) == 3:
        return None
    directions = np.asarray(header.get("space directions", []), dtype=np.float64)
    if len(sizes) == 4 and directions.shape == (4, 3):
        none = np.flatnonzero(np.isnan(directions).any(axis=1))
        if len(none) == 1:
            return int(none[0])
    if len(sizes) == 4 and len(directions) == 0:
        kinds = [str(kind).lower() for kind in header.get("kinds", ["vector"])]
        if kinds[0] not in ("domain", "space"):
            return 0
    raise FormatError(
        f"'{path}' is no volume: it has axes of {sizes}; expected three axes of space and"
        " perhaps one of channels"
    )


def _read_stored(
    header: Mapping[str, Any], sizes: list[int], file: BinaryIO, path: str | PathLike
) -> np.ndarray:
    """Return the numbers in file order, from this file or the one that it names."""
    name = header.get("data file", header.get("datafile"))
    if name is not None:
        if Path(name).name != name or name == "LIST" or "%" in name:
            raise FormatError(
                f"'{path}' keeps its voxels in '{name}'; only one data file in the same folder is"
                " supported"
            )
        with (Path(path).parent / name).open("rb") as data:
            return _read_encoded(header, sizes, data, path)
    return _read_encoded(header, sizes, file, path)


def _read_encoded(
    header: Mapping[str, Any], sizes: list[int], file: BinaryIO, path: str | PathLike
) -> np.ndarray:
    dtype = _stored_type(header, path)
    count = int(np.prod([*sizes], dtype=object))
    start = file.tell()
    stored = file.seek(0, 2) - start
    file.seek(start)
    encoding = header["encoding"].lower()
    if encoding == "raw":
        check_size(count * dtype.itemsize, stored, 1, path)
        _skip(header, file, stored - count * dtype.itemsize, path)
        return read_array(file, count, dtype, path)
    if encoding not in ("gzip", "gz"):
        raise FormatError(f"'{path}' is encoded as {encoding}; save it as gzip or raw")
    check_size(count * dtype.itemsize, stored, LARGEST_DEFLATE_RATIO, path)
    with gzip.GzipFile(fileobj=file) as packed:
        _skip(header, packed, 0, path)
        values = read_array(packed, count, dtype, path)
        if packed.read(1):
            raise FormatError(f"'{path}' holds more voxels than the {sizes} that it states")
    return values


def _skip(
    header: Mapping[str, Any], file: Readable, spare_bytes: int, path: str | PathLike
) -> None:
    """Skip what the header says lies before the voxels."""
    lines = header.get("line skip", header.get("lineskip", 0))
    skip = header.get("byte skip", header.get("byteskip", 0))
    if lines or skip < -1 or skip > spare_bytes:
        raise FormatError(
            f"line skip {lines} and byte skip {skip} in '{path}' are not supported; save it without"
        )
    file.seek(spare_bytes if skip == -1 else skip, 1)


def _stored_type(header: Mapping[str, Any], path: str | PathLike) -> np.dtype:
    for name, spellings in TYPES.items():
        if header["type"] in spellings:
            return np.dtype(name).newbyteorder("big" if header.get("endian") == "big" else "little")
    raise FormatError(f"'{path}' has voxels of type '{header['type']}', which is no number")


def _lps_from_header(header: Mapping[str, Any], path: str | PathLike) -> Float[np.ndarray, "4 4"]:
    """Return voxel (x, y, z) to LPS as the header states it."""
    space = str(header.get("space", "left-posterior-superior")).lower()
    if space not in SPACES_TO_LPS:
        raise FormatError(f"'{path}' counts in '{space}'; expected left-posterior-superior")
    matrix = np.eye(4)
    if "space directions" in header:
        directions = np.asarray(header["space directions"], dtype=np.float64)
        matrix[:3, :3] = directions[~np.isnan(directions).any(axis=1)].T
    elif "spacings" in header:
        matrix[:3, :3] = np.diag(np.asarray(header["spacings"], dtype=np.float64)[-3:])
    matrix[:3, 3] = np.asarray(header.get("space origin", np.zeros(3)), dtype=np.float64)
    return np.diag([*SPACES_TO_LPS[space], 1.0]) @ matrix


def _settings_from_header(header: Mapping[str, Any]) -> dict[str, str]:
    settings = json.loads(header.get("sonosweep settings", "{}"))
    return {str(name): str(value) for name, value in settings.items()}
