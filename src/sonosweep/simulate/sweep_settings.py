"""Everything that defines a simulated sweep: the same settings give the same bytes."""

import dataclasses
import json
from dataclasses import dataclass, field

from sonosweep.errors import ScanError
from sonosweep.imaging import PAPER_GRID, PixelGrid, SectorGrid
from sonosweep.simulate.beam import Beam
from sonosweep.simulate.body_motion import BodyMotionSettings
from sonosweep.simulate.doppler_frames import DopplerSettings
from sonosweep.simulate.motion import MotionSettings
from sonosweep.simulate.photoacoustic_frames import PhotoacousticSettings
from sonosweep.simulate.scanner import Scanner
from sonosweep.simulate.seeds import subject_name
from sonosweep.simulate.tracker import TrackerSettings

MODALITIES = ("amplitude", "iq", "power_doppler", "photoacoustic")
OF_LINEAR_ARRAYS = ("iq", "power_doppler", "photoacoustic")


@dataclass(frozen=True)
class SweepSettings:
    """A sweep: who, how the probe moves, how it hears, what is recorded.

    Attributes:
        subject: Number of the subject; says which body it is and where its scatterers are.
        scan: Number of the scan of this subject; says what else is random.
        motion: How the hand moves the probe.
        body_motion: How the body moves under it.
        beam: Of the probe.
        scanner: Its settings.
        grid: Of all frames.
        sector: Lines of a convex probe, which are scan-converted to ``grid``; ``None`` for
            a linear array.
        modalities: What is recorded beside B-mode.
        doppler: How power Doppler is recorded.
        photoacoustic: How photoacoustic frames are.
        tracker: What sees the poses; ``None`` gives the truth.
        density_per_mm3: Of the scatterers.
    """

    subject: int
    scan: int = 0
    motion: MotionSettings = field(default_factory=MotionSettings)
    body_motion: BodyMotionSettings = field(default_factory=BodyMotionSettings)
    beam: Beam = field(default_factory=Beam)
    scanner: Scanner = field(default_factory=Scanner)
    grid: PixelGrid = PAPER_GRID
    sector: SectorGrid | None = None
    modalities: tuple[str, ...] = ()
    doppler: DopplerSettings = field(default_factory=DopplerSettings)
    photoacoustic: PhotoacousticSettings = field(default_factory=PhotoacousticSettings)
    tracker: TrackerSettings | None = None
    density_per_mm3: float = 266.0

    def __post_init__(self) -> None:
        """Check that the parts belong together.

        Raises:
            ScanError: If a number is out of range or a modality cannot be simulated.
        """
        subject_name(self.subject)
        if self.scan < 0:
            raise ScanError(f"the number of a scan must be 0 or more, got {self.scan}")
        for name in self.modalities:
            if name not in MODALITIES:
                known = ", ".join(MODALITIES)
                raise ScanError(f"unknown modality '{name}': beside B-mode there are {known}")
            if self.sector is not None and name in OF_LINEAR_ARRAYS:
                raise ScanError(
                    f"'{name}' frames are simulated for linear arrays only: leave it out or"
                    " choose a linear probe"
                )


def settings_text(settings: SweepSettings) -> str:
    """Return the settings as JSON, for a scan's notes."""
    return json.dumps({"simulated": True, **dataclasses.asdict(settings)})
