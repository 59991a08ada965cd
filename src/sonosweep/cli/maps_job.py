"""The work of ``--maps``: what a network looks at, as numbers and as a picture."""

from pathlib import Path

from sonosweep.cli.motion import MotionOptions, find_trajectory, is_learned, make_estimator
from sonosweep.errors import ScanError
from sonosweep.estimators import LearnedEstimator
from sonosweep.estimators.fit_scan import fit_scan
from sonosweep.estimators.network_input import image_steps
from sonosweep.estimators.step_maps import step_maps
from sonosweep.geometry import motion_from_step, steps_from_poses
from sonosweep.io.map_file import MapFile, read_maps
from sonosweep.scan import Scan, Trajectory
from sonosweep.view.map_picture import write_map_picture

MAPS, PICTURE = "maps.h5", "maps.png"
SHOWN = {"slow": 0.05, "usual": 0.5, "fast": 0.95}  # quantiles of elevational motion


def find_with_maps(
    scan: Scan, options: MotionOptions, folder: Path
) -> tuple[Scan, Trajectory, tuple[str, ...]]:
    """Return what :func:`find_trajectory` does, and the names of files with maps.

    Raises:
        ScanError: If no network reads the motion, or it has no maps.
    """
    if not is_learned(options):
        raise ScanError("--maps shows what a network looks at: name one with --estimator")
    with MapFile(folder / MAPS) as file:
        estimator = make_estimator(options, file.append)
        located, trajectory = find_trajectory(scan, options, estimator)
    assert isinstance(estimator, LearnedEstimator)
    fitted = fit_scan(located, estimator.info)
    x, y = fitted.center_mm
    steps = image_steps(steps_from_poses(trajectory.image_to_reference), (-x, -y))
    elevational = motion_from_step(steps)[:, 2].abs()
    order = elevational.argsort()
    rows = []
    for name, quantile in SHOWN.items():
        step = int(order[round(quantile * (len(order) - 1))])
        words = f"{name}: {float(elevational[step]):.2f} mm to frame {step + 1}"
        maps = read_maps(folder / MAPS, step)
        rows.append(step_maps(fitted, estimator.network, maps, step, words))
    write_map_picture(folder / PICTURE, rows)
    return located, trajectory, (MAPS, PICTURE)
