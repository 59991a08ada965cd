"""Losses against loops, and against numbers from pencil and paper."""

import math
from itertools import permutations

import pytest
import torch
from torch import Tensor

from sonosweep.errors import TrainingError
from sonosweep.estimators.network import NetworkOutput
from sonosweep.training.losses import (
    LossSettings,
    batch_correlation_loss,
    correlation_loss,
    gaussian_loss,
    huber_loss,
    l1_loss,
    mmae_loss,
    total_loss,
    triplet_loss,
)

ROUND_OFF = 1e-6  # float32 sums of some hundred numbers of about 1


def windows(seed: int = 0, batch: int = 5, steps: int = 4) -> tuple[Tensor, Tensor]:
    """Return predicted and true motions of some windows."""
    draw = torch.Generator().manual_seed(seed)
    motion, true = torch.randn(2, batch, steps, 6, generator=draw)
    return motion, true


def cosine(a: Tensor, b: Tensor) -> float:
    """Return the cosine of two vectors, in double precision."""
    a, b = a.double(), b.double()
    return float(a @ b / (a.norm() * b.norm()))


def test_mmae_is_the_papers_weighted_sum():
    """L_MMAE is the mean over steps and numbers of (|true| + epsilon) |true - motion|."""
    motion, true = windows()
    total = 0.0
    for b in range(5):
        for i in range(4):
            for k in range(6):
                m, t = float(motion[b, i, k]), float(true[b, i, k])
                total += (abs(t) + 2) * abs(t - m)

    loss = mmae_loss(motion, true)

    assert float(loss) == pytest.approx(total / (5 * 4 * 6), abs=ROUND_OFF)


def test_mmae_counts_a_fast_step_more():
    """An error of 1 in a motion of 3 costs 3 + 2, and in one of 0 it costs 2."""
    true = torch.zeros(1, 1, 6)
    true[..., 0] = 3

    fast = mmae_loss(true + torch.eye(6)[0], true)
    slow = mmae_loss(true + torch.eye(6)[1], true)

    assert float(fast) == pytest.approx(5 / 6)
    assert float(slow) == pytest.approx(2 / 6)


def test_mmae_learns_from_the_prediction_alone():
    """The weight is a number: its slope is that of the plain error times the weight."""
    motion, true = windows()
    motion.requires_grad_()

    (slope,) = torch.autograd.grad(mmae_loss(motion, true), motion)

    expected = (true.abs() + 2) * (motion - true).sign() / true.numel()
    torch.testing.assert_close(slope, expected.detach())


def test_correlation_is_the_papers_mean_cosine():
    """L_Corr is 1 less the cosine over the steps, averaged over the six numbers."""
    motion, true = windows()
    cosines = [cosine(motion[b, :, k], true[b, :, k]) for b in range(5) for k in range(6)]

    loss = correlation_loss(motion, true)

    assert float(loss) == pytest.approx(1 - sum(cosines) / 30, abs=ROUND_OFF)


def test_batch_correlation_is_one_cosine():
    """As released: all numbers of the batch are one vector."""
    motion, true = windows()

    loss = batch_correlation_loss(motion, true)

    assert float(loss) == pytest.approx(1 - cosine(motion.flatten(), true.flatten()), abs=ROUND_OFF)


def test_correlation_does_not_see_the_scale_of_a_number():
    """Each of the six may be scaled as one likes; turned round, it costs 2."""
    _, true = windows()

    scaled = correlation_loss(true * torch.tensor([1, 2, 3, 0.1, 5, 7.0]), true)
    opposite = correlation_loss(-true, true)

    assert float(scaled) == pytest.approx(0, abs=ROUND_OFF)
    assert float(opposite) == pytest.approx(2, abs=ROUND_OFF)


def test_correlation_is_finite_at_rest():
    """A probe that rests has no direction: the loss is 1, and its slope is finite."""
    motion = torch.zeros(2, 3, 6, requires_grad=True)

    loss = correlation_loss(motion, torch.zeros(2, 3, 6))
    loss.backward()

    assert float(loss.detach()) == pytest.approx(1)
    assert motion.grad is not None
    assert bool(motion.grad.isfinite().all())


def plain_triplet(embedding: Tensor, true: Tensor, margin: float) -> float:
    """Return the triplet loss by loops."""
    costs = []
    for a, p, n in permutations(range(len(true)), 3):
        if cosine(true[a], true[p]) > cosine(true[a], true[n]):
            near = float((embedding[a] - embedding[p]).norm())
            far = float((embedding[a] - embedding[n]).norm())
            costs.append(max(0.0, near - far + margin))
    return sum(costs) / len(costs)


def test_triplet_is_the_mean_over_all_triplets():
    """Every sample is an anchor with every two others, as loops have it."""
    draw = torch.Generator().manual_seed(3)
    embedding, true = torch.randn(7, 9, generator=draw), torch.randn(7, 6, generator=draw)

    loss = triplet_loss(embedding, true, 0.1)

    assert float(loss) == pytest.approx(plain_triplet(embedding, true, 0.1), abs=1e-5)


def test_triplet_is_not_rounded_in_half_precision():
    """Motions whose cosines differ by less than 0.4 % still have an order."""
    draw = torch.Generator().manual_seed(4)
    embedding = torch.randn(8, 9, generator=draw)
    true = torch.tensor([1.0, 0, 0, 0, 0, 0]) + 0.05 * torch.randn(8, 6, generator=draw)

    with torch.autocast("cpu", torch.bfloat16):
        loss = triplet_loss(embedding, true, 0.1)

    assert float(loss) == pytest.approx(plain_triplet(embedding, true, 0.1), abs=1e-5)


