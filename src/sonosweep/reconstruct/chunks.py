"""Volumes too large for memory: chunks on disk, of which only the touched ones exist.

The folder is a Zarr version 2 group with the arrays ``voxels`` and ``coverage``, axes
``(z, y, x)`` and perhaps channels, which Zarr libraries and napari open as they are. Chunks
are raw and of 64 voxels along each axis; a chunk that no frame touched has no file and
reads as 0. The place of the volume is in the group's attributes, in mm.
"""

import json
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sonosweep.errors import FormatError, ScanError
from sonosweep.estimators.estimator import Progress
from sonosweep.io.atomic_folder import staged_folder
from sonosweep.reconstruct.blocks import check_frames, in_turns, thread_count
from sonosweep.reconstruct.pools import Pool
from sonosweep.reconstruct.retire import gather_into, plan_sweep
from sonosweep.reconstruct.sampling import sampling_of_frames
from sonosweep.scan import Frames, Volume, VolumeGrid

CHUNK = 64
BRICKS_ALONG = CHUNK // 8


def compound_to_chunks(
    folder: str | os.PathLike,
    frames: Frames,
    image_to_reference: Float[Tensor, "frames 4 4"],
    pixel_to_image: Float[Tensor, "4 4"],
    grid: VolumeGrid,
    *,
    radius_mm: float | Literal["auto"] = "auto",
    prefilter: int | Literal["auto"] = "auto",
    mask: Bool[np.ndarray, "rows columns"] | None = None,
    reject_below: float | None = None,
    confidence: Float[Tensor, " frames"] | None = None,
    threads: int | None = None,
    progress: Progress | None = None,
) -> None:
    """Write the volume gathered from a sweep as chunks into a new folder.

    Memory stays at some tens of MB whatever the size of the grid. Voxels are those of
    :func:`sonosweep.reconstruct.retire.compound_gather`, whose arguments these are.

    Raises:
        ScanError: As there.
        FormatError: If the folder exists, or cannot be written to.
    """
    target = Path(folder)
    if target.exists():
        raise FormatError(f"'{target}' exists already: give another name or remove it")
    check_frames(frames)
    sampling = sampling_of_frames(
        grid, pixel_to_image, frames.shape[1], frames.shape[2], radius_mm, prefilter, mask
    )
    plan = plan_sweep(sampling, grid, image_to_reference, pixel_to_image, frames, confidence)
    with staged_folder(target) as temporary:
        output = ChunkOutput(temporary, grid, np.dtype(frames.dtype), frames.shape[3:], plan.bricks)
        gather_into(output, plan, frames, reject_below, thread_count(threads), progress)


def read_chunks(
    folder: str | os.PathLike,
    low: tuple[int, int, int] = (0, 0, 0),
    high: tuple[int, int, int] | None = None,
) -> Volume:
    """Return the voxels from ``low`` up to, not including, ``high`` (x, y, z).

    Raises:
        FormatError: If the folder is none of ours, or a chunk is damaged.
        ScanError: If the part is empty or outside the volume.
    """
    source = Path(folder)
    try:
        attributes = json.loads((source / ".zattrs").read_text())
        whole = VolumeGrid(**{key: _tuples(value) for key, value in attributes["grid"].items()})
        header = json.loads((source / "voxels" / ".zarray").read_text())
        dtype, shape = np.dtype(header["dtype"]), header["shape"]
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise FormatError(f"'{source}' is not a folder of volume chunks: {error}") from error
    high = whole.size if high is None else high
    if not all(0 <= a < b <= n for a, b, n in zip(low, high, whole.size, strict=True)):
        raise ScanError(f"voxels {low} to {high} are not part of a volume of {whole.size}")
    size = tuple(b - a for a, b in zip(low, high, strict=True))
    direction = np.asarray(whole.direction)
    shift = direction @ (np.array(low) * whole.spacing_mm)
    origin = tuple((np.array(whole.origin_mm) + shift).tolist())
    part = VolumeGrid(size, whole.spacing_mm, origin, whole.direction)  # type: ignore[arg-type]
    return Volume(
        voxels=_read_array(source / "voxels", dtype, tuple(shape[3:]), low, high),
        grid=part,
        coverage=_read_array(source / "coverage", np.dtype(np.uint8), (), low, high),
    )


