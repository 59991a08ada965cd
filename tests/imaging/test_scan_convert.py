"""Scan conversion puts each sample where it was."""

import numpy as np
import pytest
from scipy import ndimage

from sonosweep.errors import ScanError
from sonosweep.imaging import SectorGrid, centered_grid
from sonosweep.imaging.scan_convert import (
    prepare_inverse_scan_converter,
    prepare_scan_converter,
    sector_image_grid,
)

CONVEX = SectorGrid(128, 400, 0.008, 0.2, 2.0, 60.0)
FLOAT32 = 1e-5  # of the largest value: fractions have 24 bits


def places(grid):
    """Return lateral and axial mm of each pixel."""
    return np.meshgrid(grid.lateral_mm, grid.axial_mm)


def depth_and_angle(grid, sector):
    """Return depth below the face and angle of each pixel."""
    lateral, axial = places(grid)
    reach = np.hypot(lateral, axial + sector.radius_mm)
    return reach - sector.radius_mm, np.arctan2(lateral, axial + sector.radius_mm)


def test_lines_fan_out():
    """What is linear in depth and angle is so in the image, to rounding."""
    depth, angle = np.meshgrid(CONVEX.depths_mm, CONVEX.angles_rad, indexing="ij")
    grid = sector_image_grid(CONVEX, 320, 240)
    converter = prepare_scan_converter(CONVEX, grid)
    true_depth, true_angle = depth_and_angle(grid, CONVEX)

    image = converter.apply(depth + 100 * angle)

    error = np.abs(image - true_depth - 100 * true_angle)[converter.inside]
    assert error.max() < FLOAT32 * depth.max()
    assert not image[~converter.inside].any()


def test_the_sector_just_fits_its_image():
    """The first and last depth and angle touch the rim, and all of the sector is inside."""
    grid = sector_image_grid(CONVEX, 640, 480)
    depth, angle = depth_and_angle(grid, CONVEX)
    inside = prepare_scan_converter(CONVEX, grid).inside

    expected = (depth >= CONVEX.depths_mm[0]) & (depth <= CONVEX.depths_mm[-1])
    expected &= np.abs(angle) <= CONVEX.angles_rad[-1]
    assert np.array_equal(inside, expected)
    touched = [inside[:, :2].any(), inside[:, -2:].any(), inside[:2].any(), inside[-2:].any()]
    assert sum(touched) >= 2, "neither the width nor the height is used"


def test_interpolation_is_bilinear():
    """The same as SciPy's linear interpolation of the same samples."""
    frames = np.random.default_rng(2).random((3, CONVEX.samples, CONVEX.lines))
    grid = centered_grid(90, 80, (0.7, 0.9), 1.0)
    depth, angle = depth_and_angle(grid, CONVEX)
    place = [
        (depth - CONVEX.first_depth_mm) / CONVEX.sample_spacing_mm,
        angle / CONVEX.line_spacing_rad + (CONVEX.lines - 1) / 2,
    ]
    converter = prepare_scan_converter(CONVEX, grid)

    images = converter.apply(frames)

    for image, frame in zip(images, frames, strict=True):
        expected = ndimage.map_coordinates(frame, place, order=1)
        assert np.abs(image - expected)[converter.inside].max() < FLOAT32


def test_gray_levels_are_rounded():
    """8-bit frames give the nearest gray level of the same interpolation."""
    gray = np.random.default_rng(4).integers(0, 256, (CONVEX.samples, CONVEX.lines), dtype=np.uint8)
    converter = prepare_scan_converter(CONVEX, sector_image_grid(CONVEX, 64, 48))

    image = converter.apply(gray)

    assert image.dtype == np.uint8
    assert np.abs(image - converter.apply(gray.astype(np.float64))).max() < 0.501


def test_back_and_forth():
    """A smooth image comes back from sector samples within 1 % where there are some."""
    grid = sector_image_grid(CONVEX, 640, 480)
    lateral, axial = places(grid)
    image = 2 + np.sin(lateral / 6) * np.cos(axial / 5)
    sector_frame = prepare_inverse_scan_converter(grid, CONVEX).apply(image)
    converter = prepare_scan_converter(CONVEX, grid)

    again = converter.apply(sector_frame)

    inner = ndimage.binary_erosion(converter.inside, iterations=3)
    assert np.abs(again - image)[inner].max() < 0.03


def test_frames_of_another_sector_are_refused():
    """A frame with its axes swapped would be garbage."""
    converter = prepare_scan_converter(CONVEX, sector_image_grid(CONVEX, 64, 48))

    with pytest.raises(ScanError, match="prepared for 400 x 128 samples"):
        converter.apply(np.zeros((128, 400)))


def test_one_line_is_no_sector():
    """Between fewer than two lines nothing can be interpolated."""
    with pytest.raises(ScanError, match="at least 2 x 2 samples, got 400 x 1"):
        prepare_scan_converter(
            SectorGrid(1, 400, 0.008, 0.2, 2.0, 60.0), centered_grid(4, 4, (1.0, 1.0))
        )
