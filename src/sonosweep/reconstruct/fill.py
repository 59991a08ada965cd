"""Fill voxels between frames that no pixel reached, up to a limited distance.

PLUS's names map to three methods of ours:

- ``stick`` (STICK): the shortest straight line through the hole, along one of the 13
  directions to neighboring voxels, that ends in seen voxels on both sides; the value is
  linear between them. It closes holes and never grows the volume outwards.
- ``nearest`` (NEAREST_NEIGHBOR): the value of the nearest seen voxel.
- ``inverse_distance`` (DISTANCE_WEIGHT_INVERSE, GAUSSIAN, GAUSSIAN_ACCUMULATION): mean of
  the seen voxels within reach, weighted by one over the squared distance.

The last two also fill a rim around the swept region. The gather engine needs none of them:
its radius grows with the gap between frames.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import product
from typing import Literal, no_type_check

import numpy as np
from numba import njit
from scipy.ndimage import maximum_filter

from sonosweep.errors import ScanError
from sonosweep.reconstruct.blocks import thread_count
from sonosweep.scan import Volume

FillMethod = Literal["stick", "nearest", "inverse_distance"]

STICK_VOXELS = 9
"""Longest stick in PLUS's own configurations."""
LARGEST_REACH_VOXELS = 64
BLOCK = 8


def fill_holes(
    volume: Volume,
    method: FillMethod = "stick",
    widest_mm: float | None = None,
    threads: int | None = None,
) -> Volume:
    """Return the volume with its holes filled; its coverage still says what was seen.

    Args:
        volume: With coverage.
        method: How; see the top of this module.
        widest_mm: Width of the widest hole to fill: a stick is no longer, and the other
            methods reach half as far. Nine voxels if ``None``.
        threads: As many as there are cores if ``None``.

    Raises:
        ScanError: If the volume has no coverage, or the width is not above 0 or is more
            than 128 voxels.
    """
    if volume.coverage is None:
        raise ScanError("holes can only be filled in a volume with coverage")
    spacing = np.array(volume.grid.spacing_mm)
    widest = STICK_VOXELS * float(spacing.max()) if widest_mm is None else widest_mm
    if not 0 < widest <= 2 * LARGEST_REACH_VOXELS * spacing.min():
        raise ScanError(
            f"holes of {widest:g} mm cannot be filled: give a width above 0 and up to"
            f" {2 * LARGEST_REACH_VOXELS * spacing.min():g} mm"
        )
    values = volume.voxels.reshape(*volume.coverage.shape, -1)
    filled = values.copy()
    rounding = 0.5 if np.issubdtype(values.dtype, np.integer) else 0.0
    reach = widest if method == "stick" else widest / 2
    blocks = _blocks_near_seen(volume.coverage, int(reach / spacing.min()) + 1)

    def work(part: np.ndarray) -> None:
        if method == "stick":
            _fill_sticks(part, volume.coverage, values, spacing, widest, rounding, filled)
        else:
            offsets, weights = _neighbors(spacing, reach)
            single = method == "nearest"
            _fill_mean(part, volume.coverage, values, offsets, weights, single, rounding, filled)

    threads = thread_count(threads)
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(work, (np.ascontiguousarray(blocks[k::threads]) for k in range(threads))))
    settings = {**volume.settings, "fill": method, "fill_mm": f"{widest:g}"}
    return replace(volume, voxels=filled.reshape(volume.voxels.shape), settings=settings)


