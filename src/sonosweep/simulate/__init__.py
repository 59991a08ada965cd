"""Sweeps with exact truth: bodies, probes, motions, and what a scanner makes of them."""

from sonosweep.simulate.beam import Beam
from sonosweep.simulate.body import REFERENCE_CODE, Body, Tissue, Vessel
from sonosweep.simulate.channel_sweep import ChannelSweepSettings, simulate_channel_sweep
from sonosweep.simulate.channels import (
    Acquisition,
    plane_wave_delays,
    simulate_ensemble,
    simulate_photoacoustic,
    simulate_plane_waves,
)
from sonosweep.simulate.deformation import STILL, Deformation, PulsingArtery
from sonosweep.simulate.probes import linear_probe, linear_probe_l11_5v
from sonosweep.simulate.seeds import FIRST_TEST_SUBJECT, refuse_test_subjects

__all__ = [
    "FIRST_TEST_SUBJECT",
    "REFERENCE_CODE",
    "STILL",
    "Acquisition",
    "Beam",
    "Body",
    "ChannelSweepSettings",
    "Deformation",
    "PulsingArtery",
    "Tissue",
    "Vessel",
    "linear_probe",
    "linear_probe_l11_5v",
    "plane_wave_delays",
    "refuse_test_subjects",
    "simulate_channel_sweep",
    "simulate_ensemble",
    "simulate_photoacoustic",
    "simulate_plane_waves",
]
