"""How alike volumes are."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonosweep.errors import ScanError
from sonosweep.metrics import compare_volumes
from sonosweep.scan import Volume, VolumeGrid

ROUND_OFF = 1e-9


def random_volume(seed, size=(7, 6, 5), origin=(0.0, 0.0, 0.0), dtype=np.uint8):
    """A volume of random voxels, a third of them empty."""
    generator = np.random.default_rng(seed)
    voxels = generator.integers(1, 256, size[::-1]).astype(dtype)
    voxels[generator.random(voxels.shape) < 1 / 3] = 0
    return Volume(voxels, VolumeGrid(size, (0.5, 0.4, 0.3), origin))


@given(st.integers(0, 2**31), st.integers(0, 2**31))
def test_numbers_are_those_of_the_definition(seed_a, seed_b):
    """On one grid the numbers are NumPy's over the voxels that are not 0 in both."""
    a, b = random_volume(seed_a), random_volume(seed_b)

    found = compare_volumes(a, b)

    both = (a.voxels > 0) & (b.voxels > 0)
    x, y = a.voxels[both].astype(float), b.voxels[both].astype(float)
    assert found.common_voxels == both.sum()
    assert found.overlap == pytest.approx(
        2 * both.sum() / ((a.voxels > 0).sum() + (b.voxels > 0).sum())
    )
    assert found.mean_difference == pytest.approx((x - y).mean(), abs=ROUND_OFF)
    if seed_a != seed_b:
        assert found.correlation == pytest.approx(np.corrcoef(x, y)[0, 1], abs=ROUND_OFF)
        assert found.psnr_db == pytest.approx(10 * math.log10(255**2 / ((x - y) ** 2).mean()))


def test_a_volume_equals_itself():
    """Full overlap, full correlation, no noise to take a ratio with."""
    found = compare_volumes(random_volume(1), random_volume(1))

    assert found.overlap == pytest.approx(1)
    assert found.correlation == pytest.approx(1)
    assert found.psnr_db is None
    assert found.mean_difference == 0


def test_a_missing_slice_does_not_shift_the_rest():
    """A volume without its last slice is compared over the common corner."""
    whole = random_volume(2)
    part = Volume(whole.voxels[:-1], VolumeGrid((7, 6, 4), whole.grid.spacing_mm))

    found = compare_volumes(whole, part)

    assert found.correlation == pytest.approx(1)
    assert found.common_voxels == (part.voxels > 0).sum()
    assert found.overlap < 1


def test_place_and_not_index_is_compared():
    """A grid that starts two voxels later holds the same place under another index."""
    whole = random_volume(3)
    later = Volume(whole.voxels[:, :, 2:], VolumeGrid((5, 6, 5), (0.5, 0.4, 0.3), (1.0, 0.0, 0.0)))

    assert compare_volumes(whole, later).correlation == pytest.approx(1)
    assert compare_volumes(later, whole).correlation == pytest.approx(1)


def test_axes_may_point_elsewhere():
    """The same voxels stored along turned axes are the same volume."""
    whole = random_volume(4, size=(5, 5, 5))
    # Index (i, j, k) of the turned volume lies where (4 - j, i, k) of the first does.
    turned = Volume(
        np.transpose(whole.voxels[:, :, ::-1], (0, 2, 1)),
        VolumeGrid(
            (5, 5, 5),
            (0.4, 0.5, 0.3),
            (2.0, 0.0, 0.0),
            ((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
        ),
    )

    found = compare_volumes(whole, turned)

    assert found.correlation == pytest.approx(1)
    assert found.overlap == pytest.approx(1)


def test_volumes_apart():
    """Volumes with nothing in common have no correlation and no overlap."""
    found = compare_volumes(random_volume(5), random_volume(5, origin=(100.0, 0.0, 0.0)))

    assert found.as_dict() == {
        "overlap": 0.0,
        "correlation": None,
        "psnr_db": None,
        "mean_difference": None,
        "common_voxels": 0,
    }


def test_coverage_decides_what_counts():
    """A voxel that was seen and is black counts; one that was not seen does not."""
    grid = VolumeGrid((4, 1, 1), (1.0, 1.0, 1.0))
    values = np.array([[[0, 10, 20, 99]]], np.uint8)
    seen = Volume(values, grid, coverage=np.array([[[255, 255, 255, 0]]], np.uint8))

    found = compare_volumes(seen, Volume(values + 1, grid, coverage=seen.coverage))

    assert found.common_voxels == 3
    assert found.psnr_db == pytest.approx(20 * math.log10(255))
    assert found.mean_difference == -1


def test_constant_volume_has_no_correlation():
    """A volume of one grey level, far from 0 as it may be, does not vary."""
    grid = VolumeGrid((9, 9, 9), (1.0, 1.0, 1.0))
    constant = Volume(np.full((9, 9, 9), 1e6 + 0.1), grid)

    assert compare_volumes(constant, constant).correlation is None


def test_peak_of_floats():
    """Floats have no largest value: 1 unless it is given."""
    grid = VolumeGrid((2, 1, 1), (1.0, 1.0, 1.0))
    a, b = (Volume(np.array([[[x, 1.0]]], np.float32), grid) for x in (0.5, 0.75))

    assert compare_volumes(a, b).psnr_db == pytest.approx(10 * math.log10(1 / (0.25**2 / 2)))
    assert compare_volumes(a, b, peak=100.0).psnr_db == pytest.approx(
        40 + compare_volumes(a, b).psnr_db
    )


def test_colour_is_refused():
    """Several channels are compared one by one."""
    colour = Volume(np.zeros((2, 2, 2, 3), np.uint8), VolumeGrid((2, 2, 2), (1.0, 1.0, 1.0)))

    with pytest.raises(ScanError, match="one channel"):
        compare_volumes(colour, colour)
