"""Draw the pictures of the pages on simulation and imaging: a forearm's frames and vessels.

python examples/simulated_vessels.py docs/images
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image

from sonosweep.imaging import log_compress
from sonosweep.reconstruct import (
    B_MODE,
    PhotoacousticCorrection,
    correct_photoacoustic,
    reconstruct_scan,
    tracked_trajectory,
)
from sonosweep.simulate import Body, MotionSettings, draw_sweep, simulate_sweep
from sonosweep.view import write_vessel_picture

SUBJECT = 4
FADING_PER_MM, SKIN_MM = 0.11, 2.0
RANGE_DB = 20.0  # of photoacoustic amplitudes, for the eye


def main(folder: Path, body: Body | None = None, length_mm: float = 20.0, frames: int = 96) -> None:
    """Write a frame in all modalities and the volumes' vessels, made with the true poses."""
    motion = MotionSettings("S", length_mm, frames, excursion_mm=0.15 * length_mm, pauses=0)
    modalities = ("power_doppler", "photoacoustic")
    scan = simulate_sweep(draw_sweep(SUBJECT, 0, motion, modalities=modalities), body)
    scan = correct_photoacoustic(scan, PhotoacousticCorrection(SKIN_MM, FADING_PER_MM))
    middle = frames // 2
    photoacoustic = scan.companions["photoacoustic"].frames[middle]
    shown = (
        scan.frames[middle],
        scan.companions["power_doppler"].frames[middle],
        log_compress(photoacoustic, float(photoacoustic.max()), RANGE_DB),
    )
    Image.fromarray(np.hstack(shown)).save(folder / "modalities.png", optimize=True)
    trajectory = tracked_trajectory(scan)
    volumes = reconstruct_scan(scan, trajectory)
    for name in modalities:
        path = folder / f"vessels_{name}.png"
        write_vessel_picture(path, volumes[name], volumes[B_MODE], trajectory, name)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
