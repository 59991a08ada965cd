"""Frames and poses to a volume: the one entry to both engines."""

from typing import Literal

import numpy as np
from jaxtyping import Bool, Float
from torch import Tensor

from sonosweep.errors import ScanError
from sonosweep.estimators.estimator import Progress
from sonosweep.reconstruct.clip import Fan, pixel_mask
from sonosweep.reconstruct.fill import FillMethod, fill_holes
from sonosweep.reconstruct.forward import Compounding, Interpolation, compound_forward
from sonosweep.reconstruct.retire import compound_gather
from sonosweep.scan import Frames, FrameView, Volume, VolumeGrid

Method = Literal["gather", "forward"]


def compound_frames(
    frames: Frames,
    image_to_reference: Float[Tensor, "frames 4 4"],
    pixel_to_image: Float[Tensor, "4 4"],
    grid: VolumeGrid,
    *,
    method: Method = "gather",
    interpolation: Interpolation = "nearest",
    compounding: Compounding = "mean",
    rectangle_px: tuple[int, int, int, int] | None = None,
    fan: Fan | None = None,
    mask: Bool[np.ndarray, "rows columns"] | None = None,
    reject_below: float | None = None,
    confidence: Float[Tensor, " frames"] | None = None,
    skip: int = 1,
    radius_mm: float | Literal["auto"] = "auto",
    prefilter: int | Literal["auto"] = "auto",
    fill: FillMethod | None = None,
    fill_mm: float | None = None,
    threads: int | None = None,
    progress: Progress | None = None,
) -> Volume:
    """Return the volume that the frames make at their poses.

    The result is the same for any number of threads. Frames are read a few at a time.

    Args:
        frames: Frames, with channels or without, of type uint8 (fastest), uint16, int16,
            float32 or float64. Pixels that are not numbers do not count.
        image_to_reference: Pose of each frame.
        pixel_to_image: From (column, row, 0, 1) to image mm, which may lean.
        grid: Where the voxels are, usually from
            :func:`sonosweep.reconstruct.grid.grid_of_sweep`.
        method: ``"gather"`` asks for each voxel which frames pass near it and averages
            them by distance: less noise, no holes. ``"forward"`` puts each pixel into the
            voxels it falls on, as PLUS does.
        interpolation: Of ``"forward"``: ``"nearest"`` or ``"linear"``.
        compounding: Of ``"forward"``: ``"mean"``, ``"latest"``, ``"maximum"`` or
            ``"median"``. ``"gather"`` can only take means.
        rectangle_px: Use only this ``(column, row, width, height)`` of each frame.
        fan: Use only this sector.
        mask: Use only these pixels.
        reject_below: Leave out what is darker.
        confidence: Weight of each frame, 0 (as if absent) to 1; ``"gather"`` only.
        skip: Use every ``skip``-th frame (PLUS's SkipInterval).
        radius_mm: Of ``"gather"``: how far from its plane a frame counts.
        prefilter: Of ``"gather"``: average squares of this many pixels first.
        fill: How to fill holes afterwards; not at all if ``None``.
        fill_mm: Width of the widest hole to fill; nine voxels if ``None``.
        threads: As many as there are cores if ``None``.
        progress: Called with how much is done and of how much.

    Raises:
        ScanError: If counts, shapes, poses, types or settings do not fit, memory would not
            do, or no frame meets the grid.
    """
    if skip < 1:
        raise ScanError(f"skip must be 1 (every frame) or more, got {skip}")
    if len(frames) != len(image_to_reference):
        raise ScanError(f"{len(frames)} frames but {len(image_to_reference)} poses")
    if skip > 1:
        frames = FrameView(frames, indices=np.arange(0, len(frames), skip))
        image_to_reference = image_to_reference[::skip]
        confidence = None if confidence is None else confidence[::skip]
    clipped = rectangle_px is not None or fan is not None or mask is not None
    rows, columns = frames.shape[1:3]
    kept = pixel_mask(rows, columns, rectangle_px, fan, mask) if clipped else None
    if method == "gather":
        if compounding != "mean":
            raise ScanError(
                f"gather compounding takes means, not '{compounding}': choose the forward method"
            )
        volume = compound_gather(
            frames,
            image_to_reference,
            pixel_to_image,
            grid,
            radius_mm=radius_mm,
            prefilter=prefilter,
            mask=kept,
            reject_below=reject_below,
            confidence=confidence,
            threads=threads,
            progress=progress,
        )
    else:
        if confidence is not None:
            raise ScanError("only gather compounding weighs frames by confidence")
        volume = compound_forward(
            frames,
            image_to_reference,
            pixel_to_image,
            grid,
            interpolation=interpolation,
            compounding=compounding,
            mask=kept,
            reject_below=reject_below,
            threads=threads,
            progress=progress,
        )
    return volume if fill is None else fill_holes(volume, fill, fill_mm, threads)
