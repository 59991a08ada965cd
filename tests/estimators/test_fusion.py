"""Steps from overlapping pairs."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from sonosweep.estimators.fusion import MARGIN, WINDOW, PairMotion, fuse_pairs
from sonosweep.estimators.plane_fit import PlaneFit

ROUND_OFF = 1e-6  # normal equations square the condition of weights from 1 to 1e4
FAR = 1e-4  # relative; what steps beyond the margin of a window still say


def random_pairs(seed: int, steps: int, exact: bool):
    """Return true steps, pairs that measure sums of them, and a weak prior."""
    rng = np.random.default_rng(seed)
    true = rng.normal(size=(steps, 3))
    pairs = []
    for last in range(1, steps + 1):
        for baseline in (1, 2, 4):
            if last - baseline < 0:
                continue
            root = rng.normal(size=(3, 3)) + 3 * np.eye(3)
            value = true[last - baseline : last].sum(axis=0)
            value = value + (0 if exact else rng.normal(size=3))
            pairs.append(PairMotion(last - baseline, last, PlaneFit(value, root @ root.T)))
    return true, pairs


@given(seed=st.integers(0, 1000), steps=st.integers(1, 30))
def test_exact_pairs_give_the_exact_steps(seed, steps):
    """Pairs that agree leave nothing to weigh."""
    true, pairs = random_pairs(seed, steps, exact=True)

    value, _ = fuse_pairs(pairs, steps, np.full(3, 1e6))

    assert np.abs(value - true).max() < ROUND_OFF


@given(seed=st.integers(0, 1000))
@settings(max_examples=5)
def test_the_fusion_is_the_dense_least_squares(seed):
    """The banded solution is the one of the whole matrix, and so are its deviations."""
    steps, prior = 2 * WINDOW + MARGIN, np.array([2.0, 0.5, 1.0])
    _, pairs = random_pairs(seed, steps, exact=False)
    matrix = np.kron(np.eye(steps), np.diag(1 / prior**2))
    right = np.zeros(3 * steps)
    for pair in pairs:
        span = np.zeros((3, 3 * steps))
        for step in range(pair.first, pair.last):
            span[:, 3 * step : 3 * step + 3] = np.eye(3)
        matrix += span.T @ pair.fit.information @ span
        right += span.T @ pair.fit.information @ pair.fit.value

    value, std = fuse_pairs(pairs, steps, prior)

    np.testing.assert_allclose(value.ravel(), np.linalg.solve(matrix, right), atol=ROUND_OFF)
    dense = np.sqrt(np.diag(np.linalg.inv(matrix))).reshape(-1, 3)
    np.testing.assert_allclose(std, dense, rtol=FAR)


def test_long_pairs_lower_the_deviation():
    """A pair over four frames that agrees with the short ones makes each step surer."""
    _, pairs = random_pairs(0, 12, exact=True)
    short = [pair for pair in pairs if pair.last - pair.first == 1]

    _, alone = fuse_pairs(short, 12, np.full(3, 1e3))
    _, together = fuse_pairs(pairs, 12, np.full(3, 1e3))

    assert (together < alone).all()
