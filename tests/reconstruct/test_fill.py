"""Filling holes: only near what was seen, and closed ones first."""

import numpy as np
import pytest

from sonosweep.errors import ScanError
from sonosweep.reconstruct.fill import fill_holes
from sonosweep.scan import Volume, VolumeGrid


def slabs(gap, dtype=np.uint8, spacing=(1.0, 1.0, 1.0)):
    """Return a volume with two seen planes of 10 and 50, ``gap`` unseen ones between."""
    size = (5, 4, gap + 8)
    voxels, coverage = np.zeros(size[::-1], dtype), np.zeros(size[::-1], np.uint8)
    voxels[3], voxels[4 + gap] = 10, 50
    coverage[3] = coverage[4 + gap] = 1
    return Volume(voxels, VolumeGrid(size, spacing), coverage)


def test_sticks_are_linear_between_their_ends():
    """Three missing planes between 10 and 50 become 20, 30 and 40; the outside stays empty."""
    volume = slabs(gap=3)

    filled = fill_holes(volume, "stick", widest_mm=4.0)

    assert filled.voxels[:, 2, 2].tolist() == [0, 0, 0, 10, 20, 30, 40, 50, 0, 0, 0]
    assert np.array_equal(filled.coverage, volume.coverage)
    assert not volume.voxels[4].any()


@pytest.mark.parametrize("method", ["stick", "nearest", "inverse_distance"])
def test_wide_holes_stay(method):
    """A hole wider than the limit keeps an empty middle."""
    filled = fill_holes(slabs(gap=9), method, widest_mm=4.0)

    assert filled.voxels[8, 2, 2] == 0


def test_the_limit_is_in_millimetres():
    """The same gap in voxels is filled or not with the size of the voxels."""
    fine, coarse = slabs(3, spacing=(0.5,) * 3), slabs(3, spacing=(2.0,) * 3)

    assert fill_holes(fine, "stick", widest_mm=4.0).voxels[5, 2, 2] == 30
    assert fill_holes(coarse, "stick", widest_mm=4.0).voxels[5, 2, 2] == 0


def test_nearest_and_inverse_distance():
    """One plane beside 10 and two from 50: nearest takes 10, the mean leans towards it."""
    nearest = fill_holes(slabs(gap=2), "nearest", widest_mm=4.0)
    mean = fill_holes(slabs(gap=2, dtype=np.float32), "inverse_distance", widest_mm=4.0)

    assert nearest.voxels[:, 2, 2].tolist() == [0, 10, 10, 10, 10, 50, 50, 50, 50, 0]
    assert 10 < mean.voxels[4, 2, 2] < 30 < mean.voxels[5, 2, 2] < 50


@pytest.mark.parametrize("method", ["stick", "nearest", "inverse_distance"])
def test_threads_and_seen_voxels(method):
    """Seen voxels keep their values, and threads change nothing."""
    random = np.random.default_rng(2)
    coverage = (random.random((40, 30, 35)) < 0.1).astype(np.uint8)
    voxels = random.integers(0, 256, coverage.shape, dtype=np.uint8) * coverage
    volume = Volume(voxels, VolumeGrid((35, 30, 40), (0.3, 0.4, 0.5)), coverage)

    one, three = (fill_holes(volume, method, threads=n) for n in (1, 3))

    assert np.array_equal(one.voxels, three.voxels)
    assert np.array_equal(one.voxels[coverage > 0], voxels[coverage > 0])
    assert (one.voxels[5:-5, 5:-5, 5:-5] > 0).mean() > 0.9  # sticks need two ends


def test_what_cannot_be_filled_is_refused():
    """A width of nothing, an absurd one, and a volume that does not know what it saw."""
    volume = slabs(3)

    for width in (0.0, -1.0, float("nan"), 1e6):
        with pytest.raises(ScanError, match="give a width above 0"):
            fill_holes(volume, widest_mm=width)
    with pytest.raises(ScanError, match="with coverage"):
        fill_holes(Volume(volume.voxels, volume.grid), "stick")
