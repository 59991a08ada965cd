"""Frames in, motion out."""

from sonosweep.estimators.calibrate import calibrate
from sonosweep.estimators.curve_file import read_curve, write_curve
from sonosweep.estimators.decorrelation import DecorrelationEstimator
from sonosweep.estimators.decorrelation_curve import DecorrelationCurve, curve_from_probe
from sonosweep.estimators.estimator import MotionEstimate, MotionEstimator

__all__ = [
    "DecorrelationCurve",
    "DecorrelationEstimator",
    "MotionEstimate",
    "MotionEstimator",
    "calibrate",
    "curve_from_probe",
    "read_curve",
    "write_curve",
]
