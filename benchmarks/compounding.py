"""Compounding speed: CPU time from frames to an 8-bit volume, beside NumPy and the machine.

Sweep: 950 frames of 256 x 256 pixels of 0.1484 mm along an S-shaped 200 mm, with uneven
speed and turns of 10 to 18 degrees; frames are noise, in memory. Timed: allocation,
accumulation, division, coverage. Left out: compilation, reading files. Times are CPU time of
the process, the smallest of several; wall time with two threads says something only on an
idle machine.

The NumPy version is the plain forward one: positions, ``np.bincount`` of counts and sums.
The limits are measured in the same run: copying 256 MB, and multiply-adds of a loop that
stays in the first-level cache.
"""

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch
from numba import njit

from sonosweep.geometry import pose_from_parts, rotation_from_euler, scale_pixels
from sonosweep.reconstruct.forward import compound_forward
from sonosweep.reconstruct.gather import GatherCompounder
from sonosweep.reconstruct.grid import grid_of_sweep, pixel_to_voxel
from sonosweep.reconstruct.retire import compound_gather
from sonosweep.scan import VolumeGrid

FRAMES, PIXELS, PIXEL_MM = 950, 256, 0.1484
NUMPY_FRAMES = 50
"""The plain version is timed on a part of the sweep and scaled."""


def sweep_a(frames: int) -> torch.Tensor:
    """Return the poses of the sweep."""
    s = torch.linspace(0, 1, frames, dtype=torch.float64)
    s = s + 0.005 * torch.sin(19 * s)
    place = torch.stack((15 * torch.sin(2 * torch.pi * s), 0 * s, 200 * s), dim=-1)
    largest = torch.deg2rad(torch.tensor([8.0, 18.0, 10.0], dtype=torch.float64))
    waves = torch.stack((torch.sin(8 * s), torch.cos(6.3 * s), torch.sin(4.4 * s)), dim=-1)
    return pose_from_parts(rotation_from_euler(waves * largest, "XYZ"), place)


def seconds(work: Callable[[], object], clock: Callable[[], float], repeats: int = 3) -> float:
    """Return the smallest time of several, after one that compiles."""
    work()
    times = []
    for _ in range(repeats):
        start = clock()
        work()
        times.append(clock() - start)
    return min(times)


def numpy_forward(frames: np.ndarray, transforms: np.ndarray, grid: VolumeGrid) -> np.ndarray:
    """Return the nearest-voxel mean, written plainly."""
    rows, columns = np.mgrid[:PIXELS, :PIXELS].reshape(2, -1)
    pixels = np.stack((columns, rows, np.ones_like(rows)))
    length = int(np.prod(grid.size))
    total, count = np.zeros(length), np.zeros(length)
    for frame, matrix in zip(frames, transforms, strict=True):
        x, y, z = np.floor(matrix @ pixels + 0.5).astype(np.int64)
        # Of the whole volume bincount would be mostly zeros: count within the frame's slab.
        index = x + grid.size[0] * (y + grid.size[1] * z)
        first = int(index.min())
        stop = int(index.max()) + 1
        total[first:stop] += np.bincount(index - first, weights=frame.ravel())
        count[first:stop] += np.bincount(index - first)
    return (total / np.maximum(count, 1) + 0.5).astype(np.uint8)


@njit(cache=True, nogil=True)
def multiply_add(values, rounds):
    """Multiply and add over a small array; the compiler vectorizes it."""
    for _ in range(rounds):
        for k in range(values.size):
            values[k] = values[k] * np.float32(0.999) + np.float32(0.001)


def machine_limits() -> tuple[float, float]:
    """Return copied bytes and multiply-adds per second of one core."""
    source, target = np.ones(2**28, np.uint8), np.ones(2**28, np.uint8)
    copy = seconds(lambda: np.copyto(target, source), time.process_time)
    values = np.ones(4096, np.float32)
    rounds = 20_000
    fused = seconds(lambda: multiply_add(values, rounds), time.process_time)
    return source.nbytes / copy, values.size * rounds / fused


