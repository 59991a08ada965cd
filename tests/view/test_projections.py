"""Pictures of volumes show the right voxels in the right shape."""

import io
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from PIL import Image

from sonosweep.errors import ScanError
from sonosweep.scan import Volume, VolumeGrid
from sonosweep.view.picture_frame import draw_picture
from sonosweep.view.projections import (
    MAX_PIXELS,
    Picture,
    best_covered,
    difference_cuts,
    display_window,
    encode_png,
    orthogonal_cuts,
    overlay,
    projections,
)
from sonosweep.view.vessels import depth_map

from .conftest import GRID, ball

ONE_PIXEL = 1


def marked(at: tuple[int, int, int], size=(12, 10, 8), spacing=(1.0, 1.0, 1.0)) -> Volume:
    """A volume of 1 with one voxel (x, y, z) of 255."""
    voxels = np.ones(size[::-1], np.uint8)
    voxels[at[::-1]] = 255
    return Volume(voxels, VolumeGrid(size, spacing))


@given(st.tuples(st.integers(0, 11), st.integers(0, 9), st.integers(0, 7)))
def test_each_cut_shows_the_voxel_it_goes_through(at):
    """In the cut named xy the marked voxel is at column x and row y, and so on."""
    cuts = orthogonal_cuts(marked(at), at, window=(0.0, 255.0))

    for cut in cuts:
        row, column = np.unravel_index(cut.pixels.argmax(), cut.pixels.shape)
        assert column == at["xyz".index(cut.right)]
        assert row == at["xyz".index(cut.down)]


@given(st.tuples(st.integers(0, 11), st.integers(0, 9), st.integers(0, 7)))
def test_a_maximum_finds_the_voxel_from_every_side(at):
    """A bright voxel is seen along all three axes, wherever it lies."""
    for picture in projections(marked(at), "maximum", window=(0.0, 255.0)):
        row, column = np.unravel_index(picture.pixels.argmax(), picture.pixels.shape)

        assert picture.pixels.max() == 255
        assert (column, row) == (at["xyz".index(picture.right)], at["xyz".index(picture.down)])


def test_a_mean_counts_only_what_was_seen():
    """Voxels of 0 are empty: the mean of 10 and 30 along an axis is 20 whatever surrounds them."""
    voxels = np.zeros((8, 4, 4), np.uint8)
    voxels[2], voxels[5] = 10, 30

    along_z = projections(
        Volume(voxels, VolumeGrid((4, 4, 8), (1.0, 1.0, 1.0))), "mean", (0.0, 255.0)
    )[0]

    assert (along_z.pixels == 20).all()


@given(st.tuples(*[st.floats(0.05, 5.0)] * 3))
def test_pictures_keep_the_shape_of_the_tissue(spacing_mm):
    """Width to height is that of the mm, however long and thin the voxels are."""
    volume = Volume(np.ones((20, 30, 40), np.uint8), VolumeGrid((40, 30, 20), spacing_mm))
    extent = dict(zip("xyz", np.multiply((40, 30, 20), spacing_mm), strict=True))

    for picture in (*orthogonal_cuts(volume), *projections(volume)):
        rows, columns = picture.pixels.shape

        assert max(rows, columns) <= MAX_PIXELS + ONE_PIXEL
        assert abs(columns * picture.mm_per_pixel - extent[picture.right]) <= picture.mm_per_pixel
        assert abs(rows * picture.mm_per_pixel - extent[picture.down]) <= picture.mm_per_pixel


def test_png_gives_the_pixels_back():
    """A PNG holds exactly the picture."""
    pixels = np.random.default_rng(0).integers(0, 256, (30, 50, 3), dtype=np.uint8)

    png = encode_png(Picture(pixels, 0.5, "x", "y"))

    assert (np.asarray(Image.open(io.BytesIO(png))) == pixels).all()


