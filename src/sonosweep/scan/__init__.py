"""What was recorded: frozen objects and their checks."""

from sonosweep.scan.calibration import Calibration, calibration_from_matrix, pixel_to_image
from sonosweep.scan.channel_data import ChannelData
from sonosweep.scan.channel_sweep import ChannelSweep, modalities
from sonosweep.scan.clock import MatchReport, match_poses
from sonosweep.scan.crop import crop_scan, crop_scan_center, resample_scan
from sonosweep.scan.find_region import find_region, locate_image
from sonosweep.scan.frames import Frames, FrameView, LazyFrames
from sonosweep.scan.latency import LagEstimate, estimate_lag, estimate_latency
from sonosweep.scan.probe import Probe
from sonosweep.scan.region import Region
from sonosweep.scan.scan import Companion, Scan
from sonosweep.scan.select import select_frames, select_tracked
from sonosweep.scan.split import split_by_subject
from sonosweep.scan.trajectory import Trajectory
from sonosweep.scan.volume import Volume, VolumeGrid, voxel_to_reference

__all__ = [
    "Calibration",
    "ChannelData",
    "ChannelSweep",
    "Companion",
    "FrameView",
    "Frames",
    "LagEstimate",
    "LazyFrames",
    "MatchReport",
    "Probe",
    "Region",
    "Scan",
    "Trajectory",
    "Volume",
    "VolumeGrid",
    "calibration_from_matrix",
    "crop_scan",
    "crop_scan_center",
    "estimate_lag",
    "estimate_latency",
    "find_region",
    "locate_image",
    "match_poses",
    "modalities",
    "pixel_to_image",
    "resample_scan",
    "select_frames",
    "select_tracked",
    "split_by_subject",
    "voxel_to_reference",
]
