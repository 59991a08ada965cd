"""Make a PLUS sequence, which 3D Slicer opens, from one's own images and poses.

python examples/images_and_poses.py
"""

from pathlib import Path

import numpy as np
import torch

from sonosweep.geometry import poses_from_steps, step_from_motion
from sonosweep.io import open_scan, write_scan_as
from sonosweep.scan import Calibration, Scan


def main(frames: int = 60, folder: Path = Path("sweep")) -> None:
    """Write a made-up sweep as ``.igs.mha`` and read it back."""
    pixels = np.random.default_rng(0).integers(0, 256, (frames, 120, 100), dtype=np.uint8)
    motion = torch.zeros(frames - 1, 6, dtype=torch.float64)
    motion[:, 2] = 0.3  # mm forward per frame
    scan = Scan(
        name="my sweep",
        frames=pixels,  # (frames, rows, columns)
        calibration=Calibration(spacing_mm=(0.2, 0.2)),
        timestamps_s=torch.arange(frames, dtype=torch.float64) / 20,
        image_to_reference=poses_from_steps(
            step_from_motion(motion), first=torch.eye(4, dtype=torch.float64)
        ),
    )
    write_scan_as(scan, folder / "sweep.igs.mha")
    again = open_scan(folder / "sweep.igs.mha")
    print(f"{again.name}: {len(again.frames)} frames with poses")


if __name__ == "__main__":
    main()
