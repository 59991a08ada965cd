"""What every estimator of motion gives and takes."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from sonosweep.errors import ScanError
from sonosweep.scan import Scan

Progress = Callable[[int, int], None]
"""Called with (done, total) as a long computation goes on."""


@dataclass(frozen=True, eq=False)
class MotionEstimate:
    """The motion from each frame to the next.

    Attributes:
        motion: Of each step, mm and rad, as in :mod:`sonosweep.geometry.motion`.
        std: Standard deviation of each of these numbers; ``None`` if the method has none.
        assumptions: One sentence each on what was assumed and could be wrong.
    """

    motion: Float[Tensor, "steps motion=6"]
    std: Float[Tensor, "steps motion=6"] | None = None
    assumptions: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Check that the numbers are finite.

        Raises:
            ScanError: If a motion is not a number.
        """
        if not bool(self.motion.isfinite().all()):
            raise ScanError("the estimated motion is not finite: are the frames empty?")


class MotionEstimator(ABC):
    """Reads the motion of the probe off the frames of a scan."""

    @property
    def name(self) -> str:
        """What results call the method."""
        return type(self).__name__

    @abstractmethod
    def estimate(self, scan: Scan, progress: Progress | None = None) -> MotionEstimate:
        """Return the motion between consecutive frames; tracked poses are never looked at.

        The elevational motion is reported as if the sweep went forward (+z): images of
        speckle alone cannot tell, so the caller knows.

        Raises:
            ScanError: If the scan has fewer than two frames, or no pixel spacing.
        """
