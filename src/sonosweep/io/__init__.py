"""Files: one module per format; ``open_scan`` chooses."""

from sonosweep.io.open import open_scan
from sonosweep.io.slicer_script import write_slicer_script
from sonosweep.io.trajectories import read_trajectory, write_trajectory
from sonosweep.io.volumes import read_volume, write_volume
from sonosweep.io.write_scan import write_scan_as

__all__ = [
    "open_scan",
    "read_trajectory",
    "read_volume",
    "write_scan_as",
    "write_slicer_script",
    "write_trajectory",
    "write_volume",
]
