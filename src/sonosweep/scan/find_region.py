"""Find the part of the frames that holds ultrasound, from what changes over time."""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Num
from scipy import ndimage
from scipy.spatial import ConvexHull

from sonosweep.scan.crop import crop_scan
from sonosweep.scan.frames import Frames, FrameView
from sonosweep.scan.region import Region
from sonosweep.scan.scan import Scan

# A pixel this far from the border's grey level, as a share of the range of grey levels, is
# image; below lie the traces that lossy compression leaves.
IMAGE_CONTRAST = 0.02
# Dark gaps up to this many pixels wide are bridged, and lines up to this many are dropped.
BRIDGED_PX = 9
DROPPED_PX = 5
# A region that fills this much of its rectangle is one; a sector fills 0.85 at most.
RECTANGLE_FILL = 0.92
# Less border than this share of the frame's rim is no border.
LEAST_BORDER = 0.05


def find_region(frames: Frames, samples: int = 24) -> Region:
    """Return where the image is within the frames: a rectangle, or a sector with a mask.

    What differs from the border's grey level in some frame is image or text; of its
    connected parts the one that changes most is taken, so that text, logos and grey scales
    drop out. A sector is completed to its convex outline below its upper edge, so that
    shadows do not notch it. Without a border, or if nothing changes or shows, it is the
    whole frame. Depths that stay black in every frame are cut off: give a sweep over
    tissue, not over water.

    Args:
        frames: Gray or colour; only some are read, one at a time.
        samples: How many frames to read at most, spread over the sweep.
    """
    columns, rows = frames.shape[2], frames.shape[1]
    whole = Region((0, 0, columns, rows))
    if len(frames) == 0:
        return whole
    lowest, highest = _extremes(frames, samples)
    shown = _differs_from_border(lowest, highest)
    if shown is None:
        return whole
    part = _most_changing_part(_clean(shown), highest - lowest)
    if part is None:
        return whole
    outline = _convex_outline(part)
    box = _bounding_box(outline)
    if np.count_nonzero(outline) >= RECTANGLE_FILL * box[2] * box[3]:
        return Region(box)
    mask = outline & ~_notch_of_curved_probe(part, outline)
    return Region(_bounding_box(mask), mask)


def locate_image(scan: Scan, rectangle_px: tuple[int, int, int, int] | None = None) -> Scan:
    """Return the scan with its region: the file's own, or the one found.

    A rectangle, given or from the file, may hold a sector or still have a border: the image
    is looked for within it.

    Args:
        scan: What was recorded; a region with a mask stays as it is.
        rectangle_px: Where to look: ``(column, row, width, height)``.

    Raises:
        ScanError: If the rectangle does not fit the frames.
    """
    if rectangle_px is None and scan.region is not None:
        if scan.region.mask is not None:
            return scan
        rectangle_px = scan.region.rectangle_px
    if rectangle_px is None:
        return replace(scan, region=find_region(scan.frames))
    found = find_region(crop_scan(scan, rectangle_px).frames)
    column, row, width, height = found.rectangle_px
    left, top = rectangle_px[:2]
    mask = None
    if found.mask is not None:
        mask = np.zeros(scan.frames.shape[1:3], dtype=bool)
        mask[top : top + rectangle_px[3], left : left + rectangle_px[2]] = found.mask
    return replace(scan, region=Region((left + column, top + row, width, height), mask))


