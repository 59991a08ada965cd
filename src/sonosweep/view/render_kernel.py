"""The loop that renders a volume: parallel rays through voxels, compiled by Numba."""

from typing import no_type_check

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
@no_type_check
def march(voxels, start, right, down, away, counts, opacity, far_shade, brightest):
    """Collect light along parallel rays, front to back, or find the brightest place."""
    rows, columns, steps = counts[0], counts[1], counts[2]
    depth, height, width = voxels.shape
    picture = np.zeros((rows, columns), np.uint8)
    for row in range(rows):
        for column in range(columns):
            x0 = start[0] + row * down[0] + column * right[0]
            y0 = start[1] + row * down[1] + column * right[1]
            z0 = start[2] + row * down[2] + column * right[2]
            light, passing = 0.0, 1.0
            for step in range(steps):
                x, y, z = x0 + step * away[0], y0 + step * away[1], z0 + step * away[2]
                if x < 0 or y < 0 or z < 0 or x > width - 1 or y > height - 1 or z > depth - 1:
                    continue
                i, j, k = min(int(x), width - 2), min(int(y), height - 2), min(int(z), depth - 2)
                i, j, k = max(i, 0), max(j, 0), max(k, 0)
                value = _trilinear(voxels, i, j, k, x - i, y - j, z - k) / 255.0
                shade = 1.0 - (1.0 - far_shade) * step / steps
                if brightest:
                    light = max(light, value * shade)
                    continue
                alpha = min(1.0, opacity * value * value)
                light += passing * alpha * shade * (0.35 + 0.65 * value)
                passing *= 1.0 - alpha
                if passing < 0.02:
                    break
            picture[row, column] = np.uint8(min(255.0, 255.0 * light + 0.5))
    return picture


@njit(cache=True, nogil=True)
@no_type_check
def _trilinear(voxels, i, j, k, fx, fy, fz):
    """Interpolate between eight voxels; an axis of one voxel counts it twice."""
    i1, j1, k1 = (
        min(i + 1, voxels.shape[2] - 1),
        min(j + 1, voxels.shape[1] - 1),
        min(k + 1, voxels.shape[0] - 1),
    )
    near = (voxels[k, j, i] * (1 - fx) + voxels[k, j, i1] * fx) * (1 - fy) + (
        voxels[k, j1, i] * (1 - fx) + voxels[k, j1, i1] * fx
    ) * fy
    far = (voxels[k1, j, i] * (1 - fx) + voxels[k1, j, i1] * fx) * (1 - fy) + (
        voxels[k1, j1, i] * (1 - fx) + voxels[k1, j1, i1] * fx
    ) * fy
    return near * (1 - fz) + far * fz
