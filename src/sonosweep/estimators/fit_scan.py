"""The part of a scan that a trained network can look at, in pixels of the size it knows.

A network has learned how fast speckle changes in pixels of one size and over one field of
view. A scan is brought to these by one rule:

- What training would have taken comes first: the middle of the frame, if the network was
  trained on the middle of frames (``crop_px``) and it holds the image; the whole frame, if
  its size is the one that the network knows and it is no sector.
- Otherwise the field of view is that of the scan's region: the whole frame, or the part that
  holds the image. Where it is larger, the middle is taken laterally, and the part nearest to
  the probe axially (the middle there too, after training on the middle). Of a sector, which
  no network sees whole, a rectangle that lies within it is taken, as near to the probe as it
  can be.
- Where it is smaller, it is stretched if it has at least 85 % of what the network saw, and
  refused otherwise. Nothing is padded: an edge would move with the probe. Motions are
  corrected for the stretch.
- Pixels of another size are resampled. Those more than 1.5 times as large are noted, and
  those more than 2.5 times as large refused: the speckle that the network reads is hardly,
  or not at all, in them.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool

from sonosweep.errors import ScanError
from sonosweep.estimators.network_input import NetworkFrames, echo_companion, network_frames
from sonosweep.estimators.weights import WeightsInfo
from sonosweep.scan import FrameView, Scan, crop_scan, pixel_to_image

SMALLEST_SHARE = 0.85  # of the field of view that a network knows
COARSE_PIXEL, LARGEST_PIXEL = 1.5, 2.5  # times the one that it knows
SECTOR_SHARES = (1.0, 0.95, 0.9, 0.85)  # tried in this order
SAME_SIZE = 0.02  # by which fields of view may differ that count as the same
HELD_SHARE = 0.95  # of a crop of the middle that must lie within the image

Rectangle = tuple[int, int, int, int]


@dataclass(frozen=True, eq=False)
class FittedScan:
    """What a network reads of a scan.

    Attributes:
        frames: Of the size and the channels that it knows.
        center_mm: Where the centre of what it reads lies in the scan's image coordinates.
        stretch: How large its pixels are, as a share of those it was trained on; 1 unless the
            field of view is smaller.
        spacing_mm: True size of its pixels.
        notes: One sentence each on what was cut off or stretched.
    """

    frames: NetworkFrames
    center_mm: tuple[float, float]
    stretch: tuple[float, float]
    spacing_mm: tuple[float, float]
    notes: tuple[str, ...]


def fit_scan(scan: Scan, info: WeightsInfo) -> FittedScan:
    """Return what a network of these weights reads of a scan.

    Raises:
        ScanError: If it has no pixel size, too small a field of view, too coarse pixels, or
            lacks a channel.
    """
    if scan.calibration is None:
        raise ScanError(
            f"'{scan.name}' has no pixel spacing, which the weights of '{info.network}' need:"
            " give it with --pixel-spacing"
        )
    spacing = scan.calibration.spacing_mm
    _refuse_coarse(scan.name, spacing, info)
    rectangle = _rectangle(scan, info)
    size_mm = _field_mm(info)
    cut_mm = (rectangle[2] * spacing[0], rectangle[3] * spacing[1])
    column, row, width, height = rectangle
    middle = torch.tensor(
        [column + (width - 1) / 2, row + (height - 1) / 2, 0, 1], dtype=torch.float64
    )
    x, y, *_ = (pixel_to_image(scan.calibration) @ middle).tolist()
    settings = info.input.model_copy(update={"crop_px": None})
    return FittedScan(
        frames=network_frames(_cut(scan, rectangle, info), settings),
        center_mm=(x, y),
        stretch=(cut_mm[0] / size_mm[0], cut_mm[1] / size_mm[1]),
        spacing_mm=(cut_mm[0] / info.input.columns, cut_mm[1] / info.input.rows),
        notes=(*_notes(scan, rectangle, cut_mm, size_mm), *_coarse(spacing, info)),
    )


def _field_mm(info: WeightsInfo) -> tuple[float, float]:
    return info.spacing_mm[0] * info.input.columns, info.spacing_mm[1] * info.input.rows


def _refuse_coarse(name: str, spacing_mm: tuple[float, float], info: WeightsInfo) -> None:
    for axis, here, known in zip(("lateral", "axial"), spacing_mm, info.spacing_mm, strict=True):
        if here > LARGEST_PIXEL * known:
            raise ScanError(
                f"{axis} pixels of '{name}' are {here:.3g} mm, too coarse for weights that were"
                f" trained at {known:.3g} mm; {LARGEST_PIXEL * known:.3g} mm is the most"
            )


def _coarse(spacing_mm: tuple[float, float], info: WeightsInfo) -> tuple[str, ...]:
    """Return what to say about pixels that are large, but not too large."""
    if all(here <= COARSE_PIXEL * k for here, k in zip(spacing_mm, info.spacing_mm, strict=True)):
        return ()
    return (
        f"Pixels of {spacing_mm[0]:.3g} x {spacing_mm[1]:.3g} mm are coarse for weights that were"
        f" trained at {info.spacing_mm[0]:.3g} x {info.spacing_mm[1]:.3g} mm: what the network says"
        " is hardly more than a guess.",
    )


def _rectangle(scan: Scan, info: WeightsInfo) -> Rectangle:
    """Return the (column, row, width, height) that the network looks at."""
    assert scan.calibration is not None
    spacing, field_mm = scan.calibration.spacing_mm, _field_mm(info)
    rows, columns = scan.frames.shape[1:3]
    region = (0, 0, columns, rows) if scan.region is None else scan.region.rectangle_px
    wanted = tuple(mm / step for mm, step in zip(field_mm, spacing, strict=True))
    known = _as_trained(scan, info, wanted)
    if known is not None:
        return known
    if scan.region is not None and scan.region.mask is not None:
        found = _in_sector(scan.region.mask, region, wanted)
        if found is None:
            raise ScanError(
                f"the image of '{scan.name}' is a sector that holds no"
                f" {SMALLEST_SHARE * field_mm[0]:.0f} x {SMALLEST_SHARE * field_mm[1]:.0f} mm, the"
                f" least of the {field_mm[0]:.0f} x {field_mm[1]:.0f} mm that the weights know"
            )
        return found
    for axis, k in (("wide", 0), ("deep", 1)):
        if region[2 + k] < SMALLEST_SHARE * wanted[k]:
            raise ScanError(
                f"the image of '{scan.name}' is {region[2 + k] * spacing[k]:.1f} mm {axis}, and the"
                f" weights were trained on {field_mm[k]:.1f} mm; {100 * SMALLEST_SHARE:.0f} % of"
                " that is the least"
            )
    width, height = (max(1, min(region[2 + k], round(wanted[k]))) for k in (0, 1))
    down = (region[3] - height) // 2 if info.input.crop_px is not None else 0
    return region[0] + (region[2] - width) // 2, region[1] + down, width, height


def _as_trained(scan: Scan, info: WeightsInfo, wanted: tuple[float, ...]) -> Rectangle | None:
    """Return the rectangle that training would have taken; ``None`` if it is not the image."""
    rows, columns = scan.frames.shape[1:3]
    region = scan.region
    if info.input.crop_px is None:
        mask = None if region is None else region.mask
        known = np.abs(np.divide((columns, rows), wanted) - 1).max() <= SAME_SIZE
        return (0, 0, columns, rows) if known and mask is None else None
    width, height = (round(size) for size in wanted)
    left, top = (columns - width) // 2, (rows - height) // 2
    if left < 0 or top < 0:
        return None
    inside = np.ones((rows, columns), dtype=bool)
    if region is not None:
        inside[:] = False
        x, y, across, down = region.rectangle_px
        inside[y : y + down, x : x + across] = True
        if region.mask is not None:
            inside &= np.asarray(region.mask)
    held = float(inside[top : top + height, left : left + width].mean())
    return (left, top, width, height) if held >= HELD_SHARE else None


def _in_sector(
    mask: Bool[np.ndarray, "rows columns"], region: Rectangle, wanted: tuple[float, ...]
) -> Rectangle | None:
    """Return the highest rectangle within a mask, in the middle laterally; ``None`` if none fits.

    The whole field of view if possible, and less of it if not.
    """
    for share in SECTOR_SHARES:
        width, height = (max(1, round(share * size)) for size in wanted)
        left = region[0] + (region[2] - width) // 2
        if left < 0 or left + width > mask.shape[1]:
            continue
        full = np.asarray(mask[:, left : left + width].all(axis=1), dtype=np.int64)
        filled = np.concatenate(([0], full.cumsum()))
        tops = np.flatnonzero(filled[height:] - filled[:-height] == height)
        if len(tops):
            return left, int(tops[0]), width, height
    return None


def _cut(scan: Scan, rectangle: Rectangle, info: WeightsInfo) -> Scan:
    """Return the scan without what the network does not look at, companions included."""
    cut = crop_scan(scan, rectangle)
    name = echo_companion(scan, info.input.channels)
    if name is None:
        return cut
    echoes = scan.companions[name]
    if echoes.frames.shape[1:3] != scan.frames.shape[1:3]:
        return replace(cut, companions={name: echoes})  # which is refused later on
    seen = replace(echoes, frames=FrameView(echoes.frames, rectangle_px=rectangle))
    return replace(cut, companions={name: seen})


def _notes(
    scan: Scan,
    rectangle: Rectangle,
    cut_mm: tuple[float, float],
    size_mm: tuple[float, float],
) -> tuple[str, ...]:
    rows, columns = scan.frames.shape[1:3]
    notes = []
    if rectangle != (0, 0, columns, rows):
        column, row, width, height = rectangle
        notes.append(
            f"The network looked at {cut_mm[0]:.1f} x {cut_mm[1]:.1f} mm: {width} x {height}"
            f" pixels from column {column} and row {row} on."
        )
    # Less than a pixel is rounding.
    if any(abs(here / known - 1) > 0.02 for here, known in zip(cut_mm, size_mm, strict=True)):
        notes.append(
            f"The network was trained on {size_mm[0]:.1f} x {size_mm[1]:.1f} mm; what it looked at"
            " is smaller and was stretched."
        )
    if scan.region is not None and scan.region.mask is not None:
        notes.append("The image is a sector, of which the network saw a rectangle.")
    return tuple(notes)
