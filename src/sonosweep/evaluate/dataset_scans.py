"""The scans of a data set folder: those to learn from and those to report on."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from sonosweep.errors import ScanError
from sonosweep.io import open_scan
from sonosweep.scan.split import PARTS, Split
from sonosweep.simulate import dataset_files
from sonosweep.simulate.make import DATASET_NAME


@dataclass(frozen=True)
class DatasetScans:
    """What an evaluation uses of a data set.

    Attributes:
        recipe: Name of the data set, such as ``"dataset1"``.
        description: One line that says which data set it is.
        training: Files of its training scans.
        teaching: Files of scans from which the decorrelation estimator can learn a scale: those
            for training and, if they are not reported on, those for validation.
        scans: Files of the scans to report on.
    """

    recipe: str
    description: str
    training: tuple[Path, ...]
    teaching: tuple[Path, ...]
    scans: tuple[Path, ...]


def dataset_scans(
    folder: Path, part: Literal["validation", "test"] = "test", first: int | None = None
) -> DatasetScans:
    """Return the scans of a part of a data set, and its training scans.

    Args:
        folder: That ``sonosweep simulate --dataset`` made.
        part: To report on.
        first: Only so many scans of it.

    Raises:
        FormatError: If the folder holds no such data set, or not all of it.
        ScanError: If a subject is in two parts, or there is no scan to report on.
    """
    files = list(dataset_files(folder))
    _check_subjects(files)
    chosen = [path for of, path in files if of == part]
    if first is not None and not 1 <= first <= len(chosen):
        raise ScanError(f"the {part} part has {len(chosen)} scans: asked for the first {first}")
    if not chosen:
        raise ScanError(f"the data set in '{folder}' has no scans for {part}")
    facts = json.loads((folder / DATASET_NAME).read_text(encoding="utf-8"))
    tracker = "no tracker (exact poses)" if facts.get("tracker") is None else "a noisy tracker"
    training = tuple(path for of, path in files if of == "train")
    held_out = () if part == "validation" else tuple(p for of, p in files if of == "validation")
    description = (
        f"{facts.get('recipe')}, size {facts.get('size')}, seed {facts.get('seed')}, {tracker};"
        f" {part} part; mean motion of its {len(training)} training scans; digest"
        f" {str(facts.get('digest'))[:12]}"
    )
    return DatasetScans(
        recipe=str(facts.get("recipe")),
        description=description,
        training=training,
        teaching=(*training, *held_out),
        scans=tuple(chosen[: first or len(chosen)]),
    )


def _check_subjects(files: list[tuple[str, Path]]) -> None:
    """Refuse a data set in which a subject is in two parts."""
    subjects = []
    for _, path in files:
        scan = open_scan(path)
        subjects.append(scan.subject or scan.name)
    places = {part: tuple(i for i, (of, _) in enumerate(files) if of == part) for part in PARTS}
    Split(tuple(subjects), **places)
