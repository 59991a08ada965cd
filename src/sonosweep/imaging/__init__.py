"""From channel data to frames: beamforming, clutter filter, power Doppler, photoacoustics."""

from sonosweep.imaging.beamform import BeamformSettings, beamform, prepare_beamformer
from sonosweep.imaging.bmode import envelope, log_compress
from sonosweep.imaging.clutter import svd_filter
from sonosweep.imaging.demodulate import analytic_signal, demodulate
from sonosweep.imaging.despeckle import lee_filter, lee_filter_gray
from sonosweep.imaging.doppler import axial_velocity, power_doppler
from sonosweep.imaging.field_of_view import field_of_view
from sonosweep.imaging.photoacoustic import band_pass
from sonosweep.imaging.pixel_grid import PAPER_GRID, PixelGrid, centered_grid
from sonosweep.imaging.prepared import Beamformer
from sonosweep.imaging.scan_convert import (
    ScanConverter,
    prepare_inverse_scan_converter,
    prepare_scan_converter,
    sector_image_grid,
)
from sonosweep.imaging.sector_grid import SectorGrid
from sonosweep.imaging.sweep import SweepImaging, beamform_sweep

__all__ = [
    "PAPER_GRID",
    "BeamformSettings",
    "Beamformer",
    "PixelGrid",
    "ScanConverter",
    "SectorGrid",
    "SweepImaging",
    "analytic_signal",
    "axial_velocity",
    "band_pass",
    "beamform",
    "beamform_sweep",
    "centered_grid",
    "demodulate",
    "envelope",
    "field_of_view",
    "lee_filter",
    "lee_filter_gray",
    "log_compress",
    "power_doppler",
    "prepare_beamformer",
    "prepare_inverse_scan_converter",
    "prepare_scan_converter",
    "sector_image_grid",
    "svd_filter",
]
