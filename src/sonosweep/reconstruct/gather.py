"""Gather compounding: every voxel asks which frames pass near it.

A voxel is the mean of the frames within a radius of it, each sampled between its pixels and
weighted by distance, from 1 in the plane of the frame to 0 at the radius. The radius of a
frame grows with the gap to the frame before it, so nothing between frames stays empty and
no hole is to be filled afterwards. Frames are first averaged over boxes of pixels the size
of a voxel, because a voxel samples one point of a frame and would ignore the other pixels.

Sums are exact: neither the order of frames nor the number of threads changes a bit, and a
frame can be taken out again.
"""

import math
import zlib
from collections import defaultdict
from concurrent.futures import ThreadPoolExecutor
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Shaped
from torch import Tensor, as_tensor, float64

from sonosweep.errors import ScanError
from sonosweep.reconstruct.blocks import (
    check_dtype,
    contiguous,
    in_turns,
    read_blocks,
    thread_count,
)
from sonosweep.reconstruct.bricks import BrickTable
from sonosweep.reconstruct.grid import check_memory, check_poses
from sonosweep.reconstruct.planes import Planes, axes_by_normal, planes_of_frames
from sonosweep.reconstruct.pools import Pool, pool_for
from sonosweep.reconstruct.sampling import Sampling, check_radius, sampling_of_frames
from sonosweep.scan import Volume, VolumeGrid

RESERVED_BRICKS = 2**17
"""Room for bricks at the start, half a gigabyte of addresses: copying is what delays frames."""