def test_triplet_of_three():
    """Two like motions 3 apart and an unlike one between them, 1 from the first.

    Anchor 0: positive 1 at 3, negative 2 at 1, cost 2.1. Anchor 1: positive 0 at 3, negative
    2 at 2, cost 1.1. Anchor 2: both others are as unlike, a tie, which is left out.
    """
    embedding = torch.tensor([[0.0], [3.0], [1.0]])
    true = torch.zeros(3, 6)
    true[0, 0], true[1, 0], true[2, 1] = 1, 2, 1

    loss = triplet_loss(embedding, true, 0.1)

    assert float(loss) == pytest.approx((2.1 + 1.1) / 2, abs=ROUND_OFF)


def test_triplet_of_like_motions_is_nothing():
    """If all motions are the same, no triplet is left, and no margin is paid."""
    embedding = torch.zeros(4, 3, requires_grad=True)

    loss = triplet_loss(embedding, torch.ones(4, 6))
    loss.backward()

    assert float(loss.detach()) == 0
    assert embedding.grad is not None
    assert bool(embedding.grad.isfinite().all())


def test_triplet_of_equal_embeddings_has_a_finite_slope():
    """The distance has a kink at 0; the slope there is still a number."""
    embedding = torch.zeros(4, 3, requires_grad=True)
    _, true = windows(batch=4, steps=1)

    loss = triplet_loss(embedding, true[:, 0])
    loss.backward()

    assert float(loss.detach()) == pytest.approx(0.1)
    assert embedding.grad is not None
    assert bool(embedding.grad.isfinite().all())


def test_huber_is_l1_far_out_and_squared_near():
    """From the width on it is the error less half the width; below, its square over 2 widths."""
    true = torch.zeros(1, 1, 6)

    far = huber_loss(true + 3, true, 0.5)
    near = huber_loss(true + 0.2, true, 0.5)

    assert float(far) == pytest.approx(3 - 0.25)
    assert float(near) == pytest.approx(0.2**2 / (2 * 0.5))


def test_gaussian_is_least_at_the_true_variance():
    """For errors of 0.5 the best variance is 0.25, which costs ln(0.25) / 2 + 1 / 2."""
    motion = torch.full((1, 1, 6), 0.5)
    best = 2 * math.log(0.5)
    costs = [
        float(gaussian_loss(motion, torch.full((1, 1, 6), best + shift), torch.zeros(1, 1, 6)))
        for shift in (-0.1, 0.0, 0.1)
    ]

    assert costs[1] == min(costs)
    assert costs[1] == pytest.approx(best / 2 + 0.5, abs=ROUND_OFF)


@pytest.mark.parametrize(
    "loss", [l1_loss, huber_loss, mmae_loss, correlation_loss, batch_correlation_loss]
)
def test_the_truth_costs_nothing(loss):
    """A loss that compares motions is 0 at the truth and above it elsewhere."""
    motion, true = windows()

    assert float(loss(true, true)) == pytest.approx(0, abs=ROUND_OFF)
    assert float(loss(motion, true)) > 0.1


def test_the_sum_is_the_papers():
    """L_Final = MMAE + Corr + .005 Triplet, the first two averaged over the heads."""
    first, true = windows(1)
    second, _ = windows(2)
    embedding = torch.randn(5, 8, generator=torch.Generator().manual_seed(4))
    settings = LossSettings(mmae=1, correlation=1, triplet=0.005)
    output = NetworkOutput((first + second) / 2, (first, second), embedding=embedding)

    loss, parts = total_loss(settings, output, true)

    mmae = (mmae_loss(first, true) + mmae_loss(second, true)) / 2
    corr = (correlation_loss(first, true) + correlation_loss(second, true)) / 2
    triplet = triplet_loss(embedding, true[:, -1])
    assert float(loss) == pytest.approx(float(mmae + corr + 0.005 * triplet), abs=ROUND_OFF)
    assert set(parts) == {"mmae", "correlation", "triplet"}


def test_every_head_is_supervised():
    """Each head has a slope of its own, as in the released code."""
    heads = [part.clone().requires_grad_() for part in windows()]
    output = NetworkOutput((heads[0] + heads[1]) / 2, (heads[0], heads[1]))

    loss, _ = total_loss(LossSettings(l1=1.0), output, windows(9)[0])
    loss.backward()

    assert all(head.grad is not None and bool((head.grad != 0).all()) for head in heads)


def test_a_network_without_embedding_has_no_triplet_loss():
    """The same recipe trains networks whose papers contrast nothing."""
    motion, true = windows()

    _, parts = total_loss(
        LossSettings(l1=1.0, triplet=0.005), NetworkOutput(motion, (motion,)), true
    )

    assert set(parts) == {"l1"}


@pytest.mark.parametrize(
    ("settings", "message"),
    [(LossSettings(), "no loss counts"), (LossSettings(gaussian=1.0), "predicts a variance")],
)
def test_a_sum_of_nothing_is_refused(settings, message):
    """Nothing to make small, or a likelihood without variance, is said."""
    motion, true = windows()

    with pytest.raises(TrainingError, match=message):
        total_loss(settings, NetworkOutput(motion, (motion,)), true)
