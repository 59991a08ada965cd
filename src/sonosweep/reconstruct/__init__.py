"""Motion in, volume out."""

from sonosweep.reconstruct.chunks import compound_to_chunks, read_chunks
from sonosweep.reconstruct.clip import Fan
from sonosweep.reconstruct.companions import (
    PhotoacousticCorrection,
    correct_photoacoustic,
    image_companions,
    left_out,
)
from sonosweep.reconstruct.compiling import must_compile
from sonosweep.reconstruct.compound import compound_frames
from sonosweep.reconstruct.estimate import estimate_trajectory, tracked_trajectory
from sonosweep.reconstruct.fill import fill_holes
from sonosweep.reconstruct.gather import GatherCompounder
from sonosweep.reconstruct.grid import check_memory, estimate_bytes, grid_of_sweep
from sonosweep.reconstruct.volumes import (
    B_MODE,
    VolumeSettings,
    engine,
    reconstruct_scan,
    sweep_grid,
)

__all__ = [
    "B_MODE",
    "Fan",
    "GatherCompounder",
    "PhotoacousticCorrection",
    "VolumeSettings",
    "check_memory",
    "compound_frames",
    "compound_to_chunks",
    "correct_photoacoustic",
    "engine",
    "estimate_bytes",
    "estimate_trajectory",
    "fill_holes",
    "grid_of_sweep",
    "image_companions",
    "left_out",
    "must_compile",
    "read_chunks",
    "reconstruct_scan",
    "sweep_grid",
    "tracked_trajectory",
]
