"""Where the image is in an ultrasound DICOM frame and how large its pixels are.

Ultrasound machines do not write Pixel Spacing. They list regions of the screen, each with
its kind and its physical size per pixel: Sequence of Ultrasound Regions, DICOM PS3.3
C.8.5.5.
"""

import math
from dataclasses import dataclass

from pydicom import Dataset

from sonosweep.scan import Scan

TWO_DIMENSIONAL, TISSUE, CENTIMETERS = 1, 1, 3
MM_PER_CM = 10.0


@dataclass(frozen=True)
class ImageRegion:
    """A rectangle of tissue on the screen.

    Attributes:
        rectangle_px: Column, row, width and height.
        spacing_mm: Size of a pixel along columns and along rows.
        note: What is odd about it; empty if nothing is.
    """

    rectangle_px: tuple[int, int, int, int]
    spacing_mm: tuple[float, float]
    note: str = ""


def read_regions(header: Dataset, rows: int, columns: int) -> tuple[ImageRegion | None, str]:
    """Return the largest two-dimensional tissue region in cm, and why there is none.

    Several regions are usual for two images side by side, and for a Doppler trace or a
    colour box beside the image. We never guess: a size that is not stated is not returned.
    """
    items = header.get("SequenceOfUltrasoundRegions") or []
    if not items:
        return None, "the file has no ultrasound regions, which state the size of a pixel"
    found = [region for item in items if (region := _tissue_region(item, rows, columns))]
    if not found:
        return None, f"none of the {len(items)} ultrasound regions is 2-D tissue measured in cm"
    return max(found, key=lambda region: region.rectangle_px[2] * region.rectangle_px[3]), ""


def _tissue_region(item: Dataset, rows: int, columns: int) -> ImageRegion | None:
    kind = (item.get("RegionSpatialFormat"), item.get("RegionDataType"))
    units = (item.get("PhysicalUnitsXDirection"), item.get("PhysicalUnitsYDirection"))
    if kind != (TWO_DIMENSIONAL, TISSUE) or units != (CENTIMETERS, CENTIMETERS):
        return None
    delta_x, delta_y = (float(item.get(f"PhysicalDelta{axis}") or 0) for axis in "XY")
    if not all(math.isfinite(delta) and delta != 0 for delta in (delta_x, delta_y)):
        return None
    left, top = int(item.RegionLocationMinX0), int(item.RegionLocationMinY0)
    # The last column and row belong to the region.
    right = min(int(item.RegionLocationMaxX1) + 1, columns)
    bottom = min(int(item.RegionLocationMaxY1) + 1, rows)
    if not (0 <= left < right and 0 <= top < bottom):
        return None
    note = ""
    if delta_x < 0 or delta_y < 0:
        note = (
            f"the file counts mm backwards ({delta_x:g}, {delta_y:g} cm per pixel): the image"
            " may be mirrored or upside down; its pixels are left as they are"
        )
    spacing = (abs(delta_x) * MM_PER_CM, abs(delta_y) * MM_PER_CM)
    return ImageRegion((left, top, right - left, bottom - top), spacing, note)


def make_regions(scan: Scan) -> list[Dataset]:
    """Return the regions that state a scan's pixel size; none if it is not known."""
    if scan.calibration is None:
        return []
    rows, columns = scan.frames.shape[1:3]
    rectangle = (0, 0, columns, rows) if scan.region is None else scan.region.rectangle_px
    column, row, width, height = rectangle
    item = Dataset()
    item.RegionSpatialFormat = TWO_DIMENSIONAL
    item.RegionDataType = TISSUE
    item.RegionFlags = 0
    item.RegionLocationMinX0, item.RegionLocationMinY0 = column, row
    item.RegionLocationMaxX1, item.RegionLocationMaxY1 = column + width - 1, row + height - 1
    item.PhysicalUnitsXDirection = item.PhysicalUnitsYDirection = CENTIMETERS
    item.PhysicalDeltaX, item.PhysicalDeltaY = (s / MM_PER_CM for s in scan.calibration.spacing_mm)
    return [item]
