"""``sonosweep info``: what a file holds, and what is missing."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from sonosweep.cli.inputs import InputOptions, Json, read

if TYPE_CHECKING:
    from torch import Tensor

    from sonosweep.scan import Scan

LONGEST_NOTE = 200


def info(
    scan: Path,
    /,
    *,
    estimate_lag: Path | None = None,
    inputs: InputOptions | None = None,
    json: Json = False,
) -> None:
    """Say what a file holds: frames, pixel size, times, poses, transforms, and what is missing.

    Of a trajectory or a volume: its poses or voxels, their size and how they were made. Of
    weights (.safetensors): the network, what it reads, and how it was trained.

    Args:
        scan: File or folder of the sweep, or a file of results.
        estimate_lag: Tracker recording (.igs.mha, csv or TUM) of the same motion: say how
            far the frame times are behind it.
    """
    from sonosweep.cli.info_results import describe_result
    from sonosweep.cli.output import say

    result = describe_result(scan)
    if result is not None and estimate_lag is None:
        say(_aligned(result[0]), result[1], json)
        return
    recorded = read(scan, inputs)
    facts = describe(recorded)
    facts["transforms"] = _transforms(scan, inputs)
    if estimate_lag is not None:
        facts["lag"] = _lag(recorded, estimate_lag)
    say(_table(facts), facts, json)


def describe(scan: "Scan") -> dict[str, Any]:  # Any: the values of a JSON object
    """Return the facts of a scan by name; ``None`` for what is missing."""
    from sonosweep.scan import select_tracked

    frames, rows, columns = scan.frames.shape[:3]
    facts: dict[str, Any] = {
        "name": scan.name,
        "frames": frames,
        "size_px": [columns, rows],
        "channels": scan.frames.shape[3] if len(scan.frames.shape) == 4 else 1,
        "pixel_type": str(scan.frames.dtype),
        "spacing_mm": None,
        "field_of_view_mm": None,
        "subject": scan.subject,
        "companions": {name: list(c.frames.shape) for name, c in scan.companions.items()},
        "notes": dict(scan.notes),
    }
    if scan.calibration is not None:
        x, y = scan.calibration.spacing_mm
        facts["spacing_mm"], facts["field_of_view_mm"] = [x, y], [x * columns, y * rows]
    if scan.region is not None:
        facts["region_px"] = list(scan.region.rectangle_px)
    times = scan.timestamps_s
    facts["duration_s"] = None if times is None else float(times[-1] - times[0])
    if times is not None and len(times) > 1:
        facts["frame_rate_hz"] = (frames - 1) / facts["duration_s"]
    if scan.image_to_reference is not None:
        facts["poses"] = frames if scan.tracked is None else int(scan.tracked.sum())
        if facts["poses"]:
            poses = select_tracked(scan).image_to_reference
            assert poses is not None
            facts["path_length_mm"] = path_length_mm(scan, poses)
    return facts


def path_length_mm(scan: "Scan", image_to_reference: "Tensor") -> float:
    """Return how far the centre of the image went along the poses."""
    import torch

    from sonosweep.metrics.trajectory import path_length

    center = torch.tensor([*image_center_mm(scan), 0.0], dtype=torch.float64)
    return float(path_length(image_to_reference, center))


def image_center_mm(scan: "Scan") -> tuple[float, float]:
    """Return the centre of the frame (lateral, axial); the origin if a pixel's size is unknown."""
    import torch

    from sonosweep.scan import pixel_to_image

    if scan.calibration is None:
        return 0.0, 0.0
    rows, columns = scan.frames.shape[1:3]
    middle = torch.tensor([(columns - 1) / 2, (rows - 1) / 2, 0, 1], dtype=torch.float64)
    x, y, *_ = (pixel_to_image(scan.calibration) @ middle).tolist()
    return x, y