def _blocks_near_seen(coverage: np.ndarray, reach: int) -> np.ndarray:
    """Corners (z, y, x) of the blocks of voxels that have a seen voxel within reach."""
    padding = [(0, -n % BLOCK) for n in coverage.shape]
    seen = np.pad(coverage > 0, padding)
    z, y, x = (n // BLOCK for n in seen.shape)
    any_seen = seen.reshape(z, BLOCK, y, BLOCK, x, BLOCK).any(axis=(1, 3, 5))
    near = maximum_filter(any_seen, size=2 * (-(-reach // BLOCK)) + 1)
    return np.argwhere(near) * BLOCK


def _neighbors(spacing: np.ndarray, reach_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """Offsets (z, y, x) within reach, nearest first, and one over their squared distance."""
    count = np.floor(reach_mm / spacing[::-1]).astype(int)
    offsets = np.stack(np.meshgrid(*(np.arange(-n, n + 1) for n in count), indexing="ij"), -1)
    offsets = offsets.reshape(-1, 3)
    squared = ((offsets * spacing[::-1]) ** 2).sum(axis=1)
    order = np.argsort(squared, kind="stable")
    order = order[(squared[order] > 0) & (squared[order] <= reach_mm**2)]
    return np.ascontiguousarray(offsets[order]), 1 / squared[order]


_DIRECTIONS = np.array([d for d in product((-1, 0, 1), repeat=3) if d > (0, 0, 0)], np.int64)


@njit(cache=True, nogil=True)
@no_type_check
def _distance_to_seen(coverage, z, y, x, step, longest):
    """Steps to the first seen voxel; 0 if there is none within ``longest`` steps."""
    for k in range(1, longest + 1):
        z, y, x = z + step[0], y + step[1], x + step[2]
        if not (
            0 <= z < coverage.shape[0] and 0 <= y < coverage.shape[1] and 0 <= x < coverage.shape[2]
        ):
            return 0
        if coverage[z, y, x] > 0:
            return k
    return 0


@njit(cache=True, nogil=True)
@no_type_check
def _shortest_stick(coverage, z, y, x, lengths, directions, widest):
    """Direction of the shortest stick and its steps to both ends; no steps if none fits."""
    best, chosen, ahead, behind = widest * (1 + 1e-9), 0, 0, 0
    for d in range(directions.shape[0]):
        longest = int(best / lengths[d])
        forward = _distance_to_seen(coverage, z, y, x, directions[d], longest - 1)
        if forward == 0:
            continue
        backward = _distance_to_seen(coverage, z, y, x, -directions[d], longest - forward)
        if backward > 0 and (forward + backward) * lengths[d] < best:
            best, chosen = (forward + backward) * lengths[d], d
            ahead, behind = forward, backward
    return chosen, ahead, behind


@njit(cache=True, nogil=True)
@no_type_check
def _fill_sticks(blocks, coverage, values, spacing, widest, rounding, filled):
    directions = _DIRECTIONS
    lengths = np.empty(directions.shape[0])
    for d in range(directions.shape[0]):
        z, y, x = directions[d]
        lengths[d] = np.sqrt((z * spacing[2]) ** 2 + (y * spacing[1]) ** 2 + (x * spacing[0]) ** 2)
    for b in range(blocks.shape[0]):
        for z in range(blocks[b, 0], min(blocks[b, 0] + BLOCK, coverage.shape[0])):
            for y in range(blocks[b, 1], min(blocks[b, 1] + BLOCK, coverage.shape[1])):
                for x in range(blocks[b, 2], min(blocks[b, 2] + BLOCK, coverage.shape[2])):
                    if coverage[z, y, x] > 0:
                        continue
                    d, ahead, behind = _shortest_stick(
                        coverage, z, y, x, lengths, directions, widest
                    )
                    if ahead == 0:
                        continue
                    dz, dy, dx = directions[d]
                    for channel in range(values.shape[3]):
                        front = values[z + ahead * dz, y + ahead * dy, x + ahead * dx, channel]
                        back = values[z - behind * dz, y - behind * dy, x - behind * dx, channel]
                        value = (np.float64(front) * behind + back * np.float64(ahead)) / (
                            ahead + behind
                        )
                        if rounding > 0:
                            value = np.floor(value + rounding)
                        filled[z, y, x, channel] = value


@njit(cache=True, nogil=True)
@no_type_check
def _fill_mean(blocks, coverage, values, offsets, weights, single, rounding, filled):
    total = np.empty(values.shape[3])
    for b in range(blocks.shape[0]):
        for z in range(blocks[b, 0], min(blocks[b, 0] + BLOCK, coverage.shape[0])):
            for y in range(blocks[b, 1], min(blocks[b, 1] + BLOCK, coverage.shape[1])):
                for x in range(blocks[b, 2], min(blocks[b, 2] + BLOCK, coverage.shape[2])):
                    if coverage[z, y, x] > 0:
                        continue
                    weight = _weigh(coverage, values, z, y, x, offsets, weights, single, total)
                    if weight == 0:
                        continue
                    for channel in range(values.shape[3]):
                        value = total[channel] / weight
                        if rounding > 0:
                            value = np.floor(value + rounding)
                        filled[z, y, x, channel] = value


@njit(cache=True, nogil=True)
@no_type_check
def _weigh(coverage, values, z, y, x, offsets, weights, single, total):
    """Sum the seen voxels within reach into ``total``; returns the sum of their weights."""
    total[:] = 0
    weight = 0.0
    for k in range(offsets.shape[0]):
        i, j, l = z + offsets[k, 0], y + offsets[k, 1], x + offsets[k, 2]  # noqa: E741
        if not (
            0 <= i < coverage.shape[0] and 0 <= j < coverage.shape[1] and 0 <= l < coverage.shape[2]
        ):
            continue
        if coverage[i, j, l] > 0:
            weight += weights[k]
            for channel in range(values.shape[3]):
                total[channel] += weights[k] * values[i, j, l, channel]
            if single:
                break
    return weight