def _extremes(frames: Frames, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and highest value of each pixel over the sampled frames."""
    gray = FrameView(frames, gray=True)
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(samples, len(frames))).astype(int))
    lowest = highest = np.nan_to_num(np.asarray(gray[int(chosen[0])], dtype=np.float32))
    for index in chosen[1:]:
        frame = np.nan_to_num(np.asarray(gray[int(index)], dtype=np.float32))
        lowest, highest = np.minimum(lowest, frame), np.maximum(highest, frame)
    return lowest, highest


def _differs_from_border(
    lowest: Num[np.ndarray, "rows columns"], highest: Num[np.ndarray, "rows columns"]
) -> Bool[np.ndarray, "rows columns"] | None:
    """Say of each pixel whether it ever differs from the border; ``None`` without border."""
    contrast = IMAGE_CONTRAST * float(highest.max() - lowest.min())
    if contrast == 0:
        return None
    rim = np.concatenate((highest[0], highest[-1], highest[1:-1, 0], highest[1:-1, -1]))
    levels, counts = np.unique(np.round(rim / contrast), return_counts=True)
    border = float(levels[counts.argmax()]) * contrast
    differs = np.maximum(highest - border, border - lowest) > contrast
    rim_is_border = ~np.concatenate((differs[0], differs[-1], differs[1:-1, 0], differs[1:-1, -1]))
    return differs if rim_is_border.mean() >= LEAST_BORDER else None


def _clean(shown: np.ndarray) -> np.ndarray:
    """Bridge dark gaps, then drop thin lines and specks."""
    # Room for the image to grow into: otherwise a dark row at the rim would be a gap to bridge.
    grown = ndimage.maximum_filter(np.pad(shown, BRIDGED_PX), BRIDGED_PX)
    closed = ndimage.minimum_filter(grown, BRIDGED_PX)[
        BRIDGED_PX:-BRIDGED_PX, BRIDGED_PX:-BRIDGED_PX
    ]
    return ndimage.maximum_filter(ndimage.minimum_filter(closed, DROPPED_PX), DROPPED_PX)


def _most_changing_part(shown: np.ndarray, change: np.ndarray) -> np.ndarray | None:
    """Return the connected part with most pixels that change, without holes."""
    labels, count = ndimage.label(shown)
    if count == 0:
        return None
    changing = change > IMAGE_CONTRAST * float(change.max())
    if not changing.any():  # a single frame
        changing = shown
    sizes = np.bincount(labels[changing], minlength=count + 1)
    sizes[0] = 0
    if sizes.max() == 0:
        return None
    return ndimage.binary_fill_holes(labels == sizes.argmax())


def _convex_outline(part: np.ndarray) -> np.ndarray:
    """Return the pixels within the convex hull of a part."""
    rows = np.flatnonzero(part.any(axis=1))
    first = part[rows].argmax(axis=1)
    last = part.shape[1] - 1 - part[rows, ::-1].argmax(axis=1)
    # Corners of the pixels, not centres: a part one pixel wide has a hull, too.
    x = np.concatenate((first - 0.5, first - 0.5, last + 0.5, last + 0.5))
    y = np.concatenate((rows - 0.5, rows + 0.5, rows - 0.5, rows + 0.5))
    hull = ConvexHull(np.stack((x, y), axis=-1))
    grid_x, grid_y = np.arange(part.shape[1]), np.arange(part.shape[0])[:, None]
    inside = np.ones(part.shape, dtype=bool)
    for normal_x, normal_y, offset in hull.equations:
        inside &= normal_x * grid_x + normal_y * grid_y + offset <= 0
    return inside


def _notch_of_curved_probe(part: np.ndarray, outline: np.ndarray) -> np.ndarray:
    """Return the pixels of the outline between a curved probe's ends and its surface.

    The outline is straight from one end of the probe to the other, where the image is not.
    Of all places above the part's first row the largest is taken, if it is deeper than the
    gaps that are bridged; the others are teeth of a slanting edge.
    """
    first = np.where(part.any(axis=0), part.argmax(axis=0), 0)
    above = outline & (np.arange(part.shape[0])[:, None] < first)
    labels, count = ndimage.label(above)
    if count == 0:
        return above
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    notch = labels == sizes.argmax()
    return notch if notch.sum(axis=0).max() > BRIDGED_PX else np.zeros_like(notch)


def _bounding_box(mask: np.ndarray) -> tuple[int, int, int, int]:
    """Return (column, row, width, height) of the smallest rectangle that holds a mask."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    left, top = int(columns[0]), int(rows[0])
    return left, top, int(columns[-1]) - left + 1, int(rows[-1]) - top + 1
