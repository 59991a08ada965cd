"""Gather compounding of a recorded sweep in little memory.

All poses are known, so it is known which block of frames is the last to touch a brick: then
the brick is finished, written to the output, and its memory serves another. What is held
beside the output are the bricks around the current frames, some megabytes.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sonosweep.errors import ScanError
from sonosweep.estimators.estimator import Progress
from sonosweep.reconstruct.blocks import (
    block_ranges,
    check_frames,
    in_turns,
    read_blocks,
    thread_count,
)
from sonosweep.reconstruct.bricks import BrickTable
from sonosweep.reconstruct.gather import check_confidence, gather_settings
from sonosweep.reconstruct.grid import check_memory, check_poses
from sonosweep.reconstruct.planes import axes_by_normal, planes_of_frames
from sonosweep.reconstruct.pools import Pool, pool_for
from sonosweep.reconstruct.sampling import Contribution, Sampling, sampling_of_frames
from sonosweep.scan import Frames, Volume, VolumeGrid

FIRST_SLOTS = 2**12


@runtime_checkable
class Output(Protocol):
    """Where finished bricks go."""

    def write(
        self,
        pool: Pool,
        slots: Int[np.ndarray, " bricks"],
        bricks: Int[np.ndarray, "bricks xyz=3"],
        workers: ThreadPoolExecutor,
        threads: int,
    ) -> None:
        """Write bricks and empty their slots."""


class DenseOutput:
    """The whole volume in memory, or in a file mapped to memory.

    Args:
        grid: Where the voxels are.
        dtype: Of the voxels.
        channels: Of the voxels.
    """

    def __init__(self, grid: VolumeGrid, dtype: np.dtype, channels: int) -> None:
        self.voxels = np.zeros((*grid.size[::-1], channels), dtype)
        self.coverage = np.zeros(grid.size[::-1], np.uint8)

    def write(
        self,
        pool: Pool,
        slots: Int[np.ndarray, " bricks"],
        bricks: Int[np.ndarray, "bricks xyz=3"],
        workers: ThreadPoolExecutor,
        threads: int,
    ) -> None:
        """Write bricks and empty their slots."""
        in_turns(
            lambda turn: pool.finish(
                slots, bricks, (turn, threads), True, self.voxels, self.coverage
            ),
            threads,
            workers,
        )


def compound_gather(
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
) -> Volume:
    """Return the volume gathered from a whole sweep.

    It is what :class:`sonosweep.reconstruct.gather.GatherCompounder` gives for these frames,
    bit by bit, in less memory and time.

    Args:
        frames: Frames, with channels or without, of a supported type, read a few at a time.
        image_to_reference: Pose of each.
        pixel_to_image: From (column, row, 0, 1) to image mm.
        grid: Where the voxels are.
        radius_mm: How far from its plane a frame counts. ``"auto"``: as far as the frame
            before it, at least two voxels and at most 3 mm.
        prefilter: Average squares of this many pixels first. ``"auto"``: as many as make
            a voxel, per direction.
        mask: Pixels to use; all if ``None``.
        reject_below: Leave out samples darker than this.
        confidence: Weight of each frame, from 0 (as if absent) to 1.
        threads: As many as there are cores if ``None``.
        progress: Called with the frames done and the number of frames.

    Raises:
        ScanError: If something does not fit, or no frame meets the grid.
    """
    check_frames(frames)
    channels = frames.shape[3] if len(frames.shape) == 4 else 1
    dtype = np.dtype(frames.dtype).newbyteorder("=")
    check_memory(grid, dtype.itemsize * channels)
    sampling = sampling_of_frames(
        grid, pixel_to_image, frames.shape[1], frames.shape[2], radius_mm, prefilter, mask
    )
    plan = plan_sweep(sampling, grid, image_to_reference, pixel_to_image, frames, confidence)
    output = DenseOutput(grid, dtype, channels)
    gather_into(output, plan, frames, reject_below, thread_count(threads), progress)
    return Volume(
        voxels=output.voxels if len(frames.shape) == 4 else output.voxels[..., 0],
        grid=grid,
        coverage=output.coverage,
        settings=gather_settings(sampling),
    )


@dataclass(frozen=True, eq=False)
class Plan:
    """Which frames meet which bricks, known before any pixel is read.

    Attributes:
        sampling: How frames are sampled.
        order: Axes of the volume from the slowest in a brick to the fastest.
        blocks: Frames that are gathered together.
        bricks: All bricks (x, y, z) that frames meet, in order of first touch.
        contributions: Of each block of frames.
        touched: How many bricks were touched after each block.
        last_block: Of each brick, the last block that touches it.
    """

    sampling: Sampling
    order: Int[np.ndarray, "axes=3"]
    blocks: list[slice]
    bricks: Int[np.ndarray, "bricks xyz=3"]
    contributions: list[Contribution]
    touched: list[int]
    last_block: Int[np.ndarray, " bricks"]


def plan_sweep(
    sampling: Sampling,
    grid: VolumeGrid,
    image_to_reference: Float[Tensor, "frames 4 4"],
    pixel_to_image: Float[Tensor, "4 4"],
    frames: Frames,
    confidence: Float[Tensor, " frames"] | None = None,
) -> Plan:
    """Return which frames meet which bricks.

    Raises:
        ScanError: If counts differ, a pose or confidence is bad, or no frame meets the grid.
    """
    check_poses(image_to_reference)
    if len(frames) != len(image_to_reference):
        raise ScanError(f"{len(frames)} frames but {len(image_to_reference)} poses")
    weight = check_confidence(confidence, len(frames))
    planes = planes_of_frames(image_to_reference, pixel_to_image)
    order = axes_by_normal(planes, grid)
    gaps = sampling.gaps_mm(planes)
    radii = sampling.radii_mm(np.concatenate(([0.0], gaps)))
    table = BrickTable(grid)
    blocks = block_ranges(frames, _voxels_per_frame(sampling, grid, pixel_to_image, gaps))
    contributions, touched = [], []
    for k in blocks:
        contributions.append(sampling.contribution(planes[k], radii[k], weight[k], order, table))
        touched.append(len(table))
    if len(table) == 0:
        raise ScanError("no frame of the sweep meets the grid: check its origin and the poses")
    last_block = np.zeros(len(table), np.int64)
    for block, part in enumerate(contributions):
        last_block[part.numbers] = block
    return Plan(sampling, order, blocks, table.bricks, contributions, touched, last_block)


def _voxels_per_frame(
    sampling: Sampling,
    grid: VolumeGrid,
    pixel_to_image: Float[Tensor, "4 4"],
    gaps_mm: Float[np.ndarray, " steps"],
) -> float:
    """Return about how many voxels lie between a frame and the next, one layer at least."""
    across, down = pixel_to_image[:3, :2].norm(dim=0).tolist()
    gap = max(float(np.median(gaps_mm)) if len(gaps_mm) else 0.0, min(grid.spacing_mm))
    frame_mm3 = sampling.columns * across * sampling.rows * down * gap
    return max(frame_mm3 / float(np.prod(grid.spacing_mm)), 1.0)


def gather_into(
    output: Output,
    plan: Plan,
    frames: Frames,
    reject_below: float | None,
    threads: int,
    progress: Progress | None = None,
) -> None:
    """Gather a planned sweep into an output, brick by finished brick."""
    channels = frames.shape[3] if len(frames.shape) == 4 else 1
    dtype = np.dtype(frames.dtype).newbyteorder("=")
    pool = pool_for(dtype, channels, plan.sampling, reject_below, plan.order, FIRST_SLOTS)
    slots = _Slots(plan, pool)
    # Neighbors along the fastest axis follow each other: they share lines of the cache.
    fast, mid, slow = (plan.bricks[:, axis] for axis in plan.order[::-1])
    by_last_block = np.lexsort((fast, mid, slow, plan.last_block))
    blocks = np.arange(len(plan.contributions) + 1)
    ends = np.searchsorted(plan.last_block[by_last_block], blocks)
    with ThreadPoolExecutor(threads) as workers:
        for k, (block, pixels) in enumerate(read_blocks(frames, plan.blocks)):
            slots.take(plan.touched[k])

            def add(turn: int, pixels: np.ndarray = pixels, k: int = k) -> int:
                part = plan.contributions[k]
                return pool.add(pixels, part, plan.bricks, slots.slot_of, (turn, threads), 1)

            in_turns(add, threads, workers)
            finished = by_last_block[ends[k] : ends[k + 1]]
            places = slots.give_back(finished)
            output.write(pool, places, plan.bricks[finished], workers, threads)
            if progress is not None:
                progress(block.stop, len(frames))


class _Slots:
    """Which slot of the pool a brick has while frames touch it."""

    def __init__(self, plan: Plan, pool: Pool) -> None:
        self.slot_of = np.full(len(plan.bricks), -1, np.int32)
        self._pool = pool
        self._free = np.arange(FIRST_SLOTS, dtype=np.int32)
        self._room = FIRST_SLOTS
        self._started = 0

    def take(self, touched: int) -> None:
        """Give slots to the bricks touched for the first time, up to number ``touched``."""
        new = touched - self._started
        if new > len(self._free):
            more = max(new - len(self._free), self._room)
            self._pool.reserve(self._room + more)
            added = np.arange(self._room, self._room + more, dtype=np.int32)
            self._free = np.concatenate((self._free, added))
            self._room += more
        self.slot_of[self._started : touched] = self._free[:new]
        self._free = self._free[new:]
        self._started = touched

    def give_back(self, finished: Int[np.ndarray, " bricks"]) -> Int[np.ndarray, " bricks"]:
        """Return the slots of bricks that are finished, to be emptied before the next take."""
        places = self.slot_of[finished]
        # The last used are the first to serve again: they are still in the cache.
        self._free = np.concatenate((places, self._free))
        return places
