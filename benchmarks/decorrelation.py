"""Speed of the decorrelation estimator, beside plain NumPy and the machine's arithmetic.

Timed: everything from gray frames in memory to motion, pairs of 1, 2 and 4 frames, CPU time
of one thread, the smallest of several runs. Left out: reading files, compiling. The limit is
the multiply-add rate of a single precision matrix product in the same run.

    python benchmarks/decorrelation.py
"""

import math
import time
from collections.abc import Callable

import numpy as np
import torch
from scipy.ndimage import gaussian_filter

from sonosweep.estimators import DecorrelationEstimator
from sonosweep.estimators.matching import NARROW_PX, SEARCH_MM
from sonosweep.estimators.patches import PatchGrid, patch_grid
from sonosweep.estimators.registration import correlate, moments
from sonosweep.scan import Calibration, Scan

PIXELS = 256
SPACING_MM = 0.1484
FRAMES = 24
RUNS = 5
GEMM = 1024


def main() -> None:
    """Print the rates and their ratios."""
    torch.set_num_threads(1)
    scan = speckle_sweep(FRAMES)
    grid = patch_grid(scan)
    estimator = DecorrelationEstimator()
    seconds = cpu_seconds(lambda: estimator.estimate(scan)) / FRAMES
    fast, plain, macs = matching_seconds(scan, grid)
    peak = GEMM**3 / cpu_seconds(matrix_product())
    per_frame = macs_per_frame(grid)

    print(f"estimate, {PIXELS} x {PIXELS}, all pairs: {1 / seconds:.0f} frames per CPU second")
    print(f"  CPU time per frame: {seconds * 1e3:.1f} ms")
    print(f"  multiply-adds of its search: {per_frame / 1e6:.0f} million per frame")
    print(f"  as part of the limit: {per_frame / seconds / peak:.3f}")
    print(f"patch correlation alone: {macs / fast / 1e9:.1f} G multiply-adds per CPU second")
    print(f"  plain NumPy: {macs / plain / 1e9:.2f} G; ours is {plain / fast:.1f} times faster")
    print(
        f"  limit (matrix product, float32): {peak / 1e9:.1f} G; reached {macs / fast / peak:.2f}"
    )


def speckle_sweep(frames: int) -> Scan:
    """Return frames of speckle that drift and decorrelate like a slow sweep."""
    rng = np.random.default_rng(0)
    field = rng.standard_normal((frames + 8, PIXELS, PIXELS, 2)).astype(np.float32)
    echo = np.stack([gaussian_filter(field[..., k], (2.0, 0.8, 1.2)) for k in (0, 1)], axis=-1)
    amplitude = np.hypot(echo[..., 0], echo[..., 1])[4:-4]
    gray = 200 + 255 / 60 * 20 * np.log10(amplitude / np.sqrt(np.mean(amplitude**2)))
    pixels = np.clip(gray, 0, 255).astype(np.uint8)
    return Scan("made up", pixels, Calibration(spacing_mm=(SPACING_MM, SPACING_MM)))


def matching_seconds(scan: Scan, grid: PatchGrid) -> tuple[float, float, int]:
    """Return the time of our patch search and of plain NumPy's, and its multiply-adds."""
    one, other = (scan.frames[k].astype(np.float32) / 64 for k in (0, 1))
    base, radius = np.zeros_like(grid.corners_px), NARROW_PX
    sums = moments(one), moments(other)

    def ours() -> np.ndarray:
        return correlate(one, sums[0], other, sums[1], grid.corners_px, grid.side_px, base, radius)

    def numpy() -> np.ndarray:
        return plain_correlate(one, other, grid.corners_px, grid.side_px, radius)

    known = np.isfinite(ours())
    if not np.allclose(ours()[known], numpy()[known], atol=1e-3):
        raise SystemExit("the two versions differ")
    macs = len(grid.corners_px) * grid.side_px**2 * (2 * radius + 1) ** 2
    return cpu_seconds(ours), cpu_seconds(numpy), macs


def plain_correlate(
    one: np.ndarray, other: np.ndarray, corners: np.ndarray, side: int, radius: int
) -> np.ndarray:
    """Return what ``correlate`` does, a patch and a shift at a time."""
    width = 2 * radius + 1
    result = np.full((len(corners), width, width), np.nan)
    for p, (top, left) in enumerate(corners):
        patch = one[top : top + side, left : left + side]
        patch = patch - patch.mean()
        norm = np.linalg.norm(patch)
        for i in range(width):
            for j in range(width):
                row, column = top + i - radius, left + j - radius
                like = other[row : row + side, column : column + side]
                if min(row, column) < 0 or like.shape != patch.shape:
                    continue
                like = like - like.mean()
                result[p, i, j] = (patch * like).sum() / (norm * np.linalg.norm(like))
    return result


def macs_per_frame(grid: PatchGrid) -> int:
    """Return the multiply-adds of all correlations that one frame takes part in."""
    wide = min(math.ceil(SEARCH_MM / SPACING_MM), grid.side_px // 2)
    shifts = (2 * wide + 1) ** 2 + 2 * (2 * NARROW_PX + 1) ** 2 + 3 * 3**2 + 3
    return len(grid.corners_px) * grid.side_px**2 * shifts


def matrix_product() -> Callable[[], torch.Tensor]:
    """Return the densest multiply-adds a library can do, to be timed."""
    a, b = torch.ones(2, GEMM, GEMM)
    return lambda: a @ b


def cpu_seconds(work: Callable[[], object]) -> float:
    """Return the smallest CPU time of several runs, after one to warm up."""
    work()
    times = []
    for _ in range(RUNS):
        start = time.process_time()
        work()
        times.append(time.process_time() - start)
    return min(times)


if __name__ == "__main__":
    main()
