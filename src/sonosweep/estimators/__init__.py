"""Frames in, motion out."""

from sonosweep.estimators.calibrate import calibrate
from sonosweep.estimators.curve_file import read_curve, write_curve
from sonosweep.estimators.decorrelation import DecorrelationEstimator
from sonosweep.estimators.decorrelation_curve import DecorrelationCurve, curve_from_probe
from sonosweep.estimators.estimator import MotionEstimate, MotionEstimator
from sonosweep.estimators.learned import LearnedEstimator
from sonosweep.estimators.shipped import shipped_weights

__all__ = [
    "DecorrelationCurve",
    "DecorrelationEstimator",
    "LearnedEstimator",
    "MotionEstimate",
    "MotionEstimator",
    "calibrate",
    "curve_from_probe",
    "read_curve",
    "shipped_weights",
    "write_curve",
]
