"""How sure a mean over scans is: bootstrap intervals."""

import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sonosweep.errors import ScanError

DRAWS_AT_ONCE = 2_000_000


@dataclass(frozen=True)
class Interval:
    """A mean and where it may lie.

    Attributes:
        mean: Over the values.
        low: Lower end; ``None`` with fewer than two independent values.
        high: Upper end, likewise.
        count: How many values there were.
    """

    mean: float
    low: float | None
    high: float | None
    count: int


def bootstrap_interval(
    values: Sequence[float],
    groups: Sequence[Hashable] | None = None,
    confidence: float = 0.95,
    resamples: int = 10_000,
    generator: torch.Generator | None = None,
) -> Interval:
    """Return the mean of the values and the interval of the percentile bootstrap.

    With few values the interval is too narrow: of five, by about a quarter.

    Args:
        values: One per scan.
        groups: Of each value, such as its subject: whole groups are drawn, because scans
            of one subject tell less than scans of several. Each value its own when ``None``.
        confidence: How often the interval should hold the true mean.
        resamples: How many times to draw.
        generator: For the draws; one of a fixed seed when ``None``, so that a table made
            twice is the same.

    Raises:
        ScanError: If there is no value, one is not a number, or the counts differ.

    References:
        Efron, "Bootstrap methods: another look at the jackknife", 1979.
    """
    if not values or not all(math.isfinite(value) for value in values):
        raise ScanError(f"an interval needs numbers, got {list(values)[:5]}")
    if not (0 < confidence < 1 and resamples > 0):
        raise ScanError(f"confidence must be between 0 and 1, got {confidence:g}")
    sums, counts = _by_group(values, groups)
    mean = float(sums.sum() / counts.sum())
    if len(sums) < 2:
        return Interval(mean, None, None, len(values))
    generator = generator or torch.Generator().manual_seed(0)
    means = []
    chunk = max(DRAWS_AT_ONCE // len(sums), 1)
    for start in range(0, resamples, chunk):
        size = (min(chunk, resamples - start), len(sums))
        drawn = torch.randint(len(sums), size, generator=generator)
        means.append(sums[drawn].sum(1) / counts[drawn].sum(1))
    tail = (1 - confidence) / 2
    ends = torch.cat(means).quantile(torch.tensor([tail, 1 - tail], dtype=torch.float64))
    return Interval(mean, float(ends[0]), float(ends[1]), len(values))


def paired_interval(
    first: Sequence[float],
    second: Sequence[float],
    groups: Sequence[Hashable] | None = None,
    confidence: float = 0.95,
    resamples: int = 10_000,
    generator: torch.Generator | None = None,
) -> Interval:
    """Return the mean of first minus second over the same scans, with its interval.

    If the interval does not hold 0 the two differ, at this confidence. What makes a scan
    hard for both drops out, so this tells apart what two separate intervals do not.

    Args:
        first: One value per scan.
        second: One value per scan, in the same order.
        groups: As in :func:`bootstrap_interval`, and so are the others.
        confidence: How often the interval should hold the true difference.
        resamples: How many times to draw.
        generator: For the draws.

    Raises:
        ScanError: As :func:`bootstrap_interval`.
    """
    if len(first) != len(second):
        raise ScanError(f"pairs need as many of both, got {len(first)} and {len(second)}")
    differences = [a - b for a, b in zip(first, second, strict=True)]
    return bootstrap_interval(differences, groups, confidence, resamples, generator)


def _by_group(values: Sequence[float], groups: Sequence[Hashable] | None) -> tuple[Tensor, Tensor]:
    """Return the sum and the count of the values of each group."""
    names = list(range(len(values))) if groups is None else list(groups)
    if len(names) != len(values):
        raise ScanError(f"{len(values)} values but {len(names)} groups")
    place = {name: i for i, name in enumerate(dict.fromkeys(names))}
    index = torch.tensor([place[name] for name in names])
    sums = torch.zeros(len(place), dtype=torch.float64)
    counts = torch.zeros(len(place), dtype=torch.float64)
    sums.index_add_(0, index, torch.tensor(list(values), dtype=torch.float64))
    counts.index_add_(0, index, torch.ones(len(values), dtype=torch.float64))
    return sums, counts
