"""The real sweep that ships with the package."""

from importlib.resources import files
from pathlib import Path

from sonosweep.io.attach_poses import attach_poses
from sonosweep.io.open import open_scan
from sonosweep.scan import Scan

# From the original recording; a video file has no place for it.
SPACING_MM = (0.31481779, 0.31481779)


def read_demo_sweep() -> Scan:
    """Return a tracked freehand sweep over a human liver, curved probe, 140 frames.

    ImFusion GmbH, CC BY 4.0; ``data/ATTRIBUTION.md`` in the package says more.
    """
    folder = Path(str(files("sonosweep") / "data"))
    scan = open_scan(folder / "liver_sweep.mp4", spacing_mm=SPACING_MM)
    return attach_poses(scan, folder / "liver_sweep_poses.csv")
