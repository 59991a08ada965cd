"""Forward compounding: every pixel goes to the voxels it falls on, in PLUS's words.

Interpolation ``nearest`` gives a pixel to one voxel, ``linear`` shares it among the eight
around it. Compounding says what a voxel makes of its pixels: their mean, the latest, the
maximum, or their median. Voxels between the frames stay empty: see
:mod:`sonosweep.reconstruct.gather` for the engine that fills them.

Differs:
    PLUS's mean truncates to an integer at every insertion and comes out up to three gray
    levels dark; ours are exact sums, rounded once.
"""

from concurrent.futures import ThreadPoolExecutor
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float
from torch import Tensor

from sonosweep.errors import ScanError
from sonosweep.estimators.estimator import Progress
from sonosweep.reconstruct.accumulators import (
    Accumulator,
    Insertion,
    PackedMean,
    Replacing,
    SumMean,
)
from sonosweep.reconstruct.blocks import check_frames, in_turns, read_blocks, thread_count
from sonosweep.reconstruct.clip import pixel_runs
from sonosweep.reconstruct.grid import check_memory, check_poses, pixel_to_voxel
from sonosweep.reconstruct.median import compound_median
from sonosweep.reconstruct.slab import Slab, split_grid
from sonosweep.scan import Frames, Volume, VolumeGrid

Interpolation = Literal["nearest", "linear"]
Compounding = Literal["mean", "latest", "maximum", "median"]


def compound_forward(
    frames: Frames,
    image_to_reference: Float[Tensor, "frames 4 4"],
    pixel_to_image: Float[Tensor, "4 4"],
    grid: VolumeGrid,
    *,
    interpolation: Interpolation = "nearest",
    compounding: Compounding = "mean",
    mask: Bool[np.ndarray, "rows columns"] | None = None,
    reject_below: float | None = None,
    threads: int | None = None,
    progress: Progress | None = None,
) -> Volume:
    """Return the volume in which every pixel was put where its frame's pose says.

    The result is the same for any number of threads.

    Args:
        frames: Frames, with channels or without, of a supported type.
        image_to_reference: Pose of each.
        pixel_to_image: From (column, row, 0, 1) to image mm.
        grid: Where the voxels are.
        interpolation: ``"nearest"`` or ``"linear"``. With ``latest`` and ``maximum``, linear
            means that a pixel counts for those of the eight voxels around it for which its
            weight is an eighth or more.
        compounding: What a voxel makes of its pixels.
        mask: Pixels to use; all if ``None``.
        reject_below: Leave out pixels darker than this (all channels).
        threads: As many as there are cores if ``None``.
        progress: Called with the frames done and the number of frames.

    Raises:
        ScanError: If the poses or frames are unusable, memory would not do, no pixel falls
            into the grid, or the median is asked for with linear interpolation.
    """
    check_frames(frames)
    check_poses(image_to_reference)
    if len(frames) != len(image_to_reference):
        raise ScanError(f"{len(frames)} frames but {len(image_to_reference)} poses")
    if compounding == "median" and interpolation == "linear":
        raise ScanError("the median is over whole pixels: use nearest interpolation with it")
    threads = thread_count(threads)
    runs = pixel_runs(np.ones(frames.shape[1:3], dtype=bool) if mask is None else mask)
    transforms = pixel_to_voxel(image_to_reference, pixel_to_image, grid)
    insertion = Insertion(
        linear=interpolation == "linear",
        dtype=np.dtype(frames.dtype).newbyteorder("="),
        channels=frames.shape[3] if len(frames.shape) == 4 else 1,
        reject_below=-np.inf if reject_below is None else float(reject_below),
    )
    voxel_bytes = insertion.dtype.itemsize * insertion.channels
    check_memory(grid, voxel_bytes, _working_bytes(insertion, compounding))
    voxels = np.zeros((*grid.size[::-1], insertion.channels), insertion.dtype)
    coverage = np.zeros(grid.size[::-1], np.uint8)
    if compounding == "median":
        compound_median(
            frames, transforms, runs, insertion, grid, voxels, coverage, threads, progress
        )
    else:
        slabs = split_grid(grid, transforms, threads)
        parts = [_accumulator(slab, insertion, compounding) for slab in slabs]

        with ThreadPoolExecutor(threads) as pool:
            for block, pixels in read_blocks(frames):

                def add(part: int, block: slice = block, pixels: np.ndarray = pixels) -> None:
                    parts[part].add(pixels, transforms[block], *runs)

                in_turns(add, len(parts), pool)
                if progress is not None:
                    progress(block.stop, len(frames))
            in_turns(lambda part: parts[part].finish(voxels, coverage), len(parts), pool)
    if not coverage.any():
        raise ScanError("no pixel of the sweep falls into the grid: check its origin and the poses")
    return Volume(
        voxels=voxels if len(frames.shape) == 4 else voxels[..., 0],
        grid=grid,
        coverage=coverage,
        settings={
            "method": "forward",
            "interpolation": interpolation,
            "compounding": compounding,
        },
    )


def _accumulator(slab: Slab, insertion: Insertion, compounding: Compounding) -> Accumulator:
    """What the voxels of a slab keep while frames come in."""
    if compounding == "mean":
        return PackedMean(slab, insertion) if _packs(insertion) else SumMean(slab, insertion)
    return Replacing(slab, insertion, maximum=compounding == "maximum")


def _packs(insertion: Insertion) -> bool:
    return insertion.dtype == np.uint8 and insertion.channels == 1


def _working_bytes(insertion: Insertion, compounding: Compounding) -> int:
    """What a voxel takes besides its result."""
    if compounding == "median":
        return 0  # works slab by slab, each of fixed size
    if compounding != "mean":
        return insertion.dtype.itemsize * insertion.channels + 1
    if _packs(insertion):
        return 8 if insertion.linear else 4
    return 8 + 8 * insertion.channels
