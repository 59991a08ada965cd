"""How far sensorless estimates are from the tracker on two real sweeps, as Markdown tables.

    python benchmarks/real_sweeps.py FOLDER_OF_RECORDINGS [WEIGHTS ...]

The first table is of methods without a network, the second of networks: those that come with
the package, or those given. They were trained on simulated sweeps; nothing is tuned here.

No number is fitted to these sweeps. Two rows use what a user would not have: the mean motion is
the tracker's own, and the last row takes its curve from the tracked poses of the same sweep.
"""

import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import torch

import sonosweep
from sonosweep.cli.info import path_length_mm
from sonosweep.errors import ScanError
from sonosweep.estimators import DecorrelationEstimator, calibrate
from sonosweep.estimators.shipped import shipped_weights
from sonosweep.evaluate import compare_trajectories, markdown_table
from sonosweep.evaluate.trained import trained_networks
from sonosweep.geometry import (
    motion_from_step,
    poses_from_steps,
    step_from_motion,
    steps_from_poses,
)
from sonosweep.metrics import TrajectoryMetrics
from sonosweep.scan import Scan, Trajectory, locate_image

HEAD = """# Real recordings

`python benchmarks/real_sweeps.py FOLDER_OF_RECORDINGS`

Two tracked in-vivo sweeps, one of a bone and one of a liver, against their trackers; one sweep
each, so there are no intervals. Oracles use the tracker's own poses and are no methods.
"""
NETWORKS = """
The networks learned from simulated sweeps alone; nothing was tuned on these recordings. They
were told the way the probe swept, as decorrelation was.
"""

# The way each probe swept, as its operator would say it.
SWEEPS = {
    "bone": ("plus_bone_l14/BoneUltrasound_L14.igs.mha", "BoneUltrasound_L14_config.xml", 1),
    "liver": ("imfusion_liver_sweep/liver_sweep.h5", None, -1),
}


def main(recordings: Path, weights: list[str]) -> None:
    """Print a row for each sweep and method."""
    plain, learned, refused = [], [], []
    for name, (path, config, direction) in SWEEPS.items():
        file = recordings / path
        scan = sonosweep.open_scan(file, plus_config=config and file.with_name(config))
        scan = locate_image(scan)
        for method, trajectory in methods(scan, direction):
            plain.append(row_of(name, method, compare_trajectories(trajectory, scan).metrics))
        for network in trained_networks(weights, direction):
            method = f"{network.method.name}, {network.method.run}"
            blind = replace(scan, image_to_reference=None, tracked=None)
            try:
                trajectory = network.method.trajectory(blind)
            except ScanError as error:
                refused.append(f"- {name}, {method}: {error}")
                continue
            learned.append(row_of(name, method, compare_trajectories(trajectory, scan).metrics))
    print(HEAD)
    print(markdown_table(plain))
    if learned:
        print(NETWORKS)
        print(markdown_table(learned))
    if refused:
        print("\n".join(("Not estimated:", "", *refused)))


def row_of(sweep: str, method: str, found: TrajectoryMetrics) -> dict[str, str | float | None]:
    """Return what is printed of one method on one sweep."""
    return {
        "sweep": f"{sweep}, {found.frames} frames, {found.path_length_mm:.0f} mm",
        "method": method,
        "rAE (mm)": found.relative_error_mm,
        "rAE (deg)": found.relative_error_deg,
        "aFE (mm)": found.accumulated_frame_error_mm,
        "FD (mm)": found.final_drift_mm,
        "FDR (% of path)": found.final_drift_rate_path_percent,
    }


def methods(scan: Scan, direction: int) -> Iterator[tuple[str, Trajectory]]:
    """Give the name and the trajectory of each method on one scan."""
    poses = scan.image_to_reference
    assert poses is not None
    still = torch.eye(4, dtype=torch.float64).repeat(len(poses), 1, 1)
    yield "no motion", Trajectory(still)
    motion = motion_from_step(steps_from_poses(poses))
    mean = step_from_motion(motion.mean(0).expand_as(motion))
    yield "true mean motion (oracle)", Trajectory(poses_from_steps(mean, still[0]))
    length = path_length_mm(scan, poses)
    for name, curve in (
        ("decorrelation, scale guessed", None),
        ("decorrelation, length known", calibrate(scan, length_mm=length)),
        ("decorrelation, curve of this sweep (oracle)", calibrate(scan)),
    ):
        estimator = DecorrelationEstimator(curve)
        yield name, sonosweep.estimate_trajectory(scan, estimator, direction)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:] or sorted(shipped_weights()))
