"""sonosweep: freehand ultrasound sweeps, without a tracker, into trajectories and volumes.

The names below are looked up when first used, so that ``import sonosweep`` is quick.
"""

from importlib import import_module
from typing import Any

__version__ = "0.1.0"

_HOMES = {
    "Calibration": "sonosweep.scan",
    "Scan": "sonosweep.scan",
    "Trajectory": "sonosweep.scan",
    "Volume": "sonosweep.scan",
    "open_scan": "sonosweep.io",
    "write_trajectory": "sonosweep.io",
    "write_volume": "sonosweep.io",
    "DecorrelationEstimator": "sonosweep.estimators",
    "estimate_trajectory": "sonosweep.reconstruct",
    "reconstruct_scan": "sonosweep.reconstruct",
    "compare_trajectories": "sonosweep.evaluate",
}
__all__ = ["__version__", *_HOMES]


def __getattr__(name: str) -> Any:  # Any: a module's attributes are of every type
    if name not in _HOMES:
        raise AttributeError(f"module 'sonosweep' has no attribute '{name}'")
    return getattr(import_module(_HOMES[name]), name)
