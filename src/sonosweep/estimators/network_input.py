"""What a network reads of a scan: which channels, how many pixels, of what size.

Training and use share this file, so that a network sees the same in both. Motions are those
of the *centre* of the frame (see :func:`center_steps`): there, translations and turns hardly
depend on one another, while a turn moves the first pixel by half the width of the frame.
"""

import math
from dataclasses import replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Num
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor

from sonosweep.errors import ScanError
from sonosweep.geometry import pose_from_parts
from sonosweep.imaging import lee_filter_gray
from sonosweep.scan import Frames, FrameView, LazyFrames, Scan, crop_scan_center, resample_scan
from sonosweep.scan.crop import resize_frame

Channels = Literal["b_mode", "amplitude", "b_mode+iq", "lee"]
COMPANIONS: dict[Channels, tuple[str, ...]] = {
    "amplitude": ("amplitude", "iq"),
    "b_mode+iq": ("iq",),
}
"""Of each channel the companions it can be made of, the first one that is there."""
ZEROS: dict[Channels, tuple[float | None, ...]] = {
    "b_mode": (None,),
    "amplitude": (0.0,),
    "b_mode+iq": (None, 0.5, 0.5),
    "lee": (None,),
}
"""Of each channel the value that stands for no echo; ``None`` for gray levels."""
PROBED_FRAMES = 8  # from which the largest amplitude of a scan is taken
WHITE_PERCENTILE = 99.5  # of the amplitudes, which becomes 1


class InputSettings(BaseModel):
    """What a network reads.

    Attributes:
        rows: Pixels along the axial axis; the whole depth is resized to them.
        columns: Pixels along the lateral axis.
        channels: ``"b_mode"``; ``"amplitude"``: before log compression (the paper's Log
            ablation), the size of the IQ data where no amplitude is stored;
            ``"b_mode+iq"``: with real and imaginary part (the paper's IQ has the logarithm
            of its size instead, which is B-mode before the gray map); ``"lee"``: B-mode with
            less speckle (SP).
        crop_px: Columns and rows in the middle of the scan's frames to keep; the paper's
            data set 3 is cropped to 320 x 320.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    rows: int = Field(default=128, ge=32, le=4096)
    columns: int = Field(default=128, ge=32, le=4096)
    channels: Channels = "b_mode"
    crop_px: tuple[int, int] | None = None

    @property
    def count(self) -> int:
        """How many channels a frame has."""
        return len(ZEROS[self.channels])


def network_scan(scan: Scan, settings: InputSettings) -> Scan:
    """Return the scan with B-mode frames and poses of the size that a network reads.

    Raises:
        ScanError: If it has no pixel size, or is smaller than the crop.
    """
    if scan.calibration is None:
        raise ScanError(f"'{scan.name}' has no pixel spacing, which a network needs")
    gray = _gray(scan)
    if settings.crop_px is not None:
        gray = crop_scan_center(gray, *settings.crop_px)
    if gray.frames.shape[1:] == (settings.rows, settings.columns):
        return gray
    return resample_scan(gray, settings.columns, settings.rows)


def network_frames(scan: Scan, settings: InputSettings) -> "NetworkFrames":
    """Return what a network reads of each frame of a scan, made when it is asked for.

    Raises:
        ScanError: If the scan lacks a channel, or its frames are not 8-bit.
    """
    gray = _gray(scan)
    if gray.frames.dtype != np.uint8:
        raise ScanError(f"a network reads 8-bit frames, those of '{scan.name}' are not")
    if settings.channels not in COMPANIONS:
        return NetworkFrames(gray.frames, None, 1.0, settings)
    name = echo_companion(scan, settings.channels)
    if name is None:
        needed = "' or '".join(COMPANIONS[settings.channels])
        raise ScanError(
            f"channels '{settings.channels}' need the companion '{needed}', which"
            f" '{scan.name}' does not have"
        )
    echoes = scan.companions[name].frames
    if echoes.shape[1:3] != gray.frames.shape[1:3]:
        raise ScanError(f"'{name}' of '{scan.name}' has other pixels than its B-mode frames")
    return NetworkFrames(gray.frames, echoes, _white(echoes, scan.name), settings)


def echo_companion(scan: Scan, channels: Channels) -> str | None:
    """Return which companion of a scan the channels are made of; ``None`` if none is."""
    names = COMPANIONS.get(channels, ())
    return next((name for name in names if name in scan.companions), None)


class NetworkFrames(LazyFrames):
    """Frames as ``(frames, channels, rows, columns)``: uint8, or float16 from 0 to 1.

    Args:
        gray: B-mode, 8-bit.
        echoes: Amplitudes, or real and imaginary part in a last axis; ``None`` without.
        white: Amplitude that becomes 1.
        settings: What a network reads.
    """

    def __init__(
        self, gray: Frames, echoes: Frames | None, white: float, settings: InputSettings
    ) -> None:
        shape = (len(gray), settings.count, settings.rows, settings.columns)
        super().__init__(shape, np.dtype(np.uint8 if echoes is None else np.float16))
        self._gray, self._echoes, self._white, self._settings = gray, echoes, white, settings

    def _read(self, frame: int) -> np.ndarray:
        if self._echoes is None:
            gray = np.ascontiguousarray(self._gray[frame])
            if self._settings.channels == "lee":
                gray = lee_filter_gray(gray)
            return self._sized(gray)[None]
        echoes = np.asarray(self._echoes[frame], dtype=np.float32) / self._white
        if self._settings.channels == "amplitude" and echoes.ndim == 3:
            echoes = np.hypot(echoes[..., 0], echoes[..., 1])
        sized = self._sized(echoes)
        if self._settings.channels == "amplitude":
            return sized.clip(0, 1).astype(np.float16)[None]
        gray = self._sized(np.asarray(self._gray[frame])) / np.float32(255)
        parts = np.moveaxis(0.5 + 0.5 * sized, -1, 0).clip(0, 1)
        return np.concatenate((gray[None], parts)).astype(np.float16)

    def _sized(self, image: np.ndarray) -> np.ndarray:
        rows, columns = image.shape[:2]
        if self._settings.crop_px is not None:
            width, height = self._settings.crop_px
            left, top = (columns - width) // 2, (rows - height) // 2
            image = image[top : top + height, left : left + width]
        if image.shape[:2] == (self._settings.rows, self._settings.columns):
            return image
        return resize_frame(image, self._settings.columns, self._settings.rows)


def unit_frames(frames: Num[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Return stored frames as a network reads them: float32 from 0 to 1."""
    return frames.float() / 255 if frames.dtype == torch.uint8 else frames.float()


