"""Poses against time: what an estimator gives and a tracker measures."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sonosweep.errors import ScanError
from sonosweep.geometry import is_rigid


@dataclass(frozen=True, eq=False)
class Trajectory:
    """One pose per frame.

    Attributes:
        image_to_reference: Pose of each frame, float64 mm. Frame 0 of a sensorless
            trajectory is the identity.
        timestamps_s: Time of each frame; ``None`` if not known.
        step_std: Standard deviation of each step's motion (mm, rad); ``None`` if the
            method gives none.
        method: What made it: ``"tracked"`` or the name of an estimator.
        assumptions: One sentence each on what was assumed and could be wrong, such as the
            direction of the sweep.
        settings: How it was made, by name.
        frames: Which frame of the scan each pose belongs to, from 0; ``None`` if every
            frame has a pose.
    """

    image_to_reference: Float[Tensor, "frames 4 4"]
    timestamps_s: Float[Tensor, " frames"] | None = None
    step_std: Float[Tensor, "frames-1 motion=6"] | None = None
    method: str = "tracked"
    assumptions: tuple[str, ...] = ()
    settings: Mapping[str, str] = field(default_factory=dict)
    frames: Int[Tensor, " poses"] | None = None

    def __post_init__(self) -> None:
        """Check that there are poses, that they are rigid and that the counts agree.

        Raises:
            ScanError: If not.
        """
        frames = len(self.image_to_reference)
        if frames == 0:
            raise ScanError("a trajectory needs at least one pose")
        rigid = is_rigid(self.image_to_reference)
        if not bool(rigid.all()):
            raise ScanError(f"pose {int((~rigid).nonzero()[0])} of the trajectory is not rigid")
        if self.timestamps_s is not None and len(self.timestamps_s) != frames:
            raise ScanError(f"{frames} poses but {len(self.timestamps_s)} timestamps")
        if self.frames is not None and len(self.frames) != frames:
            raise ScanError(f"{frames} poses but {len(self.frames)} frame numbers")
        if self.step_std is not None:
            if self.step_std.shape != (frames - 1, 6):
                raise ScanError(f"{frames} poses but {len(self.step_std)} step deviations")
            if not bool((self.step_std >= 0).all() & torch.isfinite(self.step_std).all()):
                raise ScanError("step deviations must be 0 or more")