class GatherCompounder:
    """A volume that grows frame by frame, and forgets frames on request.

    One frame at a time or many give the same bits.

    Args:
        grid: Where the voxels are.
        pixel_to_image: From (column, row, 0, 1) to image mm.
        frame_shape: Rows and columns, and channels if there are several.
        dtype: Of the pixels.
        radius_mm: How far from its plane a frame counts. ``"auto"``: as far as the frame
            before it, at least two voxels and at most 3 mm.
        prefilter: Average squares of this many pixels first. ``"auto"``: as many as make
            a voxel, per direction.
        mask: Pixels to use; all if ``None``.
        reject_below: Leave out samples darker than this.
        threads: As many as there are cores if ``None``; single frames take one.

    Raises:
        ScanError: If a setting is out of range, or the dense volume would not fit in memory.
    """

    def __init__(
        self,
        grid: VolumeGrid,
        pixel_to_image: Float[Tensor, "4 4"],
        frame_shape: tuple[int, ...],
        dtype: np.dtype | type = np.uint8,
        *,
        radius_mm: float | Literal["auto"] = "auto",
        prefilter: int | Literal["auto"] = "auto",
        mask: Bool[np.ndarray, "rows columns"] | None = None,
        reject_below: float | None = None,
        threads: int | None = None,
    ) -> None:
        check_dtype(np.dtype(dtype))
        self._dtype = np.dtype(dtype).newbyteorder("=")
        self._shape = tuple(frame_shape)
        self._channels = self._shape[2] if len(self._shape) == 3 else 1
        check_memory(grid, self._dtype.itemsize * self._channels)
        self._grid = grid
        self._pixel_to_image = pixel_to_image
        self._sampling = sampling_of_frames(
            grid, pixel_to_image, self._shape[0], self._shape[1], radius_mm, prefilter, mask
        )
        self._reject_below = reject_below
        self._threads = thread_count(threads)
        self._table = BrickTable(grid)
        self._slots = np.arange(2**12, dtype=np.int32)  # a brick's number is its slot
        self._pool: Pool | None = None  # made when the first frame shows its direction
        self._order = np.arange(3)
        self._last: Planes | None = None
        self._added: dict[tuple, list[tuple[float, float]]] = defaultdict(list)
        self._halved = 0

    def add(
        self,
        frames: Shaped[np.ndarray, "..."],
        image_to_reference: Float[Tensor, "*frames 4 4"],
        confidence: Float[Tensor, " frames"] | float | None = None,
        radius_mm: float | None = None,
    ) -> None:
        """Add one frame, or several in the order in which they were recorded.

        Args:
            frames: One frame, or a stack.
            image_to_reference: One pose, or one per frame.
            confidence: Weight of each frame, from 0 (as if absent) to 1.
            radius_mm: How far these frames count, where the rule of the volume does not
                apply: a frame that is put back among earlier ones has another frame
                before it than the one added last.

        Raises:
            ScanError: If shapes, type, poses, confidences or the radius do not fit.
        """
        stack, poses = self._checked(frames, image_to_reference)
        weight = check_confidence(confidence, len(stack))
        planes = planes_of_frames(poses, self._pixel_to_image)
        if radius_mm is None:
            known = planes if self._last is None else np.concatenate((self._last, planes))
            gaps = self._sampling.gaps_mm(known)
            radii = self._sampling.radii_mm(gaps if len(gaps) == len(stack) else [0.0, *gaps])
        else:
            check_radius(radius_mm, self._grid)
            radii = np.full(len(stack), radius_mm)
        self._last = planes[-1:]
        for key, *how in zip(_keys(stack, poses), radii.tolist(), weight.tolist(), strict=True):
            self._added[key].append((how[0], how[1]))
        self._accumulate(stack, planes, radii, weight, sign=1)

    def remove(
        self,
        frames: Shaped[np.ndarray, "..."],
        image_to_reference: Float[Tensor, "*frames 4 4"],
    ) -> None:
        """Take frames out again, exactly: as if they had never been added.

        With a better pose for a frame, remove it at the old one and add it at the new one.
        The radius of a later frame does not change: it is that of the gap when it came.

        Args:
            frames: As they were added.
            image_to_reference: As they were added.

        Raises:
            ScanError: If such a frame was not added at that pose, or so many frames were
                added in one place that sums had to be halved.
        """
        stack, poses = self._checked(frames, image_to_reference)
        if self._halved:
            raise ScanError(
                "frames can no longer be taken out: more than 8000 were added in one place;"
                " start a new volume"
            )
        keys = _keys(stack, poses)
        left = {key: len(self._added.get(key, ())) for key in keys}
        for number, key in enumerate(keys):
            left[key] -= 1
            if left[key] < 0:
                raise ScanError(
                    f"frame {number} of those to take out was not added at this pose, or has"
                    " been taken out before"
                )
        how = np.array([self._added[key].pop() for key in keys])
        planes = planes_of_frames(poses, self._pixel_to_image)
        self._accumulate(stack, planes, how[:, 0], how[:, 1], sign=-1)
        if not any(self._added.values()):
            self._last = None

    def volume(self) -> Volume:
        """Return what the frames added so far make; voxels that none reached are 0."""
        size = self._grid.size[::-1]
        voxels = np.zeros((*size, self._channels), self._dtype)
        coverage = np.zeros(size, np.uint8)
        if self._pool is not None:
            pool, bricks = self._pool, self._table.bricks
            slots = self._slots[: len(bricks)]
            with ThreadPoolExecutor(self._threads) as workers:
                in_turns(
                    lambda turn: pool.finish(
                        slots, bricks, (turn, self._threads), False, voxels, coverage
                    ),
                    self._threads,
                    workers,
                )
        return Volume(
            voxels=voxels if len(self._shape) == 3 else voxels[..., 0],
            grid=self._grid,
            coverage=coverage,
            settings=gather_settings(self._sampling),
        )

    def _checked(self, frames: np.ndarray, image_to_reference: Tensor) -> tuple[np.ndarray, Tensor]:
        stack = frames[None] if frames.shape == self._shape else frames
        poses = image_to_reference[None] if image_to_reference.ndim == 2 else image_to_reference
        poses = poses.detach().to(float64)
        if stack.shape[1:] != self._shape or stack.dtype.newbyteorder("=") != self._dtype:
            raise ScanError(
                f"frames of shape {frames.shape} and type {frames.dtype} in a volume of frames of"
                f" shape {self._shape} and type {self._dtype}"
            )
        if len(stack) != len(poses):
            raise ScanError(f"{len(stack)} frames but {len(poses)} poses")
        check_poses(poses)
        return stack, poses

    def _accumulate(
        self, stack: np.ndarray, planes: Planes, radii: np.ndarray, weight: np.ndarray, sign: int
    ) -> None:
        if self._pool is None:
            self._order = axes_by_normal(planes[:1], self._grid)
            room = min(math.prod(-(-n // 8) for n in self._grid.size), RESERVED_BRICKS)
            self._pool = pool_for(
                self._dtype, self._channels, self._sampling, self._reject_below, self._order, room
            )
        pool, order = self._pool, self._order

        def add(
            block: np.ndarray, k: slice, threads: int, workers: ThreadPoolExecutor | None
        ) -> None:
            part = self._sampling.contribution(planes[k], radii[k], weight[k], order, self._table)
            bricks = self._table.bricks
            pool.reserve(len(bricks))
            if len(self._slots) < len(bricks):
                self._slots = np.arange(2 * len(bricks), dtype=np.int32)
            slots = self._slots
            self._halved += sum(
                in_turns(
                    lambda turn: pool.add(block, part, bricks, slots, (turn, threads), sign),
                    threads,
                    workers,
                )
            )

        if len(stack) == 1:  # starting threads would take longer than the frame
            add(contiguous(stack), slice(0, 1), 1, None)
            return
        with ThreadPoolExecutor(self._threads) as workers:
            for k, block in read_blocks(stack):
                add(block, k, self._threads, workers)


def gather_settings(sampling: Sampling) -> dict[str, str]:
    """Return how a volume was gathered, by name."""
    radius = "auto" if sampling.radius_mm is None else f"{sampling.radius_mm:g}"
    rows, columns = sampling.box.tolist()
    return {"method": "gather", "radius_mm": radius, "prefilter": f"{rows} x {columns}"}


def _keys(stack: np.ndarray, poses: Tensor) -> list[tuple]:
    """What tells a frame at its pose from others."""
    return [
        (zlib.crc32(np.ascontiguousarray(frame).data), pose.tobytes())
        for frame, pose in zip(stack, poses.numpy(), strict=True)
    ]


def check_confidence(
    confidence: Float[Tensor, " frames"] | float | None, frames: int
) -> Float[np.ndarray, " frames"]:
    """Return the weight of each frame.

    Raises:
        ScanError: If the count differs or a weight is not between 0 and 1.
    """
    if confidence is None:
        return np.ones(frames)
    weight: np.ndarray = as_tensor(confidence, dtype=float64).numpy()
    if weight.ndim and weight.shape != (frames,):
        raise ScanError(f"{frames} frames but {weight.size} confidences")
    if not ((weight >= 0) & (weight <= 1)).all():
        raise ScanError("the confidence of a frame must be between 0 and 1")
    return np.broadcast_to(weight, frames).copy()
