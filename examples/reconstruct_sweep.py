"""From a sweep to a trajectory and a volume that 3D Slicer opens, in a dozen lines.

python examples/reconstruct_sweep.py
"""

from pathlib import Path

import sonosweep
from sonosweep.io.demo_sweep import read_demo_sweep
from sonosweep.scan import locate_image, select_frames


def main(frames: int = 140, folder: Path = Path("sweep")) -> None:
    """Reconstruct the packaged sweep, or its first frames, without its tracker."""
    scan = select_frames(read_demo_sweep(), range(frames))  # or sonosweep.open_scan(path)
    scan = locate_image(scan)
    trajectory = sonosweep.estimate_trajectory(
        scan, sonosweep.DecorrelationEstimator(), direction=-1
    )
    volumes = sonosweep.reconstruct_scan(scan, trajectory)
    sonosweep.write_volume(volumes["b_mode"], folder / "volume.nrrd")
    sonosweep.write_trajectory(trajectory, folder / "trajectory.csv")
    print(sonosweep.compare_trajectories(trajectory, scan))


if __name__ == "__main__":
    main()
