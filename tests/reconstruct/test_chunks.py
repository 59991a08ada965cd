"""Volumes on disk, chunk by chunk."""

import tracemalloc

import numpy as np
import pytest
import torch

from sonosweep.errors import FormatError, ScanError
from sonosweep.reconstruct.chunks import compound_to_chunks, read_chunks
from sonosweep.reconstruct.grid import grid_of_sweep
from sonosweep.reconstruct.retire import compound_gather

from ..io.damage import resident_mb_after
from .sweeps import PIXEL_TO_IMAGE, frames_of_phantom, winding_sweep

TENS_OF_MB = 6e7


@pytest.mark.parametrize("channels", [0, 2])
@pytest.mark.parametrize("threads", [1, 3])
def test_chunks_hold_the_dense_volume(tmp_path, threads, channels):
    """What is read back, whole or in part, is what memory would have held."""
    poses = winding_sweep(40, length_mm=30.0)
    frames = frames_of_phantom(poses, 40, 60)
    if channels:
        frames = np.stack((frames, 255 - frames), axis=-1)
    grid = grid_of_sweep(poses, PIXEL_TO_IMAGE, 40, 60, 0.16)
    dense = compound_gather(frames, poses, PIXEL_TO_IMAGE, grid)

    compound_to_chunks(
        tmp_path / "volume.zarr", frames, poses, PIXEL_TO_IMAGE, grid, threads=threads
    )

    whole = read_chunks(tmp_path / "volume.zarr")
    part = read_chunks(tmp_path / "volume.zarr", low=(5, 0, 60), high=(70, 40, 140))
    assert np.array_equal(whole.voxels, dense.voxels)
    assert np.array_equal(whole.coverage, dense.coverage)
    assert whole.grid == dense.grid
    assert np.array_equal(part.voxels, dense.voxels[60:140, 0:40, 5:70])
    assert part.grid.origin_mm[2] == pytest.approx(grid.origin_mm[2] + 60 * 0.16)


def test_finished_bricks_leave_memory(tmp_path):
    """Beside 107 MB of voxels and coverage, a sweep that fills them takes tens of MB."""
    sweep = """
import numpy as np, torch
from sonosweep.geometry import scale_pixels
from sonosweep.reconstruct.grid import grid_of_sweep
from sonosweep.reconstruct.retire import compound_gather
poses = torch.eye(4, dtype=torch.float64).repeat(150, 1, 1)
poses[:, 2, 3] = torch.linspace(0, 30, 150, dtype=torch.float64)
frames = np.full((150, 85, 85), 9, np.uint8)
pixels = scale_pixels((0.5, 0.5))
grid = grid_of_sweep(poses, pixels, 85, 85, 0.1)
"""
    output = """
held = np.ones((2, *grid.size), np.uint8)
compound_gather(frames[:1], poses[:1], pixels, grid_of_sweep(poses[:1], pixels, 85, 85, 1.0))
"""
    whole = """
held = compound_gather(frames, poses, pixels, grid)
assert (held.coverage > 0).mean() > 0.9
"""

    alone_mb = resident_mb_after(sweep + output, tmp_path)
    together_mb = resident_mb_after(sweep + whole, tmp_path)

    assert together_mb - alone_mb < TENS_OF_MB / 1e6


def test_a_huge_empty_grid_costs_little(tmp_path):
    """Two short sweeps metres apart touch few bricks of a grid of 10^12 voxels."""
    poses = winding_sweep(4, length_mm=0.5)
    poses[2:, :3, 3] += 4_000.0
    frames = np.full((4, 20, 20), 9, np.uint8)
    grid = grid_of_sweep(poses, PIXEL_TO_IMAGE, 20, 20, 0.4)

    tracemalloc.start()
    with pytest.raises(ScanError, match="can be used: take voxels of"):
        compound_gather(frames, poses, PIXEL_TO_IMAGE, grid)
    compound_to_chunks(tmp_path / "volume.zarr", frames, poses, PIXEL_TO_IMAGE, grid)
    _, peak_bytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()

    assert np.prod([float(n) for n in grid.size]) > 1e12
    assert peak_bytes < TENS_OF_MB
    corner = read_chunks(tmp_path / "volume.zarr", high=(16, 16, 8))
    assert set(np.unique(corner.voxels)) == {0, 9}


def test_failure_leaves_nothing_behind(tmp_path):
    """A sweep that breaks half-way leaves no folder, and an existing one is kept."""
    poses = winding_sweep(4, length_mm=0.5)
    frames = np.full((4, 20, 20), 9, np.uint8)
    grid = grid_of_sweep(poses, PIXEL_TO_IMAGE, 20, 20, 0.3)
    target = tmp_path / "volume.zarr"

    def stop(done, total):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        compound_to_chunks(target, frames, poses, PIXEL_TO_IMAGE, grid, progress=stop)
    assert list(tmp_path.iterdir()) == []
    compound_to_chunks(target, frames, poses, PIXEL_TO_IMAGE, grid)
    with pytest.raises(FormatError, match="exists already"):
        compound_to_chunks(target, frames, poses, PIXEL_TO_IMAGE, grid)


def test_damaged_chunks_are_named(tmp_path):
    """A truncated chunk and a folder of something else are refused."""
    poses = torch.eye(4, dtype=torch.float64)[None]
    grid = grid_of_sweep(poses, PIXEL_TO_IMAGE, 9, 9, 0.2)
    target = tmp_path / "volume.zarr"
    compound_to_chunks(target, np.ones((1, 9, 9), np.uint8), poses, PIXEL_TO_IMAGE, grid)
    (target / "voxels" / "0.0.0").write_bytes(b"short")

    with pytest.raises(FormatError, match="damaged: 5 bytes"):
        read_chunks(target)
    with pytest.raises(FormatError, match="not a folder of volume chunks"):
        read_chunks(tmp_path)
    with pytest.raises(ScanError, match="not part of a volume"):
        read_chunks(target, low=(3, 3, 3), high=(3, 4, 4))
