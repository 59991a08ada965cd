"""From sequence files to scans and trajectories: the chain of transforms, and what it scales.

``image_to_reference`` is the product of the transforms that lead from Image to Reference. The
first of them holds the size of a pixel, which a scan keeps in its calibration, so that its
poses are rigid.
"""

import os
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sonosweep.errors import FormatError, ScanError
from sonosweep.geometry import is_rigid, nearest_pose, pose_from_parts
from sonosweep.io.image_orientation import turn_to
from sonosweep.io.plus_config import PlusConfig, read_plus_config
from sonosweep.io.sequence import Sequence, own_header, read_sequence
from sonosweep.io.transform_graph import (
    TransformLink,
    find_chain,
    link_matrices,
    missing_link,
    transform_graph,
)
from sonosweep.scan import (
    Calibration,
    Frames,
    FrameView,
    Region,
    Scan,
    Trajectory,
    calibration_from_matrix,
    pixel_to_image,
)

DEFAULT_REFERENCE = "Reference"
TRACKER = "Tracker"


def read_plus(
    path: str | os.PathLike,
    config: PlusConfig | str | os.PathLike | None = None,
    spacing_mm: tuple[float, float] | None = None,
    orientation: str | None = None,
) -> Scan:
    """Return the scan that a sequence file and, if given, a PLUS configuration describe.

    Args:
        path: A sequence file, see :func:`sonosweep.io.sequence.read_sequence`.
        config: The configuration, or its file; it holds the calibration of the probe.
        spacing_mm: Pixel size (lateral, axial), against what the files say.
        orientation: How the images lie in the file, such as ``"UF"``, against what it says.

    Raises:
        FormatError: If a file is not what it should be.
        ScanError: If the sequence holds no B-mode images, or transforms that are none.
    """
    if config is not None and not isinstance(config, PlusConfig):
        config = read_plus_config(config)
    sequence = read_sequence(path, orientation)
    settings = config.reconstruction if config is not None else None
    if settings is None:
        return scan_from_sequence(sequence, config, spacing_mm)
    return scan_from_sequence(
        sequence, config, spacing_mm, settings.image_system, settings.reference_system
    )


def scan_from_sequence(
    sequence: Sequence,
    config: PlusConfig | None = None,
    spacing_mm: tuple[float, float] | None = None,
    image: str = "Image",
    reference: str = DEFAULT_REFERENCE,
) -> Scan:
    """Return the scan in a sequence; frames without image are left out.

    If nothing leads to the reference but the tracker is known, the poses are in the tracker's
    coordinates and the notes say so. If nothing leads from the image to either, there are no
    poses and ``notes["poses"]`` names the missing link.

    Args:
        sequence: What the file holds.
        config: Fixed transforms that the file does not hold.
        spacing_mm: Pixel size (lateral, axial), against what the transforms say.
        image: Name of the coordinate system of the pixels.
        reference: Name of the coordinate system of the poses.

    Raises:
        ScanError: If there are no B-mode images, or a transform that must be rigid is not.
    """
    frames = _check_frames(sequence)
    notes: dict[str, str] = {}
    poses, tracked, calibration = None, None, None
    chain = _find_tracked_chain(sequence, config, image, reference, notes)
    if chain is not None:
        poses, tracked, calibration = _chain_poses(sequence, config, chain)
    calibration = _complete_calibration(sequence, config, image, calibration, spacing_mm, notes)
    if turn_to("MF", sequence.orientation) is None:
        notes["orientation"] = (
            f"the file does not say how its images lie ('{sequence.orientation}'): taken as MF,"
            " the marked side of the probe on the right"
        )
    keep = torch.arange(sequence.count)
    if sequence.image_valid is not None and not bool(sequence.image_valid.all()):
        keep = keep[sequence.image_valid]
        frames = FrameView(frames, keep.numpy())
        notes["frames"] = f"{sequence.count - len(keep)} frames hold no image and were left out"
    if tracked is not None and poses is not None:
        poses, tracked = poses[keep], tracked[keep]
    own = own_header(sequence)
    return Scan(
        name=sequence.name,
        frames=frames,
        calibration=calibration,
        timestamps_s=_increasing_times(sequence, keep, notes),
        image_to_reference=poses,
        tracked=None if tracked is None or bool(tracked.all()) else tracked,
        subject=own.get("subject"),
        region=_own_region(own),
        notes=notes,
    )


