"""Subjects in one part only."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonosweep.errors import ScanError
from sonosweep.scan.split import Split, split_by_subject

shares = st.tuples(*[st.floats(0.05, 1)] * 3).map(lambda s: tuple(x / sum(s) for x in s))
cohorts = st.lists(st.sampled_from([f"P{i:02d}" for i in range(12)]), min_size=1, max_size=60)


@given(cohorts, shares, st.integers(0, 5))
def test_every_scan_is_in_one_part_and_every_subject_too(subjects, sizes, seed):
    """Parts are disjoint in scans and subjects, and leave none out."""
    if len(set(subjects)) < 3:
        subjects = [*subjects, "a", "b", "c"]

    split = split_by_subject(subjects, sizes, seed)

    parts = (split.train, split.validation, split.test)
    assert sorted(sum(parts, ())) == list(range(len(subjects)))
    groups = [{subjects[i] for i in part} for part in parts]
    assert sum(len(group) for group in groups) == len(set(subjects))
    assert all(groups)


@given(cohorts.filter(lambda c: len(set(c)) >= 3), shares, st.integers(0, 5), st.randoms())
def test_the_order_of_the_scans_does_not_matter(subjects, sizes, seed, random):
    """The same subjects land in the same part however the files are sorted."""
    shuffled = random.sample(subjects, len(subjects))

    a, b = split_by_subject(subjects, sizes, seed), split_by_subject(shuffled, sizes, seed)

    assert {subjects[i] for i in a.test} == {shuffled[i] for i in b.test}


def test_the_papers_cohort():
    """5, 1 and 3 subjects of 6 scans each are 30, 6 and 18 scans."""
    subjects = [f"{i // 6:03d}" for i in range(54)]

    split = split_by_subject(subjects, (5, 1, 3))

    assert [len(part) for part in (split.train, split.validation, split.test)] == [30, 6, 18]
    assert split == split_by_subject(subjects, (5, 1, 3))
    assert any(split != split_by_subject(subjects, (5, 1, 3), seed) for seed in range(1, 5))


def test_shares_of_ten_subjects():
    """70, 20 and 10 per cent of ten subjects are 7, 2 and 1."""
    split = split_by_subject([f"{i}" for i in range(10)], (0.7, 0.2, 0.1))

    assert [len(part) for part in (split.train, split.validation, split.test)] == [7, 2, 1]


def test_a_part_may_be_empty():
    """No validation is a choice, and gets nobody."""
    assert split_by_subject(["a", "b"], (0.5, 0.0, 0.5)).validation == ()


def test_a_leak_is_refused():
    """A subject in training and test is named."""
    with pytest.raises(ScanError, match="subject 'P1' is in train and in test"):
        Split(("P1", "P1"), train=(0,), validation=(), test=(1,))
    with pytest.raises(ScanError, match="scan 0 is in the split twice"):
        Split(("P1",), train=(0,), validation=(), test=(0,))
    with pytest.raises(ScanError, match="train names scan 3 of 1"):
        Split(("P1",), train=(3,), validation=(), test=())


@pytest.mark.parametrize(
    ("subjects", "sizes", "message"),
    [
        (["a", None], (1, 0, 1), "scan 1 names no subject"),
        (["a", ""], (1, 0, 1), "scan 1 names no subject"),
        (["a", "b"], (1, 0, 0), "must use each once"),
        (["a", "b"], (0.5, 0.2, 0.1), "must sum to 1"),
        (["a", "b"], (0.5, -0.5, 1.0), "0 or more"),
        (["a", "b"], (0.4, 0.3, 0.3), "2 subjects cannot fill 3 parts"),
    ],
)
def test_splits_that_cannot_be(subjects, sizes, message):
    """Sizes that do not add up are refused with their values."""
    with pytest.raises(ScanError, match=message):
        split_by_subject(subjects, sizes)