def machine_scaling() -> float:
    """Return how many times faster two threads are at multiply-adds that share nothing."""
    arrays = [np.ones(4096, np.float32) for _ in range(2)]
    with ThreadPoolExecutor(2) as workers:

        def together() -> None:
            list(workers.map(lambda values: multiply_add(values, 20_000), arrays))

        def in_turn() -> None:
            for values in arrays:
                multiply_add(values, 20_000)

        return seconds(in_turn, time.perf_counter, 5) / seconds(together, time.perf_counter, 5)


def report(name: str, cpu_s: float, numpy_s: float, bytes_moved: float, copy_rate: float) -> None:
    """Print one line."""
    pixels = FRAMES * PIXELS**2 / cpu_s / 1e6
    bound = bytes_moved / copy_rate
    print(
        f"{name:34s} {cpu_s * 1e3:8.0f} ms CPU {pixels:7.0f} Mpixel/s"
        f" {numpy_s / cpu_s:7.1f} x NumPy {bound / cpu_s:7.1%} of the copy limit"
    )


def main() -> None:
    """Time each mode and print it."""
    poses, pixel_to_image = sweep_a(FRAMES), scale_pixels((PIXEL_MM, PIXEL_MM))
    frames = np.random.default_rng(0).integers(0, 256, (FRAMES, PIXELS, PIXELS), dtype=np.uint8)
    copy_rate, fused_rate = machine_limits()
    print(f"one core: copies {copy_rate / 1e9:.1f} GB/s, {fused_rate / 1e9:.1f} G multiply-adds/s")
    print(f"two threads: {machine_scaling():.2f} times the multiply-adds of one")
    for voxel_mm in (0.3, PIXEL_MM):
        grid = grid_of_sweep(poses, pixel_to_image, PIXELS, PIXELS, voxel_mm)
        sweep = frames, poses, pixel_to_image, grid
        transforms = pixel_to_voxel(poses, pixel_to_image, grid)[:NUMPY_FRAMES]
        part = frames[:NUMPY_FRAMES]
        plain_s = seconds(lambda: numpy_forward(part, transforms, grid), time.process_time, 2)  # noqa: B023
        plain_s *= FRAMES / NUMPY_FRAMES
        voxels = int(np.prod(grid.size))
        moved = frames.nbytes + 2 * voxels  # read the frames, write the voxels and the coverage
        print(f"\n{voxel_mm} mm: {' x '.join(map(str, grid.size))} = {voxels / 1e6:.0f} Mvoxel")
        modes: dict[str, Callable[[int], object]] = {
            "gather, radius and prefilter auto": lambda n: compound_gather(*sweep, threads=n),  # noqa: B023
            "forward nearest mean": lambda n: compound_forward(*sweep, threads=n),  # noqa: B023
            "forward linear mean": lambda n: compound_forward(
                *sweep,  # noqa: B023
                interpolation="linear",
                threads=n,
            ),
        }
        for name, mode in modes.items():
            cpu_s = seconds(lambda: mode(1), time.process_time)  # noqa: B023
            report(name, cpu_s, plain_s, moved, copy_rate)
            if voxel_mm < 0.2:
                continue
            one, two = (seconds(lambda: mode(n), time.perf_counter, 3) for n in (1, 2))  # noqa: B023
            print(f"{'':34s} {one * 1e3:8.0f} ms wall; {one / two:.2f} times faster on two threads")
    stream(frames, poses, pixel_to_image)


def stream(frames: np.ndarray, poses: torch.Tensor, pixel_to_image: torch.Tensor) -> None:
    """Time frames that are added one at a time to a volume of 0.3 mm."""
    grid = grid_of_sweep(poses, pixel_to_image, PIXELS, PIXELS, 0.3)
    best = np.full(FRAMES, np.inf)
    for _ in range(3):
        compounder = GatherCompounder(grid, pixel_to_image, (PIXELS, PIXELS), threads=1)
        for k, (frame, pose) in enumerate(zip(frames, poses, strict=True)):
            start = time.process_time()
            compounder.add(frame, pose)
            best[k] = min(best[k], time.process_time() - start)
    print(
        f"\none streamed frame, 0.3 mm: {np.median(best) * 1e3:.2f} ms CPU in the median,"
        f" {np.percentile(best, 99) * 1e3:.2f} ms at the 99th percentile"
    )


if __name__ == "__main__":
    main()
