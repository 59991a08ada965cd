"""From channel data to frames: beamforming, clutter filter, power Doppler, photoacoustics."""

from sonosweep.imaging.beamform import BeamformSettings, beamform, prepare_beamformer
from sonosweep.imaging.demodulate import analytic_signal, demodulate
from sonosweep.imaging.pixel_grid import PAPER_GRID, PixelGrid, centered_grid
from sonosweep.imaging.prepared import Beamformer
from sonosweep.imaging.sector_grid import SectorGrid

__all__ = [
    "PAPER_GRID",
    "BeamformSettings",
    "Beamformer",
    "PixelGrid",
    "SectorGrid",
    "analytic_signal",
    "beamform",
    "centered_grid",
    "demodulate",
    "prepare_beamformer",
]
