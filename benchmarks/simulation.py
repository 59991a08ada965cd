"""Speed and memory of the simulator: echoes, labels and full B-mode frames.

Timed: the echoes of full frames (256 x 256 pixels, 266 scatterers per mm3, an L11-5v) along a
tilted sweep, and B-mode frames with all that a scanner makes of them, CPU time of one thread,
the smallest of several runs. Left out: compiling, making the bodies. Memory is the largest
that the process has had, making the forearm included.

    python benchmarks/simulation.py
"""

import resource
import time
from collections.abc import Callable

import numpy as np
import torch

from sonosweep.imaging import PAPER_GRID
from sonosweep.simulate import (
    FIRST_TEST_SUBJECT,
    REFERENCE_CODE,
    STILL,
    Beam,
    Body,
    Tissue,
    draw_sweep,
    simulate_sweep,
)
from sonosweep.simulate.medium import Medium
from sonosweep.simulate.planes import sample_plane
from sonosweep.simulate.point_spread import point_spread
from sonosweep.simulate.slab import CellRoom, cell_table, seen_cells, slab_of
from sonosweep.simulate.speckle import SpeckleRenderer
from sonosweep.simulate.tissue_motion import body_to_plane

RUNS = 8
SPACING_MM = 0.25
SIZE_MM = (70.0, 50.0, 100.0)


def main() -> None:
    """Print milliseconds per frame and megabytes."""
    torch.set_num_threads(1)
    scan = simulate_sweep(draw_sweep(FIRST_TEST_SUBJECT, 0))
    number = iter(range(len(scan.frames)))
    frame = cpu_seconds(lambda: scan.frames[next(number)])
    print(f"full B-mode frame of a random sweep over a forearm: {frame * 1e3:.1f} ms of one thread")
    print(f"  memory of the process, at most: {megabytes():.0f} MB")

    body, poses = block(), [pose(step) for step in range(3)]
    renderer = SpeckleRenderer(body, Beam(), PAPER_GRID, seed=0)
    numba = cpu_seconds(lambda: [renderer.iq(where) for where in poses]) / len(poses)
    scatterers, listing = cells_of(body, poses[0])
    labels = cpu_seconds(lambda: sample_plane(body.tissue, body, poses[0], PAPER_GRID))
    print(f"echoes of a frame, numba: {numba * 1e3:.1f} ms")
    print(f"  of {scatterers} scatterers: {numba / scatterers * 1e9:.1f} ns each")
    print(f"  listing the cells that it sees: {listing * 1e3:.2f} ms")
    print(f"labels of its pixels: {labels * 1e3:.2f} ms")
    slow = SpeckleRenderer(body, Beam(), PAPER_GRID, seed=0, engine="torch")
    seconds = cpu_seconds(lambda: slow.iq(poses[0]))
    difference = np.abs(slow.iq(poses[0]) - renderer.iq(poses[0])).max()
    print(
        f"torch on the CPU: {seconds * 1e3:.0f} ms; differs by {difference:.1e} of the mean power"
    )


def block() -> Body:
    """Return a body of mottled tissue, so that every scatterer's voxel is looked up."""
    shape = tuple(round(size / SPACING_MM) for size in SIZE_MM[::-1])
    rng = np.random.default_rng(0)
    echo = rng.integers(REFERENCE_CODE - 20, REFERENCE_CODE + 20, shape, np.uint8)
    skin = np.zeros((shape[0], shape[2]), np.float32)
    tissue = np.full(shape, int(Tissue.MUSCLE), np.uint8)
    origin = (-SIZE_MM[0] / 2, 0.0, -SIZE_MM[2] / 2)
    return Body("block", "simulated-900003", tissue, echo, SPACING_MM, origin, skin)


def pose(step: int) -> np.ndarray:
    """Return a pose of a sweep whose probe tilts."""
    angle = 0.05 * step
    matrix = np.eye(4)
    matrix[1:3, 1:3] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    matrix[2, 3] = 0.3 * step
    return matrix


def cells_of(body: Body, where: np.ndarray) -> tuple[int, float]:
    """Return how many scatterers a frame looks at, and the time to list their cells."""
    medium, table, room = Medium(0), cell_table(body), CellRoom()
    slab = slab_of(Beam(), point_spread(PAPER_GRID, Beam()))

    def work() -> np.ndarray:
        affine = body_to_plane(where, STILL)
        return seen_cells(slab, table, medium.sets.first, medium.word, affine, 0.0, room).place

    return int(work()[:, 5].sum()), cpu_seconds(work)


def megabytes() -> float:
    """Return the largest memory that the process has had."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


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
