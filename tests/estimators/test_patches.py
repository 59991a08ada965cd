"""Where patches are."""

import numpy as np
import pytest

from sonosweep.errors import ScanError
from sonosweep.estimators.patches import INSIDE, patch_grid
from sonosweep.scan import Calibration, Region, Scan


def blank(rows: int, columns: int, region: Region | None = None) -> Scan:
    """Return a scan of two empty frames with unequal spacing."""
    frames = np.zeros((2, rows, columns), np.uint8)
    return Scan("blank", frames, Calibration(spacing_mm=(0.2, 0.1)), region=region)


def test_patches_cover_the_frame_evenly():
    """The middle of all patches is the middle of the image, in millimeters."""
    grid = patch_grid(blank(256, 256))

    np.testing.assert_allclose(grid.middle_mm, [127.5 * 0.2, 127.5 * 0.1], atol=0.11)
    assert grid.side_px == 32
    assert len(grid.corners_px) == 225
    assert 3 < grid.redundancy < 4


def test_a_sector_has_no_patch_outside():
    """Patches lie where the mask holds image, but for a twentieth of their pixels."""
    rows, columns = np.mgrid[:200, :240]
    mask = np.abs(columns - 120) < 20 + rows / 2
    grid = patch_grid(blank(200, 240, Region((0, 0, 240, 200), mask)))

    for row, column in grid.corners_px:
        patch = mask[row : row + grid.side_px, column : column + grid.side_px]
        assert patch.mean() >= INSIDE


def test_a_region_moves_the_patches_with_it():
    """Patch centers are in the coordinates of the whole frame, not of the region."""
    whole = patch_grid(blank(128, 128))
    framed = patch_grid(blank(160, 300, Region((100, 20, 128, 128))))

    np.testing.assert_allclose(framed.centers_mm - whole.centers_mm, [[20.0, 2.0]] * 81)


@pytest.mark.parametrize(
    ("scan", "message"),
    [
        (blank(20, 300), "20 pixels; motion needs"),
        (blank(100, 100, Region((90, 90, 50, 50))), "10 x 10 pixels"),
        (blank(100, 100, Region((200, 0, 5, 5))), "outside its 100 x 100 frame"),
        (blank(100, 100, Region((0, 0, 100, 100), np.ones((50, 60), bool))), "mask is 60 x 50"),
        (
            blank(100, 100, Region((0, 0, 100, 100), np.zeros((100, 100), bool))),
            "holds no .* pixels of image",
        ),
    ],
)
def test_too_small_images_are_refused(scan, message):
    """An image of a few patches tells no motion."""
    with pytest.raises(ScanError, match=message):
        patch_grid(scan)
