"""Draw the picture of the README: the packaged sweep goes in, a volume comes out.

python examples/overview_picture.py docs/images/overview.png
"""

import sys
from pathlib import Path

import sonosweep
from sonosweep.io.demo_sweep import read_demo_sweep
from sonosweep.reconstruct import B_MODE, VolumeSettings, tracked_trajectory
from sonosweep.scan import locate_image
from sonosweep.view import write_overview_picture


def main(path: Path, voxel_mm: float = 0.6) -> None:
    """Write the picture, made with the tracked poses."""
    scan = read_demo_sweep()
    scan = locate_image(scan)
    trajectory = tracked_trajectory(scan)
    volume = sonosweep.reconstruct_scan(scan, trajectory, VolumeSettings(voxel_mm))[B_MODE]
    assert scan.calibration is not None
    write_overview_picture(path, scan.frames, scan.calibration.spacing_mm, trajectory, volume)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
