"""Re-encode the recording behind ``sonosweep demo`` small enough to ship.

    python examples/pack_demo_sweep.py liver_sweep.h5 src/sonosweep/data

The recording is public (see ``src/sonosweep/data/ATTRIBUTION.md``). Frames become H.264 video,
which loses less than one gray level on average; poses and times stay exact.
"""

import sys
from pathlib import Path

import sonosweep
from sonosweep.io.trajectory_text import write_trajectory_csv
from sonosweep.io.video_write import write_video
from sonosweep.reconstruct import tracked_trajectory
from sonosweep.scan import crop_scan

QUALITY = 16  # H.264's constant rate factor: 1.5 MB


def main(source: Path, folder: Path) -> None:
    """Write the video and the poses into a folder."""
    scan = sonosweep.open_scan(source)
    rows, columns = scan.frames.shape[1:3]
    even = crop_scan(scan, (0, 0, columns // 2 * 2, rows // 2 * 2))  # video needs even sizes
    write_video(even.frames, even.timestamps_s, folder / "liver_sweep.mp4", crf=QUALITY)
    write_trajectory_csv(tracked_trajectory(even), folder / "liver_sweep_poses.csv")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
