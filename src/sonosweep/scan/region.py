"""Where the image is within a frame: everything else is border, text or black."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool

from sonosweep.errors import ScanError


@dataclass(frozen=True, eq=False)
class Region:
    """The part of a frame that holds ultrasound.

    Attributes:
        rectangle_px: ``(column, row, width, height)`` that holds it.
        mask: Which pixels of the whole frame hold it, for a sector; ``None`` means the
            whole rectangle.
    """

    rectangle_px: tuple[int, int, int, int]
    mask: Bool[np.ndarray, "rows columns"] | None = None

    def __post_init__(self) -> None:
        """Check the rectangle.

        Raises:
            ScanError: If it is empty or starts outside the frame.
        """
        column, row, width, height = self.rectangle_px
        if column < 0 or row < 0 or width < 1 or height < 1:
            raise ScanError(
                "a region needs a corner inside the frame and a size of 1 pixel or more, got"
                f" {self.rectangle_px} (column, row, width, height)"
            )