class ChunkOutput:
    """Gathers finished bricks into chunks and writes each chunk when it is complete.

    Args:
        folder: An empty folder.
        grid: Where the voxels are.
        dtype: Of the voxels.
        channels: Empty, or their number.
        bricks: All bricks (x, y, z) that will be written.
    """

    def __init__(
        self,
        folder: Path,
        grid: VolumeGrid,
        dtype: np.dtype,
        channels: tuple[int, ...],
        bricks: Int[np.ndarray, "bricks xyz=3"],
    ) -> None:
        self._folder = folder
        self._dtype = dtype.newbyteorder("<")
        self._channels = channels
        self._open: dict[tuple, tuple[np.ndarray, np.ndarray]] = {}
        chunks, counts = np.unique(bricks // BRICKS_ALONG, axis=0, return_counts=True)
        self._missing = dict(zip(map(tuple, chunks.tolist()), counts.tolist(), strict=True))
        _write_headers(folder, grid, self._dtype, channels)

    def write(
        self,
        pool: Pool,
        slots: Int[np.ndarray, " bricks"],
        bricks: Int[np.ndarray, "bricks xyz=3"],
        workers: ThreadPoolExecutor,
        threads: int,
    ) -> None:
        """Put bricks into their chunks; a chunk that has all of them goes to disk."""
        chunks, which = np.unique(bricks // BRICKS_ALONG, axis=0, return_inverse=True)

        def fill(k: int) -> None:
            chosen = which.reshape(-1) == k
            corner = chunks[k] * BRICKS_ALONG
            voxels, coverage = self._chunk(tuple(chunks[k].tolist()))
            places = np.ascontiguousarray(bricks[chosen] - corner)
            pool.finish(slots[chosen], places, (0, 1), True, voxels, coverage)
            self._close(tuple(chunks[k].tolist()), int(chosen.sum()))

        in_turns(fill, len(chunks), workers)

    def _chunk(self, chunk: tuple) -> tuple[np.ndarray, np.ndarray]:
        if chunk not in self._open:
            voxels = np.zeros((CHUNK, CHUNK, CHUNK, *(self._channels or (1,))), self._dtype)
            self._open[chunk] = (voxels, np.zeros((CHUNK, CHUNK, CHUNK), np.uint8))
        return self._open[chunk]

    def _close(self, chunk: tuple, bricks: int) -> None:
        self._missing[chunk] -= bricks
        if self._missing[chunk] > 0:
            return
        voxels, coverage = self._open.pop(chunk)
        name = ".".join(str(k) for k in chunk[::-1])
        (self._folder / "voxels" / (name + ".0" * len(self._channels))).write_bytes(voxels.data)
        (self._folder / "coverage" / name).write_bytes(coverage.data)


def _write_headers(
    folder: Path, grid: VolumeGrid, dtype: np.dtype, channels: tuple[int, ...]
) -> None:
    (folder / ".zgroup").write_text(json.dumps({"zarr_format": 2}))
    (folder / ".zattrs").write_text(json.dumps({"grid": asdict(grid), "unit": "mm"}))
    arrays: dict[str, tuple[np.dtype, tuple[int, ...]]] = {
        "voxels": (dtype, channels),
        "coverage": (np.dtype(np.uint8), ()),
    }
    for name, (kind, last) in arrays.items():
        (folder / name).mkdir()
        header = {
            "zarr_format": 2,
            "shape": [*grid.size[::-1], *last],
            "chunks": [CHUNK, CHUNK, CHUNK, *last],
            "dtype": kind.str,
            "fill_value": 0,
            "order": "C",
            "compressor": None,
            "filters": None,
        }
        (folder / name / ".zarray").write_text(json.dumps(header))


def _read_array(
    folder: Path, dtype: np.dtype, channels: tuple[int, ...], low: tuple, high: tuple
) -> np.ndarray:
    shape = tuple(b - a for a, b in zip(low[::-1], high[::-1], strict=True))
    result = np.zeros((*shape, *channels), dtype.newbyteorder("="))
    begin, end = np.array(low[::-1]), np.array(high[::-1])
    for chunk in np.ndindex(*(-(-end // CHUNK) - begin // CHUNK)):
        place = begin // CHUNK + np.array(chunk)
        path = folder / (".".join(str(k) for k in place) + ".0" * len(channels))
        if not path.exists():
            continue
        raw = np.fromfile(path, dtype)
        if raw.size != CHUNK**3 * int(np.prod(channels)):
            raise FormatError(f"'{path}' is damaged: {raw.nbytes} bytes are not a chunk")
        voxels = raw.reshape(CHUNK, CHUNK, CHUNK, *channels)
        first = np.maximum(begin, place * CHUNK)
        last = np.minimum(end, (place + 1) * CHUNK)
        inner = tuple(slice(a, b) for a, b in zip(first - begin, last - begin, strict=True))
        outer = zip(first - place * CHUNK, last - place * CHUNK, strict=True)
        result[inner] = voxels[tuple(slice(a, b) for a, b in outer)]
    return result


def _tuples(value: Any) -> Any:  # whatever JSON holds
    return tuple(_tuples(item) for item in value) if isinstance(value, list) else value
