"""Motion in, volume out."""

from sonosweep.reconstruct.clip import Fan
from sonosweep.reconstruct.compound import compound_frames
from sonosweep.reconstruct.estimate import estimate_trajectory, tracked_trajectory
from sonosweep.reconstruct.fill import fill_holes
from sonosweep.reconstruct.grid import check_memory, estimate_bytes, grid_of_sweep
from sonosweep.reconstruct.volumes import (
    B_MODE,
    VolumeSettings,
    gathers,
    reconstruct_scan,
    sweep_grid,
)

__all__ = [
    "B_MODE",
    "Fan",
    "VolumeSettings",
    "check_memory",
    "compound_frames",
    "estimate_bytes",
    "estimate_trajectory",
    "fill_holes",
    "gathers",
    "grid_of_sweep",
    "reconstruct_scan",
    "sweep_grid",
    "tracked_trajectory",
]
