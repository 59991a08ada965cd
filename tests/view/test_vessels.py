"""Pictures of vessels show where they are, and nothing but them."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from PIL import Image

from sonosweep.errors import FormatError
from sonosweep.scan import Volume, VolumeGrid
from sonosweep.view import write_vessel_picture
from sonosweep.view.render import render_volume
from sonosweep.view.vessels import (
    depth_color,
    depth_map,
    shown_name,
    vessel_axes,
    vessel_pictures,
)

from .conftest import straight

SIZE = (30, 24, 60)
GRID = VolumeGrid(SIZE, (0.5, 0.5, 0.5), (0.0, 0.0, 0.0))
NEAR, FAR = 6, 17  # depth of two vessels, in voxels
COLOR = 12.0  # of 255: interpolation between pixels


def two_vessels(noise: float = 0.0, vessel: int = 200) -> Volume:
    """Return two vessels along z, at the left near and at the right far, in noise."""
    random = np.random.default_rng(4)
    voxels = random.uniform(0, noise, SIZE[::-1]) if noise else np.zeros(SIZE[::-1])
    voxels[:, NEAR - 1 : NEAR + 2, 7:10] = vessel
    voxels[:, FAR - 1 : FAR + 2, 20:23] = vessel
    return Volume(voxels.astype(np.uint8), GRID, np.ones(SIZE[::-1], np.uint8))


@pytest.mark.parametrize("noise", [0.0, 60.0])
def test_colors_span_the_depths_of_vessels(noise):
    """The near vessel is yellow, the far one blue, and the bar says how deep they are."""
    mapped = depth_map(two_vessels(noise))

    assert (mapped.picture.right, mapped.picture.down) == ("z", "x")  # the longer to the right
    # Of the voxels' middles; the maximum of a vessel is found in its nearest voxel.
    assert_allclose(mapped.span_mm, (0.5 * (NEAR - 0.5), 0.5 * (FAR - 0.5)), atol=1e-9)
    scale = mapped.picture.pixels.shape[0] / SIZE[0]
    near, far = (mapped.picture.pixels[int((x + 0.5) * scale), 30] for x in (8, 21))
    ends = depth_color(np.array([0.0, 1.0]))
    assert_allclose(near, ends[0], atol=COLOR)
    assert_allclose(far, ends[1], atol=COLOR)


def test_noise_is_dark():
    """What nine tenths of the voxels are darker than is black: noise does not hide vessels."""
    mapped = depth_map(two_vessels(60.0))

    middle = mapped.picture.pixels[int(15 * mapped.picture.pixels.shape[0] / SIZE[0])]
    assert middle.max() < 50
    assert 50 < mapped.window[0] < 60
    assert mapped.window[1] == 200


@pytest.mark.parametrize(
    ("names", "axes"),
    [
        (("lateral", "axial", "elevational"), (1, 2)),
        (("elevational", "lateral", "axial"), (2, 0)),
        (("x", "y", "z"), (1, 2)),
        (("x", "elevational", "z"), (2, 1)),
        (("x", "y", "axial"), (2, 0)),
    ],
)
def test_depth_and_sweep_are_two_axes(names, axes):
    """Depth and the direction of the sweep are found by name, and are never the same axis."""
    assert vessel_axes(names) == axes


def test_vessels_are_seen_through_tissue():
    """Rays show the brightest voxel, though tissue before it is opaque to the other view."""
    voxels = np.full(SIZE[::-1], 120, np.uint8)
    voxels[28:32, 10:14, 13:17] = 255
    volume = Volume(voxels, GRID)

    through, _ = render_volume(volume, pixels=80, window=(0.0, 255.0), brightest=True)

    rows, columns = np.nonzero(through > 0.9 * through.max())
    middle = np.array(through.shape) / 2
    assert_allclose([rows.mean(), columns.mean()], middle, atol=6)


def test_pictures_fit_each_other():
    """The cross-section, the vessels over it and the line in the map belong to one place."""
    tissue = Volume(np.full(SIZE[::-1], 90, np.uint8), GRID)
    made = vessel_pictures(two_vessels(), tissue, np.eye(4), (1, 2), (15, 12, 40), 120)

    assert made.section_mm == 0.5 * 40.5
    assert not made.section_down  # the sweep runs to the right in the map
    assert made.cross_section.pixels.shape == made.overlaid.pixels.shape[:2]
    row, column = np.array([NEAR, 8]) * made.overlaid.pixels.shape[1] // SIZE[0]
    assert made.overlaid.pixels[row, column, 0] > 200
    gray = made.overlaid.pixels[:4, :4]
    assert (gray == gray[0, 0, 0]).all()
    reds = made.over_b_mode.pixels.astype(int)
    assert (reds[..., 0] - reds[..., 2]).max() > 150


def test_a_volume_on_another_grid_is_not_laid_over():
    """Without a B-mode of the same voxels there are the map and the maximum alone."""
    other = Volume(np.ones((4, 4, 4), np.uint8), VolumeGrid((4, 4, 4), (1.0, 1.0, 1.0)))
    for b_mode in (None, other):
        made = vessel_pictures(two_vessels(), b_mode, np.eye(4), (1, 2), (15, 12, 40), 60)
        assert made.over_b_mode is made.cross_section is made.overlaid is None


def test_names_are_those_of_the_field():
    """A report says Power Doppler, not power_doppler."""
    assert shown_name("power_doppler") == "Power Doppler"
    assert shown_name("photoacoustic_750nm") == "Photoacoustic 750nm"


def test_the_picture_is_a_file(tmp_path):
    """One PNG holds the vessels in colour; a place that cannot be written is said."""
    tissue = Volume(np.full(SIZE[::-1], 90, np.uint8), GRID, np.ones(SIZE[::-1], np.uint8))
    path = tmp_path / "vessels.png"

    write_vessel_picture(path, two_vessels(), tissue, straight(0.5), "power_doppler")

    pixels = np.asarray(Image.open(path)).astype(int)
    assert pixels.shape[1] == 1600
    yellow = (pixels[..., 0] > 200) & (pixels[..., 1] > 150) & (pixels[..., 2] < 140)
    assert yellow.sum() > 1000
    below_a_file = path / "vessels.png"
    with pytest.raises(FormatError):
        write_vessel_picture(below_a_file, two_vessels(), tissue, straight(0.5), "power_doppler")