def _transforms(path: Path, inputs: InputOptions | None) -> list[str]:
    """Return the links of a sequence's transform graph, as a person reads them."""
    from sonosweep.io.open import SEQUENCES
    from sonosweep.io.plus_config import read_plus_config
    from sonosweep.io.sequence import read_sequence
    from sonosweep.io.transform_graph import transform_graph

    if path.suffix.lower() not in SEQUENCES:
        return []
    config = None
    if inputs is not None and inputs.plus_config is not None:
        config = read_plus_config(inputs.plus_config)
    links = transform_graph(read_sequence(path), config)
    return [f"{link.name}: {link.origin}, {link.valid} valid" for link in links]


def _lag(scan: "Scan", tracker_file: Path) -> dict[str, float]:
    from sonosweep.errors import ScanError
    from sonosweep.io import read_trajectory
    from sonosweep.scan import estimate_latency

    tracker = read_trajectory(tracker_file)
    if scan.timestamps_s is None or tracker.timestamps_s is None:
        raise ScanError("to estimate a lag, both the frames and the tracker need times")
    found = estimate_latency(
        scan.frames, scan.timestamps_s, tracker.image_to_reference, tracker.timestamps_s
    )
    return {
        "latency_s": found.lag_s,
        "uncertainty_s": found.uncertainty_s,
        "correlation": found.correlation,
    }


def _table(facts: dict[str, Any]) -> str:
    """Return the facts as lines; what is missing says how to give it."""
    columns, rows = facts["size_px"]
    lines = [
        ("name", facts["name"]),
        ("frames", f"{facts['frames']} of {columns} x {rows} pixels, {facts['pixel_type']}"),
        ("pixel size", _or_missing(facts["spacing_mm"], "{0:.4g} x {1:.4g} mm", "--pixel-spacing")),
        ("field of view", _or_missing(facts["field_of_view_mm"], "{0:.1f} x {1:.1f} mm", None)),
        ("times", _times(facts)),
        ("poses", _poses(facts)),
    ]
    lines += [("subject", facts["subject"])] if facts["subject"] else []
    lines += [("companion", f"{name} {shape}") for name, shape in facts["companions"].items()]
    lines += [("transform", link) for link in facts["transforms"]]
    notes = {about: note for about, note in facts["notes"].items() if about != "poses"}
    lines += [(about, _shortened(note)) for about, note in notes.items()]
    if "lag" in facts:
        lag = facts["lag"]
        lines.append(
            (
                "latency",
                f"{1e3 * lag['latency_s']:.1f} ms +- {1e3 * lag['uncertainty_s']:.1f} ms:"
                " frames are stamped that much later than the tracker"
                f" (correlation {lag['correlation']:.3f})",
            )
        )
    return _aligned(lines)


def _aligned(lines: list[tuple[str, str]]) -> str:
    width = max(len(label) for label, _ in lines)
    return "\n".join(f"{label:<{width}}  {text}" for label, text in lines)


def _shortened(note: str) -> str:
    """Return what a person reads of a note; the settings of a simulation fill a screen."""
    if len(note) <= LONGEST_NOTE:
        return note
    return f"{note[:LONGEST_NOTE]} ... (all of it with --json)"


def _or_missing(values: list[float] | None, form: str, option: str | None) -> str:
    if values is None:
        return "missing" if option is None else f"missing: give it with {option}"
    return form.format(*values)


def _times(facts: dict[str, Any]) -> str:
    if facts["duration_s"] is None:
        return "missing: give them with --frame-rate-hz"
    rate = facts.get("frame_rate_hz")
    duration_s = facts["duration_s"]
    shown = f"{duration_s:.2f} s" if duration_s >= 1 or not duration_s else f"{duration_s:.3g} s"
    return shown + ("" if rate is None else f" at {rate:.1f} Hz")


def _poses(facts: dict[str, Any]) -> str:
    if "poses" not in facts:
        return facts["notes"].get("poses", "none: not tracked")
    text = f"{facts['poses']} of {facts['frames']}"
    length = facts.get("path_length_mm")
    return text if length is None else f"{text}, path {length:.1f} mm"
