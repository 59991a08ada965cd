"""What makes tissue move under the probe: pressure, the pulse, breathing."""

from dataclasses import dataclass

from sonosweep.errors import ScanError


@dataclass(frozen=True)
class PulsingArtery:
    """An artery where it crosses the image, swollen by the pulse.

    Attributes:
        center_mm: Of its lumen in plane coordinates (lateral from the array's middle, depth
            below its face).
        radius_mm: Of its lumen at rest.
        dilation_mm: By how much its wall is pushed outward now. Tissue at distance r moves
            away by dilation * radius / r (incompressible), inside the lumen by
            dilation * r / radius.
    """

    center_mm: tuple[float, float]
    radius_mm: float
    dilation_mm: float


@dataclass(frozen=True)
class Deformation:
    """How tissue is displaced in one frame.

    A point of the body is first shifted, then seen from the probe, then compressed and
    pushed aside by arteries. The order is fixed so that all modalities agree.

    Attributes:
        shift_mm: Movement of the whole body against the tracker (breathing), body
            coordinates.
        axial_strain: Compression by the probe: a point at depth y below the face comes to
            y * (1 - strain), and one at lateral distance x from the array's middle
            to x * (1 + strain / 2).
        arteries: Those that pulsate in this frame.
    """

    shift_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    axial_strain: float = 0.0
    arteries: tuple[PulsingArtery, ...] = ()

    def __post_init__(self) -> None:
        """Check the strain.

        Raises:
            ScanError: If tissue would be turned inside out.
        """
        if not -0.5 < self.axial_strain < 0.5:
            raise ScanError(f"axial strain must be within 0.5, got {self.axial_strain:g}")


STILL = Deformation()