def trajectory_from_sequence(
    sequence: Sequence,
    config: PlusConfig | None = None,
    image: str = "Image",
    reference: str = DEFAULT_REFERENCE,
) -> Trajectory:
    """Return the poses of a sequence, with or without images, where the tracker had them.

    With ``image="Probe"`` it is the motion of the tracked sensor. Times are kept if every
    frame has one.

    Raises:
        ScanError: If no transforms lead from the image to the reference (the message names
            the missing link), or a transform that must be rigid is not.
    """
    notes: dict[str, str] = {}
    chain = _find_tracked_chain(sequence, config, image, reference, notes)
    if chain is None:
        raise ScanError(f"no trajectory in '{sequence.name}': {notes['poses']}")
    poses, tracked, _ = _chain_poses(sequence, config, chain)
    if not bool(tracked.any()):
        raise ScanError(f"no trajectory in '{sequence.name}': the tracker saw no frame")
    times = sequence.timestamps_s
    if times is not None:
        times = times[tracked] if bool(torch.isfinite(times[tracked]).all()) else None
    own = own_header(sequence)
    return Trajectory(
        image_to_reference=poses[tracked],
        timestamps_s=times,
        step_std=_own_step_std(sequence) if bool(tracked.all()) else None,
        method=own.get("method", "tracked"),
        assumptions=tuple(text for name, text in own.items() if name.startswith("assumption_")),
        settings={
            **{
                name.removeprefix("setting_"): text
                for name, text in own.items()
                if name.startswith("setting_")
            },
            **notes,
        },
    )


def _check_frames(sequence: Sequence) -> Frames:
    if sequence.frames is None:
        raise ScanError(f"'{sequence.name}' holds transforms but no images: it is no scan")
    if sequence.image_type.startswith("RF_"):
        raise ScanError(
            f"'{sequence.name}' holds {sequence.image_type} lines, not B-mode: convert them to"
            " B-mode first"
        )
    if sequence.image_valid is not None and not bool(sequence.image_valid.any()):
        raise ScanError(f"no frame of '{sequence.name}' holds an image: all are marked INVALID")
    return sequence.frames


def _find_tracked_chain(
    sequence: Sequence,
    config: PlusConfig | None,
    image: str,
    reference: str,
    notes: dict[str, str],
) -> list[TransformLink] | None:
    """Return the way from image to reference, or to the tracker; notes say what was not found."""
    links = transform_graph(sequence, config)
    goals = (reference, TRACKER) if reference == DEFAULT_REFERENCE else (reference,)
    for goal in goals:
        chain = find_chain(links, image, goal)
        if chain is None or not any(link.origin == "frames" for link in chain):
            continue
        if goal != reference:
            notes["reference"] = f"poses are in {goal}: {missing_link(links, image, reference)}"
        return chain
    if not sequence.transforms:
        notes["poses"] = "the file holds no transforms of its frames: it was not tracked"
    elif find_chain(links, image, goals[0]) is not None:
        notes["poses"] = f"every transform from {image} to {goals[0]} is fixed: nothing was tracked"
    else:
        notes["poses"] = missing_link(links, image, goals[0])
    return None


def _chain_poses(
    sequence: Sequence, config: PlusConfig | None, chain: list[TransformLink]
) -> tuple[Float[Tensor, "frames 4 4"], Bool[Tensor, " frames"], Calibration]:
    """Return rigid poses (NaN where not tracked), which are tracked, and the pixel size.

    The transforms before the first tracked one place the image on the probe and hold the
    pixel size; if there are none, the first tracked one holds it.
    """
    matrices = [link_matrices(link, sequence, config) for link in chain]
    tracked = torch.ones(sequence.count, dtype=torch.bool)
    for link in chain:
        if link.origin == "frames":
            tracked &= sequence.transforms[(link.source, link.target)].valid
    first = next(k for k, link in enumerate(chain) if link.origin == "frames")
    if first > 0:
        lead = torch.eye(4, dtype=torch.float64)
        for matrix in matrices[:first]:
            lead = matrix @ lead
        calibration = calibration_from_matrix(lead)
        assert calibration.image_to_probe is not None
        poses = calibration.image_to_probe
    else:
        first = 1
        some = int(tracked.int().argmax())
        calibration = replace(calibration_from_matrix(matrices[0][some]), image_to_probe=None)
        poses = _rigid_from_pixels(matrices[0], calibration)
        _check_rigid(poses, tracked, chain[0], sequence)
        poses = nearest_pose(poses)
    for link, matrix in zip(chain[first:], matrices[first:], strict=True):
        _check_rigid(matrix, tracked, link, sequence)
        poses = nearest_pose(matrix) @ poses
    poses = poses.expand(sequence.count, 4, 4).clone()
    poses[~tracked] = float("nan")
    return poses, tracked, calibration


