"""From channel data to frames: beamforming, clutter filter, power Doppler, photoacoustics."""

from sonosweep.imaging.pixel_grid import PAPER_GRID, PixelGrid, centered_grid
from sonosweep.imaging.sector_grid import SectorGrid

__all__ = ["PAPER_GRID", "PixelGrid", "SectorGrid", "centered_grid"]
