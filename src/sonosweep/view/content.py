"""What a report says: results that other layers computed, ready to be shown."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from sonosweep.errors import ScanError
from sonosweep.scan import Frames, Trajectory, Volume

Metric = tuple[float | int | None, str]
"""A value, ``None`` where it is not defined, and its unit."""


@dataclass(frozen=True, eq=False)
class ReportRun:
    """One reconstruction of the scan.

    Attributes:
        name: What the reader calls it, such as ``"tracked"`` or ``"sensorless"``.
        trajectory: Where each frame was taken to be.
        volume: The B-mode volume; ``None`` if none was made.
        companions: Volumes of other modalities by name.
        metrics: Value and unit by name, against the tracker; ``None`` if there is none.
        drift_mm: How far each frame is from its tracked place; ``None`` if not known.
    """

    name: str
    trajectory: Trajectory
    volume: Volume | None = None
    companions: Mapping[str, Volume] = field(default_factory=dict)
    metrics: Mapping[str, Metric] | None = None
    drift_mm: Float[np.ndarray, " frames"] | None = None


@dataclass(frozen=True, eq=False)
class Report:
    """Everything on the page. Parts that are empty or ``None`` are left out.

    Attributes:
        title: Heading.
        facts: Label and value of what the scan holds.
        runs: Reconstructions, the one to trust most first, all in one reference.
        verdict: One sentence or more on how good the result is.
        assumptions: One sentence each on what was assumed.
        outputs: Files that were written, by name.
        command: The command that made all this.
        versions: Version by program or library.
        frames: The scan's B-mode frames, for the cine strip.
        spacing_mm: Distance between their neighbouring columns and rows.
    """

    title: str
    facts: tuple[tuple[str, str], ...]
    runs: tuple[ReportRun, ...]
    verdict: tuple[str, ...] = ()
    assumptions: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    command: str = ""
    versions: Mapping[str, str] = field(default_factory=dict)
    frames: Frames | None = None
    spacing_mm: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        """Check that there is something to show.

        Raises:
            ScanError: If there is no run.
        """
        if not self.runs:
            raise ScanError("a report needs at least one reconstruction")

    @property
    def frame_size_mm(self) -> tuple[float, float] | None:
        """Width and depth of a frame between the centres of its outer pixels."""
        if self.frames is None or self.spacing_mm is None:
            return None
        rows, columns = self.frames.shape[1:3]
        return (columns - 1) * self.spacing_mm[0], (rows - 1) * self.spacing_mm[1]
