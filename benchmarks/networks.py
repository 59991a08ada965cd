"""Speed of the motion networks on a CPU: streaming, training, and against whole windows.

CPU time of one thread, the smallest of several runs; frames are in memory. Streaming encodes
each frame once, compares each pair once and carries the LSTMs' state; whole windows are what
the released code of MoGLo-Net runs: for each frame the window of the last five, as two
sequences of four that are encoded apart. Training is forward and backward, without optimizer
and data.

    python benchmarks/networks.py [NETWORK ...]
"""

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from sonosweep.estimators.correlation import CorrelationGeometry, correlation_volume
from sonosweep.estimators.image_correlation import ShiftRange, image_correlation
from sonosweep.estimators.network import FrameShape, MotionNetwork, RecurrentNetwork, Stepper
from sonosweep.estimators.network_names import NETWORKS, build_network

WINDOW = 5
"""Frames; also of the released code of MoGLo-Net."""
BATCH = {"compact": 8}
"""Windows of a training step; 2 for other presets, which are large."""
PRESETS = ("paper", "compact")
MOST_RUNS, LEAST_RUNS, ENOUGH_S = 20, 2, 1.0
"""A call is repeated until it has taken long enough."""


@dataclass(frozen=True)
class Case:
    """What is timed.

    Attributes:
        name: Of the network.
        preset: Of its options.
        shape: Of the frames.
    """

    name: str
    preset: str
    shape: FrameShape


def main() -> None:
    """Print one row for each network, size and precision."""
    torch.set_num_threads(1)
    print(
        "| network | frames | M parameters | precision | ms / frame, streaming"
        " | 16 at a time | each window anew | ratio | pairs / s, training |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for case in cases(sys.argv[1:] or list(NETWORKS)):
        for precision in (torch.float32, torch.bfloat16):
            print(row(case, precision), flush=True)
    print_correlations()


def cases(names: list[str]) -> list[Case]:
    """Return each preset at the sizes it is meant for."""
    large, small = FrameShape(1, 256, 256), FrameShape(1, 128, 128)
    found: list[Case] = []
    for name in names:
        for preset in PRESETS:
            if preset not in NETWORKS[name].presets:
                continue
            shapes = (small, large) if preset == "compact" else (large,)
            found.extend(Case(name, preset, shape) for shape in shapes)
    return found


def row(case: Case, precision: torch.dtype) -> str:
    """Return a row of the table."""
    network = build_network(case.name, shape=case.shape, preset=case.preset)
    parameters = sum(part.numel() for part in network.parameters()) / 1e6
    with torch.autocast("cpu", precision, enabled=precision != torch.float32):
        batch = BATCH.get(case.preset, 2)
        training = batch * (WINDOW - 1) / training_seconds(network, batch)
        network.eval()
        streaming, many = streaming_ms(network), many_ms(network)
        windows = window_ms(network)
    kind = "bf16" if precision == torch.bfloat16 else "fp32"
    return (
        f"| {case.name} {case.preset} | {case.shape.rows} x {case.shape.columns}"
        f" | {parameters:.2f} | {kind} | {streaming:.1f} | {many:.1f} | {windows:.1f}"
        f" | {windows / many:.1f} | {training:.1f} |"
    )


def training_seconds(network: MotionNetwork, batch: int) -> float:
    """Return the time of forward and backward of a batch of windows."""
    frames = some_frames(network.frame_shape, batch)

    def step() -> None:
        network(frames).motion.square().sum().backward()

    return cpu_seconds(step)


def streaming_ms(network: MotionNetwork) -> float:
    """Return the time of one more frame of a sweep."""
    frames = some_frames(network.frame_shape, 1)[0]
    stepper = Stepper(network)
    return 1e3 * cpu_seconds(lambda: stepper.push(frames[0]))


def many_ms(network: MotionNetwork) -> float:
    """Return the time of a frame among sixteen at a time, as a recorded scan is run."""
    frames = some_frames(network.frame_shape, 4)[:, :4].flatten(0, 1)
    stepper = Stepper(network)
    return 1e3 * cpu_seconds(lambda: stepper.push_many(frames)) / len(frames)


@torch.inference_mode()
def window_ms(network: MotionNetwork) -> float:
    """Return the time of one more frame where its whole window is run for it."""
    frames = some_frames(network.frame_shape, 1)

    def whole() -> None:
        if not isinstance(network, RecurrentNetwork):
            network(frames)
            return
        first, second = (network.encode(part[0]) for part in (frames[:, :-1], frames[:, 1:]))
        pairs = network.compare(first, second)
        network.regress(tuple(part[None] for part in pairs), None)

    return 1e3 * cpu_seconds(whole)


def print_correlations() -> None:
    """Print the time of the correlation volumes of one pair."""
    features, frames = torch.rand(1, 64, 64, 64), torch.rand(1, 1, 256, 256)
    features = features.contiguous(memory_format=torch.channels_last)
    geometry, shifts = CorrelationGeometry(), ShiftRange()
    e1 = cpu_seconds(lambda: correlation_volume(features, features, geometry))
    gray = cpu_seconds(lambda: image_correlation(frames, frames, 16, shifts))
    print(f"correlation volume of E1, 64 x 64 x 64, 15 x 15 displacements: {e1 * 1e3:.1f} ms")
    print(f"correlation of frames, 256 x 256, 7 x 11 shifts: {gray * 1e3:.1f} ms")


def some_frames(shape: FrameShape, batch: int) -> Tensor:
    """Return windows of noise."""
    generator = torch.Generator().manual_seed(0)
    sizes = (batch, WINDOW, shape.channels, shape.rows, shape.columns)
    return torch.rand(sizes, generator=generator)


def cpu_seconds(call: Callable[[], object]) -> float:
    """Return the smallest CPU time of several calls, after one that does not count."""
    call()
    times: list[float] = []
    while len(times) < LEAST_RUNS or (sum(times) < ENOUGH_S and len(times) < MOST_RUNS):
        start = time.process_time()
        call()
        times.append(time.process_time() - start)
    return min(times)


if __name__ == "__main__":
    main()
