"""One recording of a sweep."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sonosweep.errors import ScanError
from sonosweep.geometry import is_rigid
from sonosweep.scan.calibration import Calibration
from sonosweep.scan.frames import Frames
from sonosweep.scan.region import Region


@dataclass(frozen=True, eq=False)
class Companion:
    """Frames of another modality, one for each B-mode frame and in the same plane.

    Attributes:
        frames: As many frames as the scan has.
        spacing_mm: Distance between neighbouring columns and rows.
        origin_mm: Where the centre of the first pixel lies in the scan's image
            coordinates (lateral, axial).
    """

    frames: Frames
    spacing_mm: tuple[float, float]
    origin_mm: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        """Check the spacing.

        Raises:
            ScanError: If it is not positive and finite.
        """
        if not all(np.isfinite(value) and value > 0 for value in self.spacing_mm):
            raise ScanError(f"companion spacing must be above 0 mm, got {self.spacing_mm}")


@dataclass(frozen=True, eq=False)
class Scan:
    """What was recorded in one sweep. A scan is never modified.

    Attributes:
        name: What to call it, usually the file's name.
        frames: B-mode frames, read when indexed.
        calibration: Pixel size and image-to-probe pose; ``None`` if the file tells none.
        timestamps_s: Time of each frame, increasing; ``None`` if the file tells none.
        image_to_reference: Tracked pose of each frame, float64 mm; ``None`` without
            tracker. Poses that the tracker missed hold NaN and are marked in ``tracked``.
        tracked: Which poses are valid; ``None`` means all of them.
        subject: Who was scanned, as a code that names nobody.
        region: Where the image is within the frame; ``None`` means not looked for.
        companions: Frames of other modalities by name, such as ``"power_doppler"``.
        notes: What the reader found and could not express otherwise, by subject:
            ``notes["poses"]`` says why there are none, for example.
    """

    name: str
    frames: Frames
    calibration: Calibration | None = None
    timestamps_s: Float[Tensor, " frames"] | None = None
    image_to_reference: Float[Tensor, "frames 4 4"] | None = None
    tracked: Bool[Tensor, " frames"] | None = None
    subject: str | None = None
    region: Region | None = None
    companions: Mapping[str, Companion] = field(default_factory=dict)
    notes: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check that the parts belong together.

        Raises:
            ScanError: If counts differ, times do not increase, or a pose is not rigid.
        """
        if len(self.frames.shape) not in (3, 4) or min(self.frames.shape[1:]) < 1:
            raise ScanError(
                f"frames must have frames, rows and columns, got {self.frames.shape} in"
                f" '{self.name}'"
            )
        self._check_counts()
        self._check_times()
        self._check_poses()

    def _check_counts(self) -> None:
        counts = {
            "timestamps": self.timestamps_s,
            "poses": self.image_to_reference,
            "tracking flags": self.tracked,
            **{f"{name} frames": c.frames for name, c in self.companions.items()},
        }
        for what, values in counts.items():
            if values is not None and len(values) != len(self.frames):
                raise ScanError(
                    f"{len(self.frames)} frames but {len(values)} {what} in '{self.name}'"
                )

    def _check_times(self) -> None:
        times = self.timestamps_s
        if times is None:
            return
        if not bool(torch.isfinite(times).all()):
            raise ScanError(f"timestamps that are not numbers in '{self.name}'")
        if len(times) > 1 and not bool((times.diff() > 0).all()):
            first = int((times.diff() <= 0).nonzero()[0]) + 1
            raise ScanError(
                f"timestamps must increase, but frame {first} is not later than frame"
                f" {first - 1} in '{self.name}'"
            )

    def _check_poses(self) -> None:
        if self.image_to_reference is None:
            return
        valid = is_rigid(self.image_to_reference)
        if self.tracked is not None:
            valid = valid | ~self.tracked
        if not bool(valid.all()):
            frame = int((~valid).nonzero()[0])
            raise ScanError(
                f"the pose of frame {frame} in '{self.name}' is not rigid: the 3 x 3 part must"
                " be a rotation, without scale and without NaN"
            )
