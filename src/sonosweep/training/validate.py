"""How well a network reads whole scans, as it will when it is used."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sonosweep.estimators.network import MotionNetwork, Stepper
from sonosweep.estimators.network_input import image_steps, unit_frames
from sonosweep.geometry import MOTION_NAMES, poses_from_steps, step_from_motion
from sonosweep.metrics import evaluate_trajectory, frame_grid
from sonosweep.training.scans import TrainingScan

CHUNK = 16  # frames that are worked on at a time
REPORTED = {
    "rae": "relative_error_mixed",
    "rfe": "relative_frame_error_mm",
    "afe": "accumulated_frame_error_mm",
    "fdr": "final_drift_rate_path_percent",
}
"""Short names of the paper's numbers that are reported, with drift per length of the path."""


def predict_motion(
    network: MotionNetwork, scan: TrainingScan, device: torch.device
) -> Float[Tensor, "steps motion=6"]:
    """Return the motion of each step of a scan in scaled units, as frame by frame gives it.

    Args:
        network: In evaluation mode.
        scan: Of any length.
        device: Where the network is.
    """
    stepper = Stepper(network)
    motions = []
    for start in range(0, len(scan.frames), CHUNK):
        stored = torch.from_numpy(np.asarray(scan.frames[start : start + CHUNK]))
        output = stepper.push_many(unit_frames(stored.to(device)))
        if output is not None:
            motions.append(output.motion[0].detach().float().cpu())
    return torch.cat(motions)


def scan_metrics(motion: Float[Tensor, "steps motion=6"], scan: TrainingScan) -> dict[str, float]:
    """Return how far motions (mm, rad, about the frame's centre) are from the true ones.

    These are the correlation of each of the six numbers, ``"r_lateral"`` and so on, 0 where
    it is not defined, and the numbers of :data:`REPORTED`, of the image's poses, NaN there.
    """
    tracked = torch.from_numpy(scan.tracked)
    both = tracked[:-1] & tracked[1:]
    true = scan.motion()[both]
    metrics = {
        f"r_{name}": correlation(motion[both, k].double(), true[:, k])
        for k, name in enumerate(MOTION_NAMES)
    }
    steps = image_steps(step_from_motion(motion.double()), scan.center)
    estimated = poses_from_steps(steps, torch.eye(4, dtype=torch.float64))
    rows, columns = scan.frames.shape[-2:]
    found = evaluate_trajectory(
        estimated,
        scan.image_poses,
        frame_grid(rows, columns, scan.spacing_mm),
        tracked=None if bool(tracked.all()) else tracked,
    ).as_dict()
    for short, name in REPORTED.items():
        value = found[name]
        metrics[short] = float("nan") if value is None else float(value)
    return metrics


def correlation(a: Float[Tensor, " steps"], b: Float[Tensor, " steps"]) -> float:
    """Return Pearson's correlation; 0 if one of them never changes."""
    a, b = a - a.mean(), b - b.mean()
    size = float(a.norm() * b.norm())
    return float(a @ b) / size if size > 0 else 0.0
