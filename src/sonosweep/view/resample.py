"""Volumes with fewer voxels, for pictures and for the page."""

import numpy as np
from scipy.sparse import csr_array

from sonosweep.scan import Volume, VolumeGrid, voxel_to_reference


def resample_volume(volume: Volume, max_voxels: int) -> Volume:
    """Return the volume averaged into at most ``max_voxels`` larger voxels, without channels.

    It covers the same box. Axes that are sampled finer than the others are thinned first.
    A volume that is small enough keeps its voxels and their type; others become float32.
    """
    grid = volume.grid
    size = _smaller_size(grid, max_voxels)
    if size == grid.size:
        return Volume(scalar(volume.voxels), grid)
    means = [_box_means(many, few) for many, few in zip(grid.size, size, strict=True)]
    voxels = np.zeros(size[::-1], np.float32)
    for z, shares in enumerate(means[2].T.tocsr()):
        values = finite(scalar(np.asarray(volume.voxels[z : z + 1]))[0]).astype(np.float32)
        thinned = (means[0] @ (means[1] @ values).T).T
        for target, share in zip(shares.indices, shares.data, strict=True):
            voxels[target] += share * thinned
    return Volume(voxels, _same_box(grid, size))


def scalar(voxels: np.ndarray) -> np.ndarray:
    """Return the brightness of voxels ``(z, y, x, channels)``: their mean; others as they are."""
    return voxels.mean(axis=-1, dtype=np.float32) if voxels.ndim == 4 else np.asarray(voxels)


def finite(values: np.ndarray) -> np.ndarray:
    """Return values with 0 for what is not a number or infinite."""
    return np.nan_to_num(values, nan=0.0, posinf=0.0, neginf=0.0)


def _smaller_size(grid: VolumeGrid, max_voxels: int) -> tuple[int, int, int]:
    """Return the finest size within the limit whose voxels are as cubic as they can be."""
    extent = np.array(grid.size) * np.array(grid.spacing_mm)

    def size_at(spacing_mm: float) -> np.ndarray:
        return np.maximum(1, np.floor(extent / np.maximum(grid.spacing_mm, spacing_mm) + 1e-9))

    if np.prod(size_at(0.0)) <= max_voxels:
        return grid.size
    low, high = 0.0, float(extent.max())
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (low, middle) if np.prod(size_at(middle)) <= max_voxels else (middle, high)
    x, y, z = (int(n) for n in size_at(high))
    return x, y, z


def _box_means(many: int, few: int) -> csr_array:
    """Return the matrix that averages ``many`` samples into ``few`` of the same total length."""
    ratio = many / few
    edges = np.union1d(np.arange(many + 1), np.arange(few + 1) * ratio)
    middles = (edges[:-1] + edges[1:]) / 2
    rows = np.minimum((middles / ratio).astype(int), few - 1)
    columns = np.minimum(middles.astype(int), many - 1)
    shares = (np.diff(edges) / ratio).astype(np.float32)
    return csr_array((shares, (rows, columns)), shape=(few, many))


def _same_box(grid: VolumeGrid, size: tuple[int, int, int]) -> VolumeGrid:
    """Return a grid of another size with the same outer edges."""
    old = np.array(grid.spacing_mm)
    new = old * np.array(grid.size) / np.array(size)
    first = (new / old - 1) / 2
    origin = voxel_to_reference(grid).numpy() @ np.append(first, 1.0)
    return VolumeGrid(
        size=size,
        spacing_mm=(float(new[0]), float(new[1]), float(new[2])),
        origin_mm=(float(origin[0]), float(origin[1]), float(origin[2])),
        direction=grid.direction,
    )
