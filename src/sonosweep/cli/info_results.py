"""What a trajectory, a volume or a file of weights holds, for ``sonosweep info``."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sonosweep.estimators.weights import WeightsInfo
    from sonosweep.scan import Trajectory, Volume

TRAJECTORIES = (".csv", ".txt", ".tum", ".tfm")
VOLUMES = (".nii", ".nii.gz")

Facts = dict[str, Any]  # Any: the values of a JSON object


def describe_result(path: Path) -> tuple[list[tuple[str, str]], Facts] | None:
    """Return lines and facts of a trajectory, a volume or weights; ``None`` of anything else."""
    from sonosweep.estimators.shipped import SUFFIX
    from sonosweep.estimators.weights import read_weights_info
    from sonosweep.io import read_trajectory, read_volume

    name = path.name.lower()
    if not path.is_file():
        return None
    if name.endswith(TRAJECTORIES) or _is_poses_only(path):
        return describe_trajectory(path.name, read_trajectory(path))
    if name.endswith(SUFFIX):
        return describe_weights(path.name, read_weights_info(path))
    if name.endswith(VOLUMES) or _is_volume(path):
        return describe_volume(path.name, read_volume(path))
    return None


def describe_trajectory(name: str, trajectory: "Trajectory") -> tuple[list[tuple[str, str]], Facts]:
    """Return lines and facts of a trajectory."""
    import torch

    from sonosweep.metrics.trajectory import chord_length, path_length

    poses, times = trajectory.image_to_reference, trajectory.timestamps_s
    origin = torch.zeros(3, dtype=torch.float64)
    facts: Facts = {
        "name": name,
        "poses": len(poses),
        "pose_of": trajectory.settings.get("pose_of", "Image"),
        "method": trajectory.method,
        "duration_s": None if times is None else float(times[-1] - times[0]),
        "path_length_mm": float(path_length(poses, origin)),
        "chord_length_mm": float(chord_length(poses, origin)),
        "assumptions": list(trajectory.assumptions),
    }
    lines = [
        ("name", name),
        ("poses", f"{len(poses)} of the {facts['pose_of'].lower()}, {trajectory.method}"),
        ("times", "none" if times is None else f"{facts['duration_s']:.2f} s"),
        (
            "path",
            f"{facts['path_length_mm']:.1f} mm long, {facts['chord_length_mm']:.1f} mm from end"
            " to end (of the origin)",
        ),
    ]
    return lines + [("assumption", text) for text in trajectory.assumptions], facts


def describe_volume(name: str, volume: "Volume") -> tuple[list[tuple[str, str]], Facts]:
    """Return lines and facts of a volume."""
    size, spacing = volume.grid.size, volume.grid.spacing_mm
    extent_mm = [n * step for n, step in zip(size, spacing, strict=True)]
    facts: Facts = {
        "name": name,
        "size": list(size),
        "spacing_mm": list(spacing),
        "origin_mm": list(volume.grid.origin_mm),
        "pixel_type": str(volume.voxels.dtype),
        "settings": dict(volume.settings),
    }
    lines = [
        ("name", name),
        ("voxels", f"{' x '.join(map(str, size))}, {volume.voxels.dtype}"),
        ("voxel size", f"{' x '.join(f'{step:.4g}' for step in spacing)} mm"),
        ("extent", f"{' x '.join(f'{length:.1f}' for length in extent_mm)} mm"),
        ("origin", f"{' '.join(f'{value:.3f}' for value in volume.grid.origin_mm)} mm"),
    ]
    return lines + list(volume.settings.items()), facts


def describe_weights(name: str, info: "WeightsInfo") -> tuple[list[tuple[str, str]], Facts]:
    """Return lines and facts of trained weights."""
    reads, (across, down) = info.input, info.spacing_mm
    facts: Facts = {"name": name, **info.model_dump(mode="json")}
    numbers = [(key, value) for key, value in info.metrics.items() if value is not None]
    options = ", ".join(f"{key} = {value}" for key, value in info.options.items())
    lines = [
        ("name", name),
        ("network", f"{info.network}, {info.parameters / 1e6:.2f} M parameters"),
        ("options", f"{info.preset}{', ' if options else ''}{options}"),
        ("reads", f"{reads.channels}, {reads.columns} x {reads.rows} pixels"),
        ("pixel size", f"{across:.4g} x {down:.4g} mm"),
        ("field of view", f"{across * reads.columns:.1f} x {down * reads.rows:.1f} mm"),
        ("made", f"{info.made}, version {info.version}"),
        ("data", info.data),
        ("validation", ", ".join(f"{key} {value:.4g}" for key, value in numbers) or "none"),
    ]
    return lines, facts


def _is_poses_only(path: Path) -> bool:
    from sonosweep.errors import SonosweepError
    from sonosweep.io.open import SEQUENCES
    from sonosweep.io.sequence import read_sequence

    if path.suffix.lower() not in SEQUENCES:
        return False
    try:
        sequence = read_sequence(path)
    except SonosweepError:
        return False
    return sequence.frames is None and bool(sequence.transforms)


def _is_volume(path: Path) -> bool:
    """Say whether a NRRD has three axes of space, or a MetaImage says that we made it one."""
    from sonosweep.errors import SonosweepError
    from sonosweep.io.metaimage_header import OWN_PREFIX, read_metaimage_header
    from sonosweep.io.sequence_nrrd import read_nrrd_header

    suffix = path.suffix.lower()
    try:
        if suffix in (".nrrd", ".nhdr"):
            kinds = [kind.lower() for kind in read_nrrd_header(path).kinds]
            return kinds.count("domain") + kinds.count("space") == 3 and "list" not in kinds
        if suffix == ".mha":
            return f"{OWN_PREFIX}world" in read_metaimage_header(path).values
    except SonosweepError:
        return False
    return False
