"""What is scanned: tissue on voxels, and the vessels in it with their exact center lines."""

from dataclasses import dataclass, field
from enum import IntEnum
from typing import Literal

import numpy as np
from jaxtyping import Float, Float32

from sonosweep.errors import ScanError
from sonosweep.simulate.coded_voxels import Values


class Tissue(IntEnum):
    """What a voxel is made of."""

    OUTSIDE = 0  # air or the table: nothing comes back from here
    GEL = 1
    SKIN = 2
    FAT = 3
    FASCIA = 4
    MUSCLE = 5
    TENDON = 6
    NERVE = 7
    BONE = 8
    VESSEL_WALL = 9
    ARTERY = 10  # lumen
    VEIN = 11  # lumen


REFERENCE_CODE = 200  # echogenicity code of amplitude 1


def echo_amplitude() -> Float32[np.ndarray, "256"]:
    """Return the scatterers' amplitude for each echogenicity code.

    Code 0 is silent; code 200 has amplitude 1; each step is 0.25 dB.
    """
    amplitude = 10 ** ((np.arange(256) - REFERENCE_CODE) * 0.25 / 20)
    amplitude[0] = 0
    return amplitude.astype(np.float32)


@dataclass(frozen=True, eq=False)
class Vessel:
    """A tube of blood.

    Attributes:
        name: Such as ``"radial artery"``.
        kind: Artery or vein.
        centerline_mm: Points along its middle, in body coordinates, in the direction of flow.
        radius_mm: Of its lumen at each point.
        mean_speed_mm_per_s: Of the blood, over the cross-section and the heart beat.
    """

    name: str
    kind: Literal["artery", "vein"]
    centerline_mm: Float[np.ndarray, "points xyz=3"]
    radius_mm: Float[np.ndarray, " points"]
    mean_speed_mm_per_s: float

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ScanError: If they do not make a tube.
        """
        line, radius = self.centerline_mm, self.radius_mm
        if len(line) < 2 or len(line) != len(radius):
            raise ScanError(
                f"vessel '{self.name}' needs two points or more, with a radius each, got"
                f" {len(line)} points and {len(radius)} radii"
            )
        finite = np.isfinite(line).all() and np.isfinite(radius).all()
        if not (finite and (radius > 0).all() and np.isfinite(self.mean_speed_mm_per_s)):
            raise ScanError(
                f"vessel '{self.name}' needs finite points and speed, and radii above 0 mm"
            )


@dataclass(frozen=True, eq=False)
class Body:
    """Voxels of tissue in body coordinates.

    Body coordinates are the reference of simulated sweeps: x across the arm, y into it, z
    along it; right-handed, mm. A frame whose pose has no rotation lies across the arm, with
    its lateral axis along x and its axial axis along y.

    Attributes:
        name: What it is, such as ``"forearm"``.
        subject: Whose; the name that goes into scans.
        tissue: :class:`Tissue` of each voxel, ``(z, y, x)``.
        echogenicity: Code of the scatterers' amplitude, see :func:`echo_amplitude`.
        spacing_mm: Size of a voxel along every axis.
        origin_mm: Centre of voxel (0, 0, 0), as x, y, z.
        skin_depth_mm: y of the skin's outer surface on the voxels' (z, x) grid.
        vessels: Their center lines.
    """

    name: str
    subject: str
    tissue: Values
    echogenicity: Values
    spacing_mm: float
    origin_mm: tuple[float, float, float]
    skin_depth_mm: Float32[np.ndarray, "z x"]
    vessels: tuple[Vessel, ...] = field(default_factory=tuple)

    def __post_init__(self) -> None:
        """Check that it is not empty and that the arrays agree.

        Raises:
            ScanError: If not.
        """
        if self.tissue.size == 0 or not self.echogenicity.any():
            raise ScanError(f"phantom '{self.name}' is empty: nothing in it scatters")
        if self.tissue.shape != self.echogenicity.shape:
            raise ScanError(
                f"tissue of shape {self.tissue.shape} but echogenicity of shape"
                f" {self.echogenicity.shape} in phantom '{self.name}'"
            )
        if self.skin_depth_mm.shape != (self.tissue.shape[0], self.tissue.shape[2]):
            raise ScanError(f"the skin of phantom '{self.name}' does not fit its voxels")
        if not (np.isfinite(self.spacing_mm) and self.spacing_mm > 0):
            raise ScanError(f"voxel size must be above 0 mm, got {self.spacing_mm:g}")