def center_mm(scan: Scan) -> tuple[float, float]:
    """Return where the centre of the frames is, in image coordinates (lateral, axial)."""
    assert scan.calibration is not None
    rows, columns = scan.frames.shape[1:3]
    x, y = scan.calibration.spacing_mm
    return (columns - 1) / 2 * x, (rows - 1) / 2 * y


def center_poses(
    image_to_reference: Float[Tensor, "*batch 4 4"], center: tuple[float, float]
) -> Float[Tensor, "*batch 4 4"]:
    """Return poses of coordinates with the image's axes and their origin in its centre."""
    return image_to_reference @ _from_center(center, image_to_reference)


def image_steps(
    center_steps: Float[Tensor, "*batch 4 4"], center: tuple[float, float]
) -> Float[Tensor, "*batch 4 4"]:
    """Return steps in image coordinates from those about the centre of the frame."""
    opposite = (-center[0], -center[1])
    return _from_center(center, center_steps) @ center_steps @ _from_center(opposite, center_steps)


def _from_center(center: tuple[float, float], like: Tensor) -> Float[Tensor, "4 4"]:
    origin = torch.tensor([*center, 0.0], dtype=like.dtype, device=like.device)
    return pose_from_parts(torch.eye(3, dtype=like.dtype, device=like.device), origin)


def _gray(scan: Scan) -> Scan:
    if len(scan.frames.shape) == 3:
        return scan
    return replace(scan, frames=FrameView(scan.frames, gray=True))


def _white(echoes: Frames, name: str) -> float:
    """Return the amplitude that becomes 1, from a few frames spread over the scan."""
    chosen = np.linspace(0, len(echoes) - 1, min(PROBED_FRAMES, len(echoes))).astype(int)
    stack = np.stack([np.asarray(echoes[int(i)], dtype=np.float32) for i in chosen])
    size = np.hypot(stack[..., 0], stack[..., 1]) if stack.ndim == 4 else np.abs(stack)
    white = float(np.percentile(size, WHITE_PERCENTILE))
    if not (math.isfinite(white) and white > 0):
        raise ScanError(f"the echoes of '{name}' are empty or not finite")
    return white
