"""The exact median of the pixels that fall into each voxel.

A median needs all its samples at once. The volume is therefore cut into slabs that hold
no more voxels and pixels than memory allows; each reads only the frames that meet it,
twice: once to count, once to collect.
"""

from concurrent.futures import ThreadPoolExecutor, as_completed

import numpy as np
from jaxtyping import Float, Shaped, UInt8

from sonosweep.estimators.estimator import Progress
from sonosweep.reconstruct import forward_kernels as kernels
from sonosweep.reconstruct.accumulators import Insertion
from sonosweep.reconstruct.blocks import read_blocks
from sonosweep.reconstruct.slab import Slab, halve
from sonosweep.scan import Frames, FrameView, VolumeGrid

SLAB_VOXELS = 2**21
SAMPLE_BYTES = 2**26
"""Memory for the samples of one slab; a slab of one voxel may exceed it."""


def compound_median(
    frames: Frames,
    transforms: Float[np.ndarray, "frames 3 3"],
    runs: tuple[np.ndarray, np.ndarray],
    insertion: Insertion,
    grid: VolumeGrid,
    voxels: Shaped[np.ndarray, "depth rows columns channels"],
    coverage: UInt8[np.ndarray, "depth rows columns"],
    threads: int,
    progress: Progress | None = None,
) -> None:
    """Fill ``voxels`` with medians and ``coverage`` with counts of samples.

    The median of an even number of samples is the mean of the middle two, rounded for
    integer voxels.

    Args:
        frames: Frames of any supported type.
        transforms: Pixel to voxel, per frame.
        runs: Pixels to use.
        insertion: Which pixels count, and of what kind they are.
        grid: Where the voxels are.
        voxels: To fill, zeros at first.
        coverage: To fill, zeros at first.
        threads: Slabs worked on at the same time.
        progress: Called with the slabs done and the number of slabs.
    """

    def fill(slab: Slab) -> None:
        chosen = _frames_that_meet(slab, frames.shape, transforms)
        if chosen.size == 0:
            return
        view, matrices = FrameView(frames, indices=chosen), transforms[chosen]
        stop = _last_samples(view, matrices, runs, insertion, slab)
        pixel_bytes = insertion.dtype.itemsize * insertion.channels
        if int(stop[-1]) * pixel_bytes > SAMPLE_BYTES and stop.size > 1:
            for half in halve(slab):
                fill(half)
            return
        samples = _collect(view, matrices, runs, insertion, slab, stop)
        kernels.finish_medians(stop, samples, insertion.rounding, *slab.edges, voxels, coverage)

    slabs = _small_slabs(Slab((0, 0, 0), grid.size))
    with ThreadPoolExecutor(threads) as pool:
        tasks = [pool.submit(fill, slab) for slab in slabs]
        for done, task in enumerate(as_completed(tasks), start=1):
            task.result()
            if progress is not None:
                progress(done, len(slabs))


def _small_slabs(slab: Slab) -> list[Slab]:
    if int(np.prod(slab.shape())) <= SLAB_VOXELS:
        return [slab]
    return [small for half in halve(slab) for small in _small_slabs(half)]


def _frames_that_meet(
    slab: Slab, shape: tuple[int, ...], transforms: Float[np.ndarray, "frames 3 3"]
) -> np.ndarray:
    """Indices of frames whose bounding box meets the slab."""
    right, bottom = shape[2] - 1, shape[1] - 1
    corners = np.array([[0, 0, 1], [right, 0, 1], [0, bottom, 1], [right, bottom, 1.0]])
    points = np.einsum("fij,cj->fci", transforms, corners)
    low, high = slab.edges
    meets = (points.max(axis=1) >= low - 1) & (points.min(axis=1) <= high)
    return np.flatnonzero(meets.all(axis=1))


def _last_samples(
    frames: Frames,
    transforms: Float[np.ndarray, "frames 3 3"],
    runs: tuple[np.ndarray, np.ndarray],
    insertion: Insertion,
    slab: Slab,
) -> np.ndarray:
    """One past the last sample of each voxel when samples are stored voxel by voxel."""
    count = np.zeros(int(np.prod(slab.shape())), np.int64)
    for block, pixels in read_blocks(frames):
        kernels.nearest_count(
            pixels.reshape(*pixels.shape[:3], -1),
            transforms[block],
            *runs,
            insertion.reject_below,
            *slab.edges,
            count,
        )
    return np.cumsum(count)


def _collect(
    frames: Frames,
    transforms: Float[np.ndarray, "frames 3 3"],
    runs: tuple[np.ndarray, np.ndarray],
    insertion: Insertion,
    slab: Slab,
    stop: np.ndarray,
) -> np.ndarray:
    """Samples ``(channels, samples)``, those of a voxel side by side."""
    samples = np.empty((insertion.channels, int(stop[-1])), insertion.dtype)
    following = np.concatenate(([0], stop[:-1]))
    for block, pixels in read_blocks(frames):
        kernels.nearest_collect(
            pixels.reshape(*pixels.shape[:3], -1),
            transforms[block],
            *runs,
            insertion.reject_below,
            *slab.edges,
            following,
            samples,
        )
    return samples
