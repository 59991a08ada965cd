"""The transducer."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sonosweep.errors import ScanError


@dataclass(frozen=True, eq=False)
class Probe:
    """Where the elements are and what they send.

    Attributes:
        name: Maker's name, such as ``"L11-5v"``.
        element_positions_mm: Centre of each element: lateral, axial, elevational. The
            array's centre is the origin; axial points into the body.
        element_width_mm: Lateral size of an element.
        center_frequency_hz: Centre of its band.
        elevation_aperture_mm: Height of the elements; ``None`` if not known.
        elevation_focus_mm: Depth at which the lens focuses; ``None`` if not known.
    """

    name: str
    element_positions_mm: Float[Tensor, "elements xyz=3"]
    element_width_mm: float
    center_frequency_hz: float
    elevation_aperture_mm: float | None = None
    elevation_focus_mm: float | None = None

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ScanError: If there is no element, or a size or frequency is not positive.
        """
        if len(self.element_positions_mm) == 0:
            raise ScanError(f"probe '{self.name}' has no elements")
        if not bool(torch.isfinite(self.element_positions_mm).all()):
            raise ScanError(f"element positions of probe '{self.name}' are not all numbers")
        numbers = {
            "element width (mm)": self.element_width_mm,
            "center frequency (Hz)": self.center_frequency_hz,
            "elevation aperture (mm)": self.elevation_aperture_mm,
            "elevation focus (mm)": self.elevation_focus_mm,
        }
        for what, value in numbers.items():
            if value is not None and not (np.isfinite(value) and value > 0):
                raise ScanError(f"{what} of probe '{self.name}' must be above 0, got {value:g}")
