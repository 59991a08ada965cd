"""Draw what a network looks at in slow and fast steps: the paper's figure of its attention.

python examples/attention_maps.py docs/images/attention.png [WEIGHTS]

A sweep is simulated over a forearm, so that it is known which steps are slow and which fast.
Each row is a step: the frame; the weight of each part of it in the global-local attention; the
mean correlation of the features of both frames for every shift, and that of the frames.
"""

import sys
from collections.abc import Mapping
from pathlib import Path

from torch import Tensor

from sonosweep.estimators import LearnedEstimator
from sonosweep.estimators.fit_scan import fit_scan
from sonosweep.estimators.network_input import image_steps
from sonosweep.estimators.step_maps import step_maps
from sonosweep.geometry import motion_from_step, steps_from_poses
from sonosweep.simulate import (
    FIRST_TEST_SUBJECT,
    Body,
    MotionSettings,
    SweepSettings,
    simulate_sweep,
)
from sonosweep.view import write_map_picture

QUANTILES = {"slow": 0.05, "fast": 0.95}  # of the elevational motion


def main(path: Path, weights: str = "moglo", frames: int = 300, body: Body | None = None) -> None:
    """Write the picture of a simulated sweep, over a forearm unless a body is given."""
    motion = MotionSettings("straight", length_mm=0.21 * frames, frames=frames, pauses=0)
    scan = simulate_sweep(SweepSettings(FIRST_TEST_SUBJECT, motion=motion), body)
    assert scan.image_to_reference is not None
    shown: dict[int, dict[str, Tensor]] = {}

    def keep(first: int, maps: Mapping[str, Tensor]) -> None:
        """Remember the maps of the steps in the picture."""
        count = len(next(iter(maps.values())))
        for step in set(steps.values()) & set(range(first, first + count)):
            shown[step] = {name: values[step - first] for name, values in maps.items()}

    estimator = LearnedEstimator(weights, on_maps=keep)
    fitted = fit_scan(scan, estimator.info)
    x, y = fitted.center_mm
    about_center = image_steps(steps_from_poses(scan.image_to_reference), (-x, -y))
    elevational = motion_from_step(about_center)[:, 2].abs()
    order = elevational.argsort().tolist()
    steps = {name: order[round(q * (len(order) - 1))] for name, q in QUANTILES.items()}
    estimator.estimate(scan)
    rows = [
        step_maps(
            fitted,
            estimator.network,
            shown[step],
            step,
            f"{name}: {float(elevational[step]):.2f} mm elevational",
        )
        for name, step in steps.items()
    ]
    write_map_picture(path, rows)


if __name__ == "__main__":
    main(Path(sys.argv[1]), weights=sys.argv[2] if len(sys.argv) > 2 else "moglo")
