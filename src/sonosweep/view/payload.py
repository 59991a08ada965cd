"""The data behind the report's interactive part: small volumes, poses and a sheet of frames."""

import base64
import gzip
import io
import json
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from PIL import Image, features

from sonosweep.scan import Frames, Trajectory, Volume
from sonosweep.view.camera import AZIMUTH_DEG, ELEVATION_DEG
from sonosweep.view.content import Report
from sonosweep.view.figures import frame_outlines
from sonosweep.view.projections import AXES, best_covered, display_window
from sonosweep.view.resample import finite, resample_volume

VOXELS = 8_000_000  # of all volumes together
VOLUME_BYTES = 5_500_000  # of all volumes together, as text
SHOWN_FRAMES = 240
SHEET_PIXELS = 7_000_000
SHEET_BYTES = 1_000_000  # noise compresses badly and gets a lower quality
ALONG = 0.9  # cosine beyond which an axis of the volume is named after one of the frame


@dataclass(frozen=True)
class Payload:
    """What the page carries.

    Attributes:
        description: JSON that the script reads.
        volumes: Voxels of each volume: x fastest, uint8, gzip, base64.
        sheet: Frames side by side, as a data address; empty when there are none.
    """

    description: str
    volumes: tuple[str, ...]
    sheet: str


@dataclass(frozen=True, eq=False)
class _Levels:
    """A volume as bytes, and what a byte stands for: ``offset + scale * byte``."""

    volume: Volume
    offset: float
    scale: float


