"""Files of untrained weights of small networks."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from sonosweep.estimators.network import MotionNetwork
from sonosweep.estimators.network_input import InputSettings
from sonosweep.estimators.network_names import build_network
from sonosweep.estimators.weights import WeightsInfo, save_weights

SPACING_MM = 0.3
SIDE = 64
SCALE = (0.1, 0.05, 0.2, 0.01, 0.01, 0.01)
SMALL: Mapping[str, Mapping[str, Any]] = {
    "cnn": {"width": 8, "hidden": 8},
    "dcl": {"size": {"width": 4, "cardinality": 2}},
    "lstm": {"width": 4, "hidden": 8},
    "moglo": {"width": 8, "hidden": 8, "projection": 8, "stem_stride": 4},
}


def tiny_info(name: str = "cnn", **changes: Any) -> WeightsInfo:
    """Return what is known about weights that were never trained."""
    facts = {
        "network": name,
        "preset": "compact",
        "options": SMALL.get(name, {}),
        "input": InputSettings(rows=SIDE, columns=SIDE),
        "spacing_mm": (SPACING_MM, SPACING_MM),
        "center_mm": ((SIDE - 1) / 2 * SPACING_MM,) * 2,
        "window": 6,
        "motion_scale": SCALE,
        "mean_motion": (0.0,) * 6,
        "parameters": 0,
        "recipe": "seed = 0",
        "data": "none",
        "metrics": {"r_elevational": 0.5},
        "made": "2026-01-02",
        "version": "0",
    }
    return WeightsInfo.model_validate(facts | changes)


def tiny_network(info: WeightsInfo, seed: int = 0) -> MotionNetwork:
    """Return a network whose weights are random but large enough to tell frames apart."""
    torch.manual_seed(seed)
    network = build_network(info.network, info.options, info.frame_shape, info.preset)
    with torch.no_grad():
        for parameter in network.parameters():
            if parameter.ndim > 1:
                torch.nn.init.kaiming_normal_(parameter)
    return network.eval()


def tiny_weights(folder: Path, name: str = "cnn", **changes: Any) -> Path:
    """Write the weights of a small untrained network."""
    info = tiny_info(name, **changes)
    path = folder / f"{name}.safetensors"
    save_weights(path, tiny_network(info), info)
    return path
