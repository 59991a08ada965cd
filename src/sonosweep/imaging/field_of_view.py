"""Where the pixels of a sweep lie, if nobody says."""

import math

import numpy as np

from sonosweep.errors import ScanError
from sonosweep.imaging.aperture import array_shape
from sonosweep.imaging.pixel_grid import PixelGrid, centered_grid
from sonosweep.scan import ChannelData, Probe

COLUMNS = 256
FIRST_DEPTH_MM = 0.5
RING_PART = 0.6
"""Width of the image over the radius of an array that surrounds the body."""
MOST_PIXELS = 1 << 26


def field_of_view(
    data: ChannelData,
    columns: int | None = None,
    rows: int | None = None,
    pixel_mm: float | None = None,
    depth_mm: float | None = None,
) -> PixelGrid:
    """Return a grid of square pixels that suits an array and its recordings.

    In front of a linear or curved array the image is as wide as the array and as deep as it
    is wide, but not deeper than recorded. Within an array that surrounds the body by more
    than half it is a square in the middle, as large as ``depth_mm`` says.

    Args:
        data: Probe, sampling and sound speed; the samples themselves are not read.
        columns: Pixels across; 256 unless something else follows from the rest.
        rows: Pixels in depth.
        pixel_mm: Distance between pixels.
        depth_mm: How deep the image ends; before an array that surrounds the body, how far
            from its middle.

    Raises:
        ScanError: If a number is not positive, they contradict each other, or there would be
            too many pixels.
    """
    _check(columns, rows, pixel_mm, depth_mm)
    surrounding = surrounding_radius_mm(data.probe)
    lateral = data.probe.element_positions_mm[:, 0].numpy()
    width = float(np.ptp(lateral)) * len(lateral) / max(len(lateral) - 1, 1)
    if surrounding is not None:
        width = 2 * depth_mm if depth_mm else RING_PART * surrounding
    if width == 0:
        raise ScanError(
            f"the elements of probe '{data.probe.name}' lie at one place: say how wide the image"
            " is (--columns and --pixel-mm)"
        )
    if surrounding is None:
        height = (depth_mm or min(width, recorded_depth_mm(data))) - FIRST_DEPTH_MM
    else:
        height = width
    if height <= 0:
        raise ScanError(_no_depth(data, width, depth_mm))
    spacing = pixel_mm or width / (columns or COLUMNS)
    if rows is not None and depth_mm is not None:
        spacing = height / rows
    across, down = columns or round(width / spacing), rows or round(height / spacing)
    if across * down > MOST_PIXELS:
        raise ScanError(f"an image of {across} x {down} pixels is too large: use larger pixels")
    first = FIRST_DEPTH_MM if surrounding is None else -spacing * (down - 1) / 2
    return centered_grid(max(across, 1), max(down, 1), (float(spacing), float(spacing)), first)


def _no_depth(data: ChannelData, width_mm: float, depth_mm: float | None) -> str:
    begin = f"the image begins {FIRST_DEPTH_MM:g} mm deep and must end below that"
    if depth_mm is not None:
        return f"{begin}, not at {depth_mm:g} mm"
    return (
        f"{begin}, but the array is {width_mm:.4g} mm wide and the recording"
        f" {recorded_depth_mm(data):.4g} mm deep: check the positions of the elements, the sampling"
        " frequency and the sound speed"
    )


def recorded_depth_mm(data: ChannelData) -> float:
    """Return the depth from which the last sample of a straight echo or wave comes."""
    start_s = 0.0 if data.start_time_s is None else float(data.start_time_s.min())
    end_s = start_s + data.samples.shape[3] / data.sampling_frequency_hz
    ways = 1 if data.transmit_delays_s is None else 2
    return end_s * data.sound_speed_m_per_s * 1e3 / ways


def surrounding_radius_mm(probe: Probe) -> float | None:
    """Return the radius of an array that surrounds the body by more than half, or ``None``."""
    shape = array_shape(probe)
    if shape is None or shape.is_line:
        return None
    if math.hypot(*shape.normals.mean(axis=0)) >= 2 / math.pi:
        return None
    return float(np.linalg.norm(shape.elements_mm[:, :2], axis=1).mean())


def _check(
    columns: int | None, rows: int | None, pixel_mm: float | None, depth_mm: float | None
) -> None:
    numbers = {"columns": columns, "rows": rows, "pixel size": pixel_mm, "depth": depth_mm}
    for what, value in numbers.items():
        if value is not None and not (math.isfinite(value) and value > 0):
            raise ScanError(f"the {what} of an image must be above 0, got {value:g}")
    if None not in (rows, depth_mm) and (pixel_mm is not None or columns is not None):
        raise ScanError(
            "the depth of an image follows from its rows and the size of its pixels: give only one"
            " of --rows and --depth-mm"
        )