def make_payload(report: Report) -> Payload:
    """Return the data of a report, small enough for a page that can be mailed."""
    volumes = [
        one
        for run in report.runs
        for one in (run.volume, *run.companions.values())
        if one is not None
    ]
    descriptions, texts = [], []
    first = report.runs[0].trajectory
    for volume in volumes:
        levels, packed = _packed(volume, VOXELS // len(volumes), VOLUME_BYTES // len(volumes))
        descriptions.append(_describe(levels, first))
        texts.append(packed)
    frames = min(len(run.trajectory.image_to_reference) for run in report.runs)
    shown = np.unique(np.linspace(0, frames - 1, min(frames, SHOWN_FRAMES)).round().astype(int))
    cine, sheet = _sheet(report.frames, shown)
    points = frame_outlines_in_reference(report)
    low, high = points.min(axis=0), points.max(axis=0)
    description = {
        "runs": _runs(report, shown),
        "volumes": descriptions,
        "frames": frames,
        "shown": shown.tolist(),
        "cine": cine,
        "frame_size": report.frame_size_mm,
        "camera": [np.radians(AZIMUTH_DEG), np.radians(ELEVATION_DEG)],
        "first_axes": first.image_to_reference[0, :3, :3].mT.tolist(),
        "pivot": ((low + high) / 2).tolist(),
        "extent": float(np.linalg.norm(high - low)) or 1.0,
    }
    # "<" could end the script element that holds this.
    words = json.dumps(description, separators=(",", ":"), allow_nan=False)
    return Payload(words.replace("<", "\\u003c"), tuple(texts), sheet)


def frame_outlines_in_reference(report: Report) -> np.ndarray:
    """Return the corners of every frame of every run in the reference, one after another."""
    to_reference = report.runs[0].trajectory.image_to_reference[0].numpy()
    tracks = [run.trajectory for run in report.runs]
    corners = np.concatenate(
        [q.reshape(-1, 3) for q in frame_outlines(tracks, report.frame_size_mm)]
    )
    return corners @ to_reference[:3, :3].T + to_reference[:3, 3]


def name_axes(volume: Volume, trajectory: Trajectory) -> tuple[str, str, str]:
    """Return what the volume's axes are called: as the first frame's where they run along."""
    direction = np.asarray(volume.grid.direction)
    frame = trajectory.image_to_reference[0, :3, :3].numpy()
    cosines = np.abs(direction.T @ frame)
    names = []
    for axis in range(3):
        best = int(cosines[axis].argmax())
        word = ("lateral", "axial", "elevational")[best]
        names.append(word if cosines[axis, best] > ALONG else AXES[axis])
    return names[0], names[1], names[2]


def _packed(volume: Volume, max_voxels: int, max_bytes: int) -> tuple[_Levels, str]:
    """Return a volume as bytes and as text; coarser until the text is short enough."""
    while True:
        levels = _as_bytes(resample_volume(volume, max_voxels), display_window(volume))
        packed = gzip.compress(np.ascontiguousarray(levels.volume.voxels).tobytes(), 6, mtime=0)
        text = base64.b64encode(packed).decode("ascii")
        if len(text) <= max_bytes:
            return levels, text
        max_voxels = int(levels.volume.voxels.size * min(0.8, 0.9 * max_bytes / len(text)))


def _as_bytes(volume: Volume, window: tuple[float, float]) -> _Levels:
    """Return voxels as uint8: as they are when they fit, stretched around the window if not."""
    values = finite(np.asarray(volume.voxels, dtype=np.float32))
    low, high = float(values.min()), float(values.max())
    if low >= 0 and high <= 255 and window[1] > 25:
        levels = _Levels(volume, 0.0, 1.0)
    else:
        low, high = max(low, 2 * window[0] - window[1]), min(high, 2 * window[1] - window[0])
        levels = _Levels(volume, low, max(high - low, 1e-12) / 255)
    scaled = np.clip((values - levels.offset) / levels.scale, 0, 255)
    return replace(levels, volume=Volume(np.rint(scaled).astype(np.uint8), volume.grid))


def _describe(levels: _Levels, first: Trajectory) -> dict[str, Any]:
    volume, grid = levels.volume, levels.volume.grid
    window = display_window(volume)
    return {
        "size": grid.size,
        "spacing": grid.spacing_mm,
        "origin": grid.origin_mm,
        "axes": np.asarray(grid.direction).T.tolist(),
        "names": name_axes(volume, first),
        "window": [round(window[0], 1), round(window[1], 1)],
        "offset": levels.offset,
        "scale": levels.scale,
        "start": best_covered(volume),
    }


def _runs(report: Report, shown: np.ndarray) -> list[dict[str, Any]]:
    """Return names, poses (three rows of four) and which volumes belong to each run."""
    runs, next_volume = [], 0
    for run in report.runs:
        index = -1
        if run.volume is not None:
            index, next_volume = next_volume, next_volume + 1
        companions = []
        for name in run.companions:
            companions.append({"name": name, "volume": next_volume})
            next_volume += 1
        poses = run.trajectory.image_to_reference[shown, :3].reshape(-1, 12).numpy().round(5)
        runs.append(
            {"name": run.name, "poses": poses.tolist(), "volume": index, "companions": companions}
        )
    return runs


def _sheet(frames: Frames | None, shown: np.ndarray) -> tuple[dict[str, int] | None, str]:
    """Return the layout of a sheet of frames, and the sheet as a data address."""
    if frames is None or len(frames) == 0:
        return None, ""
    shown = np.minimum(shown, len(frames) - 1)
    rows, columns = frames.shape[1:3]
    scale = min(1.0, (SHEET_PIXELS / len(shown) / (rows * columns)) ** 0.5)
    width, height = max(1, int(columns * scale)), max(1, int(rows * scale))
    across = max(1, min(len(shown), round((len(shown) * height / width) ** 0.5)))
    down = -(-len(shown) // across)
    sheet = Image.new("L", (across * width, down * height))
    top = _brightest(frames, shown)
    for k, index in enumerate(shown):
        frame = np.asarray(frames[int(index)])
        gray = frame.mean(axis=-1) if frame.ndim == 3 else frame
        gray = np.clip(finite(gray.astype(np.float32)) * (255.0 / top), 0, 255)
        tile = Image.fromarray(gray.astype(np.uint8)).resize((width, height), Image.Resampling.BOX)
        sheet.paste(tile, (k % across * width, k // across * height))
    layout = {"across": across, "width": width, "height": height}
    return layout, _encoded(sheet)


def _brightest(frames: Frames, shown: np.ndarray) -> float:
    """Return the value that becomes white: 255 for 8-bit frames, else the brightest of five."""
    if np.dtype(frames.dtype) == np.uint8:
        return 255.0
    few = shown[:: max(1, len(shown) // 5)]
    return max(float(finite(np.asarray(frames[int(k)])).max()) for k in few) or 1.0


def _encoded(image: Image.Image) -> str:
    kind = "webp" if features.check("webp") else "jpeg"
    for quality in (62, 40, 20, 5, 0):
        buffer = io.BytesIO()
        image.save(buffer, kind.upper(), quality=quality)
        if buffer.tell() <= SHEET_BYTES:
            break
    return f"data:image/{kind};base64,{base64.b64encode(buffer.getvalue()).decode('ascii')}"
