"""Scans for training, validation and test, with no subject in two of them."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

from sonosweep.errors import ScanError

PARTS = ("train", "validation", "test")


@dataclass(frozen=True)
class Split:
    """Which scans are for what, by their place in the list of scans.

    Attributes:
        subjects: Of every scan.
        train: Scans to learn from.
        validation: Scans to choose settings with.
        test: Scans to report on.
    """

    subjects: tuple[str, ...]
    train: tuple[int, ...]
    validation: tuple[int, ...]
    test: tuple[int, ...]

    def __post_init__(self) -> None:
        """Check that no scan and no subject is in two parts.

        Raises:
            ScanError: If one is, naming it.
        """
        found: dict[str, str] = {}
        seen: set[int] = set()
        for part in PARTS:
            for scan in getattr(self, part):
                if not 0 <= scan < len(self.subjects):
                    raise ScanError(f"{part} names scan {scan} of {len(self.subjects)}")
                if scan in seen:
                    raise ScanError(f"scan {scan} is in the split twice")
                seen.add(scan)
                subject = self.subjects[scan]
                if found.setdefault(subject, part) != part:
                    raise ScanError(
                        f"subject '{subject}' is in {found[subject]} and in {part}: all scans of"
                        " a subject must be in one part"
                    )


def split_by_subject(
    subjects: Sequence[str | None],
    sizes: tuple[int, int, int] | tuple[float, float, float],
    seed: int = 0,
) -> Split:
    """Return a split of scans in which each subject is in one part.

    The same subjects, sizes and seed give the same split, in whatever order the scans come.

    Args:
        subjects: Of each scan; each must be named.
        sizes: Subjects for training, validation and test: whole numbers that use every
            subject, or shares that sum to 1. A share above 0 gets one subject or more.
        seed: Another number gives another split.

    Raises:
        ScanError: If a subject is not named, the sizes do not add up, or there are fewer
            subjects than parts to fill.
    """
    names = []
    for scan, subject in enumerate(subjects):
        if not subject:
            raise ScanError(f"scan {scan} names no subject: a split by subject needs all of them")
        names.append(subject)
    # By hash and not by a random generator: the order must not change with a library.
    order = sorted(set(names), key=lambda name: hashlib.sha256(f"{seed}/{name}".encode()).digest())
    counts = _counts(sizes, len(order))
    part_of: dict[str, str] = {}
    for part, count in zip(PARTS, counts, strict=True):
        for _ in range(count):
            part_of[order[len(part_of)]] = part
    scans = {
        part: tuple(i for i, name in enumerate(names) if part_of[name] == part) for part in PARTS
    }
    return Split(tuple(names), scans["train"], scans["validation"], scans["test"])


def _counts(
    sizes: tuple[int, int, int] | tuple[float, float, float], subjects: int
) -> tuple[int, int, int]:
    """Return how many subjects each part gets."""
    if any(not size >= 0 for size in sizes):
        raise ScanError(f"the parts of a split must be 0 or more, got {sizes}")
    if all(isinstance(size, int) for size in sizes):
        if sum(sizes) != subjects:
            raise ScanError(f"a split {sizes} of {subjects} subjects must use each once")
        return (int(sizes[0]), int(sizes[1]), int(sizes[2]))
    if abs(sum(sizes) - 1) > 1e-6:
        raise ScanError(f"the shares of a split must sum to 1, got {sizes}")
    wanted = [size > 0 for size in sizes]
    if subjects < sum(wanted):
        raise ScanError(f"{subjects} subjects cannot fill {sum(wanted)} parts")
    # One each, then the rest one by one to the part that lacks most.
    counts = [int(want) for want in wanted]
    while sum(counts) < subjects:
        lacking = [size * subjects - count for size, count in zip(sizes, counts, strict=True)]
        counts[lacking.index(max(lacking))] += 1
    return (counts[0], counts[1], counts[2])
