"""Cropping and resampling keep every point of the body where it is."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

from sonosweep.errors import ScanError
from sonosweep.scan import (
    Calibration,
    Companion,
    Region,
    Scan,
    crop_scan,
    crop_scan_center,
    pixel_to_image,
    resample_scan,
)

from ..strategies import scans

ROUND_OFF_MM = 1e-9  # float64 on coordinates below 1 m


def place(scan, column, row):
    """Where a pixel is in the reference, for each frame."""
    pixel = torch.tensor([column, row, 0.0, 1.0], dtype=torch.float64)
    return scan.image_to_reference @ pixel_to_image(scan.calibration) @ pixel


@given(scans(), st.integers(0, 4), st.integers(0, 5))
def test_a_cropped_pixel_stays_where_it_was(scan, column, row):
    """Pixel (0, 0) of the crop is the pixel at its corner: same gray level, same place."""
    cropped = crop_scan(scan, (column, row, 6, 8))

    assert cropped.frames.shape == (5, 8, 6)
    assert np.array_equal(
        cropped.frames[2], np.asarray(scan.frames)[2, row : row + 8, column : column + 6]
    )
    assert_close(place(cropped, 0, 0), place(scan, column, row), atol=ROUND_OFF_MM, rtol=0)
    assert_close(place(cropped, 3, 5), place(scan, column + 3, row + 5), atol=ROUND_OFF_MM, rtol=0)


@given(scans(rows=16, columns=12), st.integers(1, 30), st.integers(1, 30))
def test_resampling_keeps_the_outer_edges(scan, width, height):
    """The corners of the field of view, half a pixel outside the centres, do not move."""
    resized = resample_scan(scan, width, height)

    assert resized.frames[:].shape == (5, height, width)
    assert_close(place(resized, -0.5, -0.5), place(scan, -0.5, -0.5), atol=ROUND_OFF_MM, rtol=0)
    assert_close(
        place(resized, width - 0.5, height - 0.5),
        place(scan, 11.5, 15.5),
        atol=ROUND_OFF_MM,
        rtol=0,
    )


def test_resampling_worked_example():
    """Halving 4 x 4 pixels of 0.1 mm: means of four, 0.2 mm apart."""
    frame = np.arange(16, dtype=np.uint8).reshape(1, 4, 4) * 2
    scan = Scan("x", frame, Calibration(spacing_mm=(0.1, 0.1)))

    resized = resample_scan(scan, 2, 2)

    assert resized.frames[0].tolist() == [[5, 9], [21, 25]]
    assert resized.calibration.spacing_mm == pytest.approx((0.2, 0.2))


def test_enlarging_keeps_a_ramp_a_ramp():
    """Pixels between pixels are between them, at the places that the calibration says."""
    ramp = np.arange(0, 200, 10, dtype=np.float32)
    frames = np.broadcast_to(ramp, (1, 12, 20)).copy()
    scan = Scan("x", frames, Calibration(spacing_mm=(0.3, 0.3)))

    large = resample_scan(scan, 32, 6)

    column_mm = np.arange(32) * large.calibration.spacing_mm[0]
    first_mm = (large.calibration.spacing_mm[0] - 0.3) / 2
    expected = 10 / 0.3 * (column_mm + first_mm)
    inside = slice(1, -1)  # beyond the outermost centres there is nothing to interpolate
    assert large.frames[0][2, inside] == pytest.approx(expected[inside], abs=1e-3)


def test_the_papers_crop_and_size():
    """480 x 640 frames become the central 320 x 320, then 256 x 256 at 1.25 times the pixel."""
    frames = np.zeros((1, 480, 640), np.uint8)
    frames[0, 80:400, 160:480] = 9
    scan = Scan("x", frames, Calibration(spacing_mm=(0.2, 0.3)), region=Region((0, 0, 640, 480)))

    small = resample_scan(crop_scan_center(scan), 256, 256)

    assert (small.frames[0] == 9).all()
    assert small.calibration.spacing_mm == pytest.approx((0.25, 0.375))
    assert small.region.rectangle_px == (0, 0, 256, 256)


@pytest.mark.parametrize(
    ("rectangle", "left"),
    [((10, 10, 150, 80), (10, 20, 50, 40)), ((40, 50, 100, 50), (0, 0, 30, 20))],
)
def test_a_crop_does_not_make_the_region_larger(rectangle, left):
    """What lay outside the region and is kept still lies outside it."""
    mask = np.zeros((100, 200), bool)
    mask[30:70, 20:70] = True
    scan = Scan("x", np.zeros((1, 100, 200), np.uint8), region=Region((20, 30, 50, 40), mask))

    region = crop_scan(scan, rectangle).region

    assert region.rectangle_px == left
    column, row, width, height = left
    inside = np.zeros(rectangle[:1:-1], bool)
    inside[row : row + height, column : column + width] = True
    assert np.array_equal(region.mask, inside)


def test_a_crop_beside_the_region_has_none():
    """Nothing is known of where the image is in a crop of the border."""
    scan = Scan("x", np.zeros((1, 9, 9), np.uint8), region=Region((0, 0, 4, 4)))

    assert crop_scan(scan, (4, 0, 5, 9)).region is None


@given(st.integers(0, 11), st.integers(0, 15), st.integers(1, 30), st.integers(1, 30))
def test_a_resized_region_stays_within_the_frame(column, row, width, height):
    """However small the frame becomes, the region keeps a pixel of it."""
    region = Region((column, row, 12 - column, 16 - row))
    scan = Scan("x", np.zeros((1, 16, 12), np.uint8), region=region)

    x, y, w, h = resample_scan(scan, width, height).region.rectangle_px

    assert 0 <= x < x + w <= width
    assert 0 <= y < y + h <= height


def test_companions_follow_the_image_origin():
    """A companion's place in the image changes by what was cut off."""
    frames = np.zeros((1, 8, 8), np.uint8)
    scan = Scan(
        "x",
        frames,
        Calibration(spacing_mm=(0.5, 0.5)),
        companions={"photoacoustic": Companion(frames, (1.0, 1.0), (2.0, 3.0))},
    )

    cropped = crop_scan(scan, (2, 4, 4, 4))

    assert cropped.companions["photoacoustic"].origin_mm == (1.0, 1.0)


@pytest.mark.parametrize("rectangle", [(0, 0, 9, 4), (-1, 0, 2, 2), (0, 7, 2, 2), (0, 0, 0, 1)])
def test_a_crop_must_fit(rectangle):
    """Rectangles outside the frame and empty ones are refused."""
    with pytest.raises(ScanError, match="does not fit a frame of 8 x 8"):
        crop_scan(Scan("x", np.zeros((1, 8, 8), np.uint8)), rectangle)
