"""Bootstrap intervals."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from sonosweep.errors import ScanError
from sonosweep.evaluate import bootstrap_interval, paired_interval

# Resampling 10,000 times knows an end of a 95 % interval to about 2 % of its width.
RESAMPLING = 0.05
numbers = st.lists(st.floats(-100, 100), min_size=2, max_size=20)


@given(numbers)
def test_the_interval_holds_the_mean_and_stays_within_the_values(values):
    """A mean of drawn values is never outside the values."""
    found = bootstrap_interval(values, resamples=500)

    assert found.mean == pytest.approx(sum(values) / len(values), abs=1e-9)
    assert min(values) - 1e-9 <= found.low <= found.high <= max(values) + 1e-9
    assert found.count == len(values)


@given(numbers, st.floats(-10, 10), st.floats(0.1, 10))
def test_shift_and_scale_go_through(values, shift, scale):
    """Another unit gives the same interval in that unit."""
    found = bootstrap_interval(values, resamples=500)

    moved = bootstrap_interval([scale * value + shift for value in values], resamples=500)

    assert (moved.low, moved.high) == pytest.approx(
        (scale * found.low + shift, scale * found.high + shift), abs=1e-8
    )


def test_two_values_by_hand():
    """Of 0 and 1 a quarter of all draws is 0 and a quarter 1: those are the ends."""
    found = bootstrap_interval([0.0, 1.0])

    assert (found.mean, found.low, found.high) == (0.5, 0, 1)


def test_many_values_approach_the_normal_interval():
    """For a large sample the interval is the mean and 1.96 standard errors to either side."""
    values = torch.randn(2000, generator=torch.Generator().manual_seed(0)).double()
    error = float(values.std()) / math.sqrt(2000)

    found = bootstrap_interval(values.tolist(), resamples=4000)

    assert found.low == pytest.approx(
        float(values.mean()) - 1.96 * error, abs=4 * RESAMPLING * error
    )
    assert found.high == pytest.approx(
        float(values.mean()) + 1.96 * error, abs=4 * RESAMPLING * error
    )


def test_scans_of_one_subject_are_no_independent_evidence():
    """Ten copies of each of four scans leave the interval as wide as that of the four."""
    four = [1.0, 2.0, 4.0, 8.0]
    copies = [value for value in four for _ in range(10)]
    subjects = [index for index in range(4) for _ in range(10)]

    grouped = bootstrap_interval(copies, subjects)

    plain = bootstrap_interval(four)
    assert (grouped.low, grouped.high) == (plain.low, plain.high)
    assert grouped.count == 40
    alone = bootstrap_interval(copies)
    assert alone.high - alone.low < 0.5 * (plain.high - plain.low)


def test_groups_of_different_size_keep_the_mean():
    """The mean is over scans, however they are grouped."""
    assert bootstrap_interval([1.0, 1.0, 4.0], ["a", "a", "b"]).mean == 2


def test_one_scan_has_no_interval():
    """Nothing is known of the spread of one value, or of one subject."""
    assert bootstrap_interval([3.0]).low is None
    assert bootstrap_interval([3.0, 4.0], ["a", "a"]).high is None


def test_pairs_tell_apart_what_means_do_not():
    """A small but constant gain on scans of very different difficulty is seen."""
    first = [1.0, 10.0, 100.0, 1000.0]
    second = [value + 0.5 for value in first]

    found = paired_interval(first, second)

    assert found.high < 0
    assert found.mean == pytest.approx(-0.5)


def test_the_same_table_twice():
    """Without a generator the draws are always the same; with one they are its own."""
    values = [1.0, 5.0, 2.0, 9.0, 4.0]

    assert bootstrap_interval(values) == bootstrap_interval(values)
    other = bootstrap_interval(values, resamples=50, generator=torch.Generator().manual_seed(1))
    assert other != bootstrap_interval(values, resamples=50)


def test_what_has_no_interval():
    """No values, NaN, odd counts and odd confidences are refused."""
    with pytest.raises(ScanError, match="needs numbers"):
        bootstrap_interval([])
    with pytest.raises(ScanError, match="needs numbers"):
        bootstrap_interval([1.0, math.nan])
    with pytest.raises(ScanError, match="2 values but 1 groups"):
        bootstrap_interval([1.0, 2.0], ["a"])
    with pytest.raises(ScanError, match="between 0 and 1, got 95"):
        bootstrap_interval([1.0, 2.0], confidence=95.0)
    with pytest.raises(ScanError, match="got 2 and 1"):
        paired_interval([1.0, 2.0], [1.0])