@given(st.integers(5, 700), st.integers(5, 700), st.floats(0.01, 3.0))
def test_a_scale_bar_is_as_long_as_it_says(columns, rows, mm_per_pixel):
    """The bar's length in the drawn picture is its label in mm times the picture's own scale."""
    picture = Picture(np.zeros((rows, columns), np.uint8), mm_per_pixel, "x", "y")

    root = ElementTree.fromstring(draw_picture(picture))

    tags = {child.tag.rsplit("}")[-1]: child for child in root}
    bar = next(c for c in root if c.get("class") == "scale-bar")
    label = next(c.text for c in root if (c.text or "").endswith(" mm"))
    units_per_mm = float(tags["image"].get("width")) / (columns * mm_per_pixel)
    assert_allclose(float(bar.get("width")), float(label[:-3]) * units_per_mm, atol=0.02, rtol=0.01)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_depth_is_yellow_near_and_blue_far(axis):
    """Of two equal bright voxels the nearer is yellow and the farther blue."""
    voxels = np.zeros((9, 9, 9), np.uint8)
    near, far = [2, 2, 2], [6, 6, 6]
    near[2 - axis], far[2 - axis] = 0, 8
    voxels[tuple(near)] = voxels[tuple(far)] = 200

    picture = depth_map(Volume(voxels, VolumeGrid((9, 9, 9), (1.0, 1.0, 1.0))), axis).picture

    red, green, blue = (int(value) for value in picture.pixels[2, 2])
    assert red > 200 < green > blue
    assert picture.pixels[6, 6, 2] > 200 > picture.pixels[6, 6, 0]


def test_equal_volumes_do_not_differ(tracked_volume):
    """The difference of a volume and itself is black; of a moved ball it is not."""
    moved = Volume(ball((12.0, 5.5, 6.5)), GRID)

    assert max(cut.pixels.max() for cut in difference_cuts(tracked_volume, tracked_volume)) == 0
    assert difference_cuts(tracked_volume, moved)[0].pixels.max() > 200


def test_volumes_on_different_grids_are_not_subtracted(tracked_volume):
    """A difference means something only voxel by voxel."""
    with pytest.raises(ScanError, match="same grid"):
        difference_cuts(tracked_volume, marked((0, 0, 0)))


def test_an_overlay_leaves_what_is_not_colored():
    """Where the companion is black the B-mode stays gray, elsewhere it turns warm."""
    base = Picture(np.full((4, 4), 100, np.uint8), 1.0, "x", "y")
    companion = np.zeros((4, 4), np.uint8)
    companion[0, 0] = 255

    mixed = overlay(base, Picture(companion, 1.0, "x", "y")).pixels

    assert (mixed[3, 3] == 100).all()
    assert mixed[0, 0, 0] > 200


def test_the_middle_is_where_something_was_seen():
    """Cuts go through the covered part, not through the middle of an empty box."""
    coverage = np.zeros((20, 20, 20), np.uint8)
    coverage[14:17, 2:5, 10:13] = 255
    grid = VolumeGrid((20, 20, 20), (1.0, 1.0, 1.0))

    assert best_covered(Volume(np.ones((20, 20, 20)), grid, coverage)) == (11, 3, 15)
    assert best_covered(Volume(np.zeros((20, 20, 20)), grid)) == (10, 10, 10)


@pytest.mark.parametrize(
    "voxels",
    [
        np.full((6, 5, 4), np.nan, np.float32),
        np.zeros((6, 5, 4), np.uint16),
        np.full((6, 5, 4), np.inf),
        np.ones((6, 5, 4), bool),
        np.full((6, 5, 4), -3.0),
        np.full((6, 5, 4, 3), 7, np.uint8),
        np.full((6, 5, 4), 1e30, np.float32),
    ],
)
def test_any_values_can_be_shown(voxels):
    """Nothing seen, nothing finite, colour, negative and huge values give a picture."""
    volume = Volume(voxels, VolumeGrid((4, 5, 6), (1.0, 1.0, 1.0)))

    low, high = display_window(volume)

    assert low < high
    for picture in (*orthogonal_cuts(volume), *projections(volume), *projections(volume, "mean")):
        assert picture.pixels.dtype == np.uint8
    assert depth_map(volume).picture.pixels.shape[2] == 3
