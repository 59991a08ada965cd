"""Steps from the motions of overlapping frame pairs, by weighted least squares.

The motion from frame i to frame i + k is the sum of the k steps between them (turns within
a few frames are far below a radian, so SE(3) needs no more than that sum: a full
Gauss-Newton was measured to change nothing). Every pair adds its information to each pair
of steps it spans, which gives banded normal equations.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.linalg import solveh_banded

from sonosweep.estimators.plane_fit import PlaneFit

WINDOW = 64
"""Steps whose covariance is computed together."""

MARGIN = 16
"""Steps on either side that still matter for it, four times the longest pair."""


@dataclass(frozen=True, eq=False)
class PairMotion:
    """What two frames say about the motion between them.

    Attributes:
        first: Index of the earlier frame.
        last: Index of the later frame.
        fit: The motion and its information.
    """

    first: int
    last: int
    fit: PlaneFit


def fuse_pairs(
    pairs: list[PairMotion],
    steps: int,
    prior_std: Float[np.ndarray, "unknowns=3"],
) -> tuple[Float[np.ndarray, "steps unknowns=3"], Float[np.ndarray, "steps unknowns=3"]]:
    """Return the most probable value of every step, and its standard deviation.

    Args:
        pairs: Pairs of frames, in any order.
        steps: How many steps there are.
        prior_std: How far steps are from zero before anything is measured; small for
            turns, which images of a narrow field of view tell badly.
    """
    reach = max((pair.last - pair.first for pair in pairs), default=1)
    blocks = np.zeros((reach, steps, 3, 3))
    right = np.zeros((steps, 3))
    blocks[0] += np.diag(1 / prior_std**2)
    for pair in pairs:
        weighted = pair.fit.information @ pair.fit.value
        for a in range(pair.first, pair.last):
            right[a] += weighted
            for b in range(a, pair.last):
                blocks[b - a, a] += pair.fit.information
    value = solveh_banded(_banded(blocks), right.ravel(), lower=True)
    return value.reshape(steps, 3), _standard_deviations(blocks)


def _banded(blocks: np.ndarray) -> np.ndarray:
    """Return the lower diagonals of a symmetric matrix from its blocks by offset."""
    reach, steps = blocks.shape[:2]
    banded = np.zeros((3 * reach, 3 * steps))
    for offset in range(reach):
        for row in range(3):
            for column in range(3):
                below = 3 * offset + row - column
                if below < 0:
                    continue
                count = steps - offset
                # Entry (3 (s + offset) + row, 3 s + column) lies in that column.
                banded[below, column : column + 3 * count : 3] = blocks[offset, :count, column, row]
    return banded


def _standard_deviations(blocks: np.ndarray) -> np.ndarray:
    """Return the marginal standard deviations, from windows of the inverse."""
    reach, steps = blocks.shape[:2]
    result = np.empty((steps, 3))
    for start in range(0, steps, WINDOW):
        low, high = max(0, start - MARGIN), min(steps, start + WINDOW + MARGIN)
        count = high - low
        dense = np.zeros((count, 3, count, 3))
        for offset in range(min(reach, count)):
            for s in range(count - offset):
                dense[s, :, s + offset, :] = blocks[offset, low + s]
                dense[s + offset, :, s, :] = blocks[offset, low + s].T
        variance = np.diagonal(np.linalg.inv(dense.reshape(3 * count, -1))).reshape(count, 3)
        stop = min(steps, start + WINDOW)
        result[start:stop] = np.sqrt(variance[start - low : stop - low])
    return result
