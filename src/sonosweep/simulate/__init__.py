"""Sweeps with exact truth: bodies, probes, motions, and what a scanner makes of them."""

from sonosweep.simulate.beam import Beam
from sonosweep.simulate.body import Body, Tissue, Vessel
from sonosweep.simulate.deformation import STILL, Deformation, PulsingArtery
from sonosweep.simulate.seeds import FIRST_TEST_SUBJECT, refuse_test_subjects

__all__ = [
    "FIRST_TEST_SUBJECT",
    "STILL",
    "Beam",
    "Body",
    "Deformation",
    "PulsingArtery",
    "Tissue",
    "Vessel",
    "refuse_test_subjects",
]
