"""Sweeps with exact truth: bodies, probes, motions, and what a scanner makes of them."""

from sonosweep.simulate.beam import Beam
from sonosweep.simulate.body import REFERENCE_CODE, Body, Tissue, Vessel
from sonosweep.simulate.body_motion import BodyMotionSettings
from sonosweep.simulate.channel_sweep import ChannelSweepSettings, simulate_channel_sweep
from sonosweep.simulate.channels import (
    Acquisition,
    plane_wave_delays,
    simulate_ensemble,
    simulate_photoacoustic,
    simulate_plane_waves,
)
from sonosweep.simulate.datasets import DatasetRecipe, PlannedScan, dataset_recipe
from sonosweep.simulate.deformation import STILL, Deformation, PulsingArtery
from sonosweep.simulate.doppler_frames import DopplerSettings
from sonosweep.simulate.forearm import forearm
from sonosweep.simulate.make import dataset_files, make_dataset
from sonosweep.simulate.motion import MotionSettings, sweep_poses
from sonosweep.simulate.phantoms import cyst_phantom, uniform_phantom, vessel_phantom, wire_phantom
from sonosweep.simulate.photoacoustic_frames import PhotoacousticSettings
from sonosweep.simulate.probes import linear_probe, linear_probe_l11_5v
from sonosweep.simulate.random_sweep import draw_sweep
from sonosweep.simulate.scanner import Scanner
from sonosweep.simulate.seeds import FIRST_TEST_SUBJECT, refuse_test_subjects
from sonosweep.simulate.speckle import SpeckleRenderer, render_points
from sonosweep.simulate.sweep import simulate_sweep
from sonosweep.simulate.sweep_settings import SweepSettings
from sonosweep.simulate.tracker import TrackerSettings

__all__ = [
    "FIRST_TEST_SUBJECT",
    "REFERENCE_CODE",
    "STILL",
    "Acquisition",
    "Beam",
    "Body",
    "BodyMotionSettings",
    "ChannelSweepSettings",
    "DatasetRecipe",
    "Deformation",
    "DopplerSettings",
    "MotionSettings",
    "PhotoacousticSettings",
    "PlannedScan",
    "PulsingArtery",
    "Scanner",
    "SpeckleRenderer",
    "SweepSettings",
    "Tissue",
    "TrackerSettings",
    "Vessel",
    "cyst_phantom",
    "dataset_files",
    "dataset_recipe",
    "draw_sweep",
    "forearm",
    "linear_probe",
    "linear_probe_l11_5v",
    "make_dataset",
    "plane_wave_delays",
    "refuse_test_subjects",
    "render_points",
    "simulate_channel_sweep",
    "simulate_ensemble",
    "simulate_photoacoustic",
    "simulate_plane_waves",
    "simulate_sweep",
    "sweep_poses",
    "uniform_phantom",
    "vessel_phantom",
    "wire_phantom",
]
