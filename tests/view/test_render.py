"""Renderings and thinned volumes keep things where they are."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from sonosweep.scan import Volume, VolumeGrid
from sonosweep.view.camera import project, view_rotation
from sonosweep.view.render import render_volume
from sonosweep.view.resample import resample_volume

from ..strategies import poses
from .conftest import GRID, ball

ROUND_OFF = 1e-4  # relative, float32 sums of a few thousand voxels
SPLIT_VOXEL = 0.25  # a voxel cut in two counts at its own centre: 1/8 of it at either edge
ONE_VOXEL_MM = 1.0


@given(st.integers(1, 24_000))
def test_thinning_keeps_the_mean(max_voxels):
    """A volume of fewer voxels is no brighter and no larger."""
    volume = Volume(ball((9.0, 5.5, 6.5)), GRID)

    small = resample_volume(volume, max_voxels)

    assert small.voxels.size <= max_voxels
    assert_allclose(small.voxels.mean(), volume.voxels.mean(), rtol=ROUND_OFF)
    extent = np.multiply(small.grid.size, small.grid.spacing_mm)
    assert_allclose(extent, np.multiply(GRID.size, GRID.spacing_mm))


@given(st.integers(1, 24_000), st.sampled_from([0, 1, 2]))
def test_thinning_keeps_the_place(max_voxels, axis):
    """Voxels that hold their own coordinate in mm still do after thinning."""
    index = np.indices(GRID.size[::-1])[2 - axis]
    volume = Volume(GRID.origin_mm[axis] + index * GRID.spacing_mm[axis], GRID)

    small = resample_volume(volume, max_voxels)

    index = np.indices(small.grid.size[::-1])[2 - axis]
    expected = small.grid.origin_mm[axis] + index * small.grid.spacing_mm[axis]
    assert_allclose(small.voxels, expected, atol=SPLIT_VOXEL * GRID.spacing_mm[axis])


def test_the_finer_axis_is_thinned_first():
    """Voxels that are finer along one axis become cubes before any axis else loses."""
    volume = Volume(np.ones((10, 10, 100), np.uint8), VolumeGrid((100, 10, 10), (0.1, 1.0, 1.0)))

    assert resample_volume(volume, 1000).grid.size == (10, 10, 10)


@given(poses(largest_mm=50.0))
def test_a_rendered_ball_is_where_projection_puts_it(reference_to_view):
    """Seen from anywhere, the bright ball covers the place where its centre projects to."""
    center = (9.0, 5.5, 6.5)
    volume = Volume(np.where(ball(center) > 100, 255, 0).astype(np.uint8), GRID)

    picture, bounds = render_volume(
        volume, reference_to_view.numpy(), pixels=120, window=(0.0, 255.0)
    )

    rows, columns = np.nonzero(picture > 40)
    edge = (bounds[2] - bounds[0]) / picture.shape[1]
    found = [bounds[0] + (columns.mean() + 0.5) * edge, bounds[1] + (rows.mean() + 0.5) * edge]
    in_view = (reference_to_view.numpy() @ [*center, 1.0])[:3]
    assert_allclose(found, project(in_view, view_rotation())[:2], atol=ONE_VOXEL_MM)


@pytest.mark.parametrize("size", [(1, 1, 1), (1, 9, 1), (5, 1, 7)])
def test_flat_volumes_can_be_rendered(size):
    """A volume of one voxel along an axis is a plane, a line or a point, and no error."""
    volume = Volume(np.full(size[::-1], 255, np.uint8), VolumeGrid(size, (1.0, 1.0, 1.0)))

    picture, bounds = render_volume(volume, pixels=32)

    assert max(picture.shape) <= 33
    assert np.isfinite(bounds).all()