def _rigid_from_pixels(
    pixel_to_reference: Float[Tensor, "frames 4 4"], calibration: Calibration
) -> Float[Tensor, "frames 4 4"]:
    """Return the poses of images whose matrices hold the pixel size; z becomes x cross y."""
    axes = pixel_to_reference[:, :3, :2] @ torch.linalg.inv(pixel_to_image(calibration)[:2, :2])
    z = torch.linalg.cross(axes[..., 0], axes[..., 1])
    rotation = torch.stack((axes[..., 0], axes[..., 1], z), dim=-1)
    return pose_from_parts(rotation, pixel_to_reference[:, :3, 3])


def _check_rigid(
    matrices: Float[Tensor, "*frames 4 4"],
    tracked: Bool[Tensor, " frames"],
    link: TransformLink,
    sequence: Sequence,
) -> None:
    rigid = is_rigid(matrices)
    if matrices.ndim == 3:
        rigid = rigid | ~tracked
    if bool(rigid.all()):
        return
    where = f" of frame {int((~rigid).nonzero()[0])}" if matrices.ndim == 3 else ""
    raise ScanError(
        f"{link.name}{where} in '{sequence.name}' is not rigid: expected a rotation and a"
        " translation, with the pixel size only in the first transform from the image"
    )


def _complete_calibration(
    sequence: Sequence,
    config: PlusConfig | None,
    image: str,
    calibration: Calibration | None,
    spacing_mm: tuple[float, float] | None,
    notes: dict[str, str],
) -> Calibration | None:
    """Return the calibration with what fixed transforms, the file and the caller add."""
    own = own_header(sequence)
    placed = _image_on_probe(sequence, config, image)
    if calibration is None:
        calibration = placed or _stated_calibration(sequence, own)
    elif calibration.image_to_probe is None and placed is not None:
        calibration = replace(calibration, image_to_probe=placed.image_to_probe)
    if spacing_mm is not None:
        calibration = replace(calibration or Calibration(spacing_mm), spacing_mm=spacing_mm)
    if calibration is None:
        notes["calibration"] = "the file does not say how large a pixel is"
        return None
    try:
        return replace(
            calibration,
            latency_s=float(own.get("latency_s", 0.0)),
            pixel_axes="row_column" if own.get("pixel_axes") == "row_column" else "column_row",
            pixel_origin=1 if own.get("pixel_origin") == "1" else 0,
        )
    except ValueError as error:
        raise FormatError(f"{error}, in the header of '{sequence.name}'") from error


def _image_on_probe(
    sequence: Sequence, config: PlusConfig | None, image: str
) -> Calibration | None:
    """Return what the fixed transforms say of the image; a probe is preferred to others."""
    fixed = [link for link in transform_graph(sequence, config) if link.origin != "frames"]
    chain = find_chain(fixed, image, "Probe")
    if chain is None:
        chain = [link for link in fixed if link.source == image][:1]
    if not chain:
        return None
    lead = torch.eye(4, dtype=torch.float64)
    for link in chain:
        lead = link_matrices(link, sequence, config) @ lead
    return calibration_from_matrix(lead)


def _stated_calibration(sequence: Sequence, own: dict[str, str]) -> Calibration | None:
    try:
        if "spacing_mm" in own:
            lateral, axial = (float(word) for word in own["spacing_mm"].split())
            return Calibration((lateral, axial), shear=float(own.get("shear", 0.0)))
    except ValueError as error:
        raise FormatError(f"{error}, in the header of '{sequence.name}'") from error
    return None if sequence.spacing_mm is None else Calibration(sequence.spacing_mm)


def _increasing_times(
    sequence: Sequence, keep: Tensor, notes: dict[str, str]
) -> Float[Tensor, " frames"] | None:
    if sequence.timestamps_s is None:
        return None
    times = sequence.timestamps_s[keep]
    if bool(torch.isfinite(times).all()) and bool((times.diff() > 0).all()):
        return times
    notes["timestamps"] = "the timestamps are not complete or do not increase: not used"
    return None


def _own_region(own: dict[str, str]) -> Region | None:
    words = own.get("region_px", "").split()
    try:
        column, row, width, height = (int(word) for word in words)
        return Region((column, row, width, height))
    except ValueError:
        return None


def _own_step_std(sequence: Sequence) -> Float[Tensor, "steps motion=6"] | None:
    texts = sequence.frame_fields.get("NextStepStd", ())[:-1]
    try:
        rows = np.array([[float(word) for word in text.split()] for text in texts])
    except ValueError:
        return None
    return torch.from_numpy(rows) if rows.shape == (sequence.count - 1, 6) else None
