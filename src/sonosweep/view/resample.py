"""Volumes with fewer voxels, for pictures and for the page."""

import numpy as np
from PIL import Image

from sonosweep.scan import Volume, VolumeGrid, voxel_to_reference


def resample_volume(volume: Volume, max_voxels: int) -> Volume:
    """Return the volume averaged into at most ``max_voxels`` larger voxels, without channels.

    It covers the same box. Axes that are sampled finer than the others are thinned first.
    A volume that is small enough keeps its voxels and their type; others become float32.
    """
    grid = volume.grid
    size = _smaller_size(grid, max_voxels)
    if size == grid.size:
        return Volume(_scalar(volume.voxels), grid)
    voxels = np.zeros(size[::-1], np.float32)
    shares = _shares(grid.size[2], size[2])
    for z in range(grid.size[2]):
        values = np.nan_to_num(_scalar(np.asarray(volume.voxels[z : z + 1]))[0])
        image = Image.fromarray(np.ascontiguousarray(values, dtype=np.float32))
        thinned = np.asarray(image.resize(size[:2], Image.Resampling.BOX))
        for target, share in shares[z]:
            voxels[target] += share * thinned
    return Volume(voxels, _same_box(grid, size))


def _scalar(values: np.ndarray) -> np.ndarray:
    return values.mean(axis=-1, dtype=np.float32) if values.ndim == 4 else values


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


def _shares(count: int, fewer: int) -> list[list[tuple[int, float]]]:
    """Return for each old slice the new ones it falls into, with its share of their mean."""
    ratio = count / fewer
    shares: list[list[tuple[int, float]]] = []
    for z in range(count):
        first, last = int(z / ratio), min(int((z + 1) / ratio), fewer - 1)
        parts = []
        for target in range(first, last + 1):
            covered = min(z + 1, (target + 1) * ratio) - max(z, target * ratio)
            if covered > 1e-9:
                parts.append((target, covered / ratio))
        shares.append(parts)
    return shares


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
