"""Nothing in simulated frames tells forward from backward."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from sonosweep.imaging import centered_grid
from sonosweep.simulate import BodyMotionSettings, SweepSettings, draw_sweep, simulate_sweep
from sonosweep.simulate.forearm import forearm
from sonosweep.simulate.motion import MotionSettings

TRAINING, UNSEEN = range(900100, 900115), range(900115, 900127)
FRAMES = 30  # of each of two sweeps over an arm
GRID = centered_grid(80, 80, (0.3, 0.3), 0.5)
EPOCHS = 12
DEVIATIONS = 3.0  # of the binomial distribution: wrong once in 370 times
MOTION = MotionSettings(
    shape="S", length_mm=9.0, frames=FRAMES, excursion_mm=2.0, contact_width_mm=24.0, pauses=0
)
LIVING = BodyMotionSettings(
    strain=0.05, strain_variation=0.02, pulse=0.15, heart_rate_hz=1.3, breathing_mm=0.3
)


def settings(subject: int, scan: int) -> SweepSettings:
    """Return a random scanner, with persistence, pulse, compression and breathing all on."""
    drawn = draw_sweep(subject, scan, replace(MOTION, backward=bool(scan % 2)))
    scanner = replace(drawn.scanner, persistence_frames=3 if subject % 2 else 5)
    living = replace(drawn, scanner=scanner, body_motion=LIVING)
    return replace(living, grid=GRID, density_per_mm3=133.0)


def frames_of(subjects: range) -> list[np.ndarray]:
    """Return the frames of a sweep up and a sweep down the forearm of each subject.

    An arm is thicker at one end. That is anatomy and no arrow of time: only who knows
    which way the arm lies could use it.
    """
    stacks = []
    for subject in subjects:
        body = forearm(subject, spacing_mm=0.5, width_mm=60.0, depth_mm=30.0, length_mm=60.0)
        stacks += [simulate_sweep(settings(subject, scan), body).frames[:] for scan in (0, 1)]
    return stacks


def pairs_of(stacks: list[np.ndarray], seed: int) -> tuple[Tensor, Tensor]:
    """Return pairs of neighboring frames, no frame in two of them, half of them reversed."""
    pairs = np.concatenate([stack.reshape(-1, 2, *stack.shape[1:]) for stack in stacks])
    labels = np.random.default_rng(seed).permutation(len(pairs)) % 2
    pairs[labels == 1] = pairs[labels == 1][:, ::-1]
    return torch.from_numpy(pairs.astype(np.float32) / 128 - 1), torch.from_numpy(labels)


def statistics(pairs: Tensor) -> Tensor:
    """Return what differs from one frame of a pair to the other, in four depths and in all."""
    first, second = pairs[:, 0], pairs[:, 1]
    change = second - first
    levels = torch.tensor([0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99])
    found = []
    for rows in (slice(None), *(slice(start, start + 20) for start in range(0, 80, 20))):
        part = change[:, rows]
        flat = part.flatten(1)
        found += [torch.quantile(flat, levels, dim=1).T, flat.mean(1)[:, None]]
        found += [(flat**3).mean(1)[:, None], (flat.abs() * flat).mean(1)[:, None]]
        for frame in (first[:, rows], second[:, rows]):
            found += [(frame.flatten(1) * flat).mean(1)[:, None]]
            for axis in (1, 2):
                slope = (frame.diff(dim=axis) ** 2).flatten(1)
                found += [slope.mean(1)[:, None], slope.std(1)[:, None]]
                step = (frame.diff(dim=axis) * part.narrow(axis, 1, part.shape[axis] - 1)).flatten(
                    1
                )
                found += [step.mean(1)[:, None]]
    return torch.cat(found, dim=1)


def logistic_regression(pairs: Tensor, labels: Tensor) -> Callable[[Tensor], Tensor]:
    """Return a linear classifier of the statistics of pairs."""
    features = odd_statistics(pairs)
    scale = features.std(0) + 1e-9
    weights = torch.zeros(len(scale), requires_grad=True)
    optimizer = torch.optim.LBFGS([weights], max_iter=200)

    def loss() -> Tensor:
        optimizer.zero_grad()
        score = features / scale @ weights
        value = nn.functional.binary_cross_entropy_with_logits(score, labels.float())
        value = value + 0.02 * (weights**2).sum()
        value.backward()
        return value

    optimizer.step(loss)
    return lambda unseen: (odd_statistics(unseen) / scale @ weights > 0).long()


def odd_statistics(pairs: Tensor) -> Tensor:
    """Return the part of the statistics that changes its sign when a pair is reversed."""
    return statistics(pairs) - statistics(pairs.flip(1))


def convolutional_network(pairs: Tensor, labels: Tensor) -> Callable[[Tensor], Tensor]:
    """Return a small network that sees the pixels of a pair and of its reversal."""
    torch.manual_seed(1)
    network = nn.Sequential(
        nn.Conv2d(2, 16, 1),
        nn.LeakyReLU(),
        nn.Conv2d(16, 16, 5, stride=2),
        nn.LeakyReLU(),
        nn.Conv2d(16, 24, 3, stride=2),
        nn.LeakyReLU(),
        nn.Conv2d(24, 24, 3),
        nn.LeakyReLU(),
        nn.AdaptiveAvgPool2d(1),
        nn.Flatten(),
        nn.Linear(24, 1),
    )

    def score(batch: Tensor) -> Tensor:
        return (network(batch) - network(batch.flip(1)))[:, 0]

    optimizer = torch.optim.Adam(network.parameters(), 3e-3)
    for _ in range(EPOCHS):
        for batch in torch.randperm(len(pairs)).split(32):
            optimizer.zero_grad()
            target = labels[batch].float()
            nn.functional.binary_cross_entropy_with_logits(score(pairs[batch]), target).backward()
            optimizer.step()
    return lambda unseen: (score(unseen) > 0).long()


CLASSIFIERS = (logistic_regression, convolutional_network)


def with_afterglow(stack: np.ndarray) -> np.ndarray:
    """Return frames in which brightness comes at once and goes slowly."""
    glowing = stack.copy()
    for k in range(1, len(glowing)):
        fading = np.maximum(glowing[k - 1], 12) - 12
        glowing[k] = np.maximum(glowing[k], fading)
    return glowing


@pytest.fixture(scope="module")
def sweeps() -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return the frames of sweeps to learn from, and of others over other arms."""
    return frames_of(TRAINING), frames_of(UNSEEN)


