"""Which random numbers are whose: what training may see and what is kept for tests."""

from collections.abc import Iterable

import numpy as np

from sonosweep.errors import ScanError

FIRST_TEST_SUBJECT = 900_000
LAST_SUBJECT = 999_999


def generator(subject: int, scan: int, purpose: str) -> np.random.Generator:
    """Return the random numbers of one purpose, such as ``"motion"``, of one scan.

    They depend on nothing else: not on the order in which scans are made, nor on what was
    drawn for another purpose.

    Raises:
        ScanError: If there is no such subject or scan.
    """
    subject_name(subject)
    if scan < 0:
        raise ScanError(f"the number of a scan must be 0 or more, got {scan}")
    words = [subject, scan, *purpose.encode()]
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(words)))


def subject_name(subject: int) -> str:
    """Return the name under which a simulated subject stands in scans."""
    if not 0 <= subject <= LAST_SUBJECT:
        raise ScanError(f"a simulated subject has a number from 0 to {LAST_SUBJECT}, got {subject}")
    return f"simulated-{subject:06d}"


def refuse_test_subjects(subjects: Iterable[str | None]) -> None:
    """Refuse to learn from subjects that are kept for tests.

    Raises:
        ScanError: If one of the names is that of a simulated subject from 900000 on.
    """
    for name in subjects:
        kind, _, number = (name or "").rpartition("-")
        if kind == "simulated" and number.isdecimal() and int(number) >= FIRST_TEST_SUBJECT:
            raise ScanError(
                f"subject '{name}' is kept for tests: simulated subjects from"
                f" {FIRST_TEST_SUBJECT} on must not be trained on"
            )
