"""Compounding again, slowly and plainly, in double precision."""

import numpy as np
import torch

from sonosweep.scan import VolumeGrid, voxel_to_reference


def forward_nearest(frames, image_to_reference, pixel_to_image, grid: VolumeGrid):
    """Return the sum and count of the pixels that fall into each voxel, (z, y, x)."""
    size = grid.size[::-1]
    total, count = np.zeros(size), np.zeros(size, np.int64)
    reference_to_voxel = torch.linalg.inv(voxel_to_reference(grid))
    rows, columns = np.mgrid[: frames.shape[1], : frames.shape[2]]
    pixels = np.stack((columns, rows, 0 * rows, 1 + 0 * rows)).reshape(4, -1)
    for frame, pose in zip(frames, image_to_reference, strict=True):
        voxel = (reference_to_voxel @ pose @ pixel_to_image).numpy() @ pixels
        x, y, z = np.floor(voxel[:3] + 0.5).astype(int)
        inside = (x >= 0) & (y >= 0) & (z >= 0)
        inside &= (x < grid.size[0]) & (y < grid.size[1]) & (z < grid.size[2])
        index = (z[inside], y[inside], x[inside])
        np.add.at(total, index, frame.reshape(-1)[inside].astype(float))
        np.add.at(count, index, 1)
    return total, count


def gather(frames, image_to_reference, pixel_to_image, grid: VolumeGrid, radii_mm):
    """Return the distance-weighted mean of bilinear samples of each voxel, and its weight."""
    size = grid.size
    index = np.stack(np.meshgrid(*(np.arange(n) for n in size), indexing="ij"), -1).reshape(-1, 3)
    homogeneous = np.concatenate((index, np.ones((len(index), 1))), axis=1)
    reference = homogeneous @ voxel_to_reference(grid).numpy().T
    total, weight = np.zeros(len(index)), np.zeros(len(index))
    for frame, pose, radius in zip(frames, image_to_reference, radii_mm, strict=True):
        image = reference @ torch.linalg.inv(pose).numpy().T
        pixel = image.copy()
        pixel[:, 2] = 0
        pixel = pixel @ torch.linalg.inv(pixel_to_image).numpy().T
        near = np.maximum(1 - np.abs(image[:, 2]) / radius, 0)
        value, inside = _bilinear(frame.astype(float), pixel[:, 0], pixel[:, 1])
        total += np.where(inside, near * value, 0)
        weight += np.where(inside, near, 0)
    shape = size
    mean = np.divide(total, weight, out=np.zeros_like(total), where=weight > 0)
    return mean.reshape(shape).transpose(2, 1, 0), weight.reshape(shape).transpose(2, 1, 0)


def _bilinear(frame, u, v):
    """Values between pixels; a pixel covers its own area, up to half a pixel around it."""
    rows, columns = frame.shape
    inside = (u >= -0.5) & (u < columns - 0.5) & (v >= -0.5) & (v < rows - 0.5)
    u, v = np.clip(u, 0, columns - 1), np.clip(v, 0, rows - 1)
    i, j = (
        np.minimum(u.astype(int), max(columns - 2, 0)),
        np.minimum(v.astype(int), max(rows - 2, 0)),
    )
    a, b = u - i, v - j
    right, below = np.minimum(i + 1, columns - 1), np.minimum(j + 1, rows - 1)
    upper = frame[j, i] * (1 - a) + frame[j, right] * a
    lower = frame[below, i] * (1 - a) + frame[below, right] * a
    return upper * (1 - b) + lower * b, inside