@pytest.mark.slow
@pytest.mark.parametrize("train", CLASSIFIERS)
def test_reversed_pairs_cannot_be_told_from_others(sweeps, train) -> None:
    """On 360 unseen pairs, right answers are as many as by chance: 180 with +- 28 (3 sigma)."""
    learned, unseen = (pairs_of(stacks, seed) for seed, stacks in enumerate(sweeps))
    classify = train(*learned)
    pairs, labels = unseen
    right = int((classify(pairs) == labels).sum())
    bound = DEVIATIONS * math.sqrt(len(labels) / 4)
    assert len(labels) == len(UNSEEN) * FRAMES == 360
    assert abs(right - len(labels) / 2) < bound, f"{right} of {len(labels)} right"


@pytest.mark.slow
@pytest.mark.parametrize("train", CLASSIFIERS)
def test_an_arrow_of_time_would_be_found(sweeps, train) -> None:
    """The same classifiers do tell frames with an afterglow from their reversals."""
    marked = [[with_afterglow(stack) for stack in stacks] for stacks in sweeps]
    learned, (pairs, labels) = (pairs_of(stacks, seed) for seed, stacks in enumerate(marked))
    right = int((train(*learned)(pairs) == labels).sum())
    assert right > len(labels) / 2 + 3 * DEVIATIONS * math.sqrt(len(labels) / 4)
