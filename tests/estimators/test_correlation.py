"""The correlation volume of features, against loops over patches and displacements."""

import numpy as np
import pytest
import torch
from torch import Tensor

from sonosweep.errors import ScanError
from sonosweep.estimators.correlation import (
    CorrelationGeometry,
    correlation_volume,
    subtract_local_mean,
)
from sonosweep.estimators.diagonals import box_matrix, sum_diagonals

ROUND_OFF = 1e-5  # of a cosine in float32
GEOMETRIES = (
    CorrelationGeometry(),
    CorrelationGeometry(patch=3, radius=2),
    CorrelationGeometry(patch=1, radius=1, stride=3),
    CorrelationGeometry(patch=5, radius=3, stride=2),
)


def _maps(channels: int = 3, rows: int = 12, columns: int = 20, batch: int = 2) -> list[Tensor]:
    generator = torch.Generator().manual_seed(0)
    return [torch.randn(batch, channels, rows, columns, generator=generator) for _ in range(2)]


def _patch(features: np.ndarray, row: int, column: int, side: int) -> np.ndarray:
    """Return a patch around a pixel, zeros where it leaves the map."""
    margin = side + 40
    padded = np.pad(features, ((0, 0), (margin, margin), (margin, margin)))
    top, left = row + margin - side // 2, column + margin - side // 2
    return padded[:, top : top + side, left : left + side]


def _by_loops(first: Tensor, second: Tensor, geometry: CorrelationGeometry) -> np.ndarray:
    """Return the volume of one pair, one cosine at a time."""
    stay, move = first.double().numpy(), second.double().numpy()
    radius, stride = geometry.radius, geometry.stride
    middles = [
        [stride // 2 + stride * k for k in range(geometry.regions(size))] for size in stay.shape[1:]
    ]
    volume = np.zeros((len(middles[0]), len(middles[1]), geometry.side, geometry.side))
    for index in np.ndindex(volume.shape):
        row, column = middles[0][index[0]], middles[1][index[1]]
        a = _patch(stay, row, column, geometry.patch)
        b = _patch(move, row + index[2] - radius, column + index[3] - radius, geometry.patch)
        volume[index] = (a * b).sum() / (np.linalg.norm(a) * np.linalg.norm(b) + 1e-6)
    return volume


@pytest.mark.parametrize("geometry", GEOMETRIES)
def test_correlation_is_the_cosine_of_patches(geometry: CorrelationGeometry) -> None:
    """Matrix products give what loops over regions and displacements give."""
    first, second = _maps()

    volume = correlation_volume(first, second, geometry).numpy()

    for pair in range(2):
        expected = _by_loops(first[pair], second[pair], geometry)
        np.testing.assert_allclose(volume[pair], expected, atol=ROUND_OFF, rtol=0)


def test_released_code_has_256_regions_of_15_by_15() -> None:
    """E1 of 64 x 64 pixels gives 16 x 16 arrays of 15 x 15 displacements."""
    maps = torch.rand(1, 2, 64, 64)

    assert correlation_volume(maps, maps, CorrelationGeometry()).shape == (1, 16, 16, 15, 15)


@pytest.mark.parametrize("geometry", GEOMETRIES)
def test_identical_features_correlate_most_where_they_are(geometry: CorrelationGeometry) -> None:
    """Without motion the middle of every array is 1 and nothing is more."""
    maps = _maps()[0]

    volume = correlation_volume(maps, maps, geometry)

    middle = volume[..., geometry.radius, geometry.radius]
    torch.testing.assert_close(middle, torch.ones_like(middle), atol=ROUND_OFF, rtol=0)
    assert volume.max() <= 1 + ROUND_OFF


@pytest.mark.parametrize(("rows", "columns"), [(0, 2), (1, 0), (-2, 1)])
def test_a_shift_moves_the_peak(rows: int, columns: int) -> None:
    """What has moved by so many pixels correlates most at that displacement."""
    geometry = CorrelationGeometry(radius=3)
    first = _maps(channels=8, rows=32, columns=32)[0]
    second = first.roll((rows, columns), (2, 3))

    volume = correlation_volume(first, second, geometry)[:, 1:-1, 1:-1]

    peak = (3 + rows) * geometry.side + 3 + columns
    assert (volume.flatten(3).argmax(-1) == peak).all()
    torch.testing.assert_close(
        volume.flatten(3)[..., peak], torch.ones(volume.shape[:3]), atol=ROUND_OFF, rtol=0
    )


def test_elevational_motion_lowers_the_whole_array() -> None:
    """Features that change without moving correlate less, most still in the middle."""
    geometry = CorrelationGeometry(radius=3)
    first, other = _maps(channels=16, rows=32, columns=32)
    similarity = 0.8
    second = similarity * first + (1 - similarity**2) ** 0.5 * other

    volume = correlation_volume(first, second, geometry)

    peak = volume.amax((-1, -2))
    assert (volume[..., 3, 3] == peak).float().mean() > 0.99
    assert abs(float(peak.mean()) - similarity) < 0.02  # of 128 patches of 144 numbers each


@pytest.mark.parametrize("moved", [0, 1])
def test_correlation_is_differentiable(moved: int) -> None:
    """Gradients agree with finite differences, in both maps."""
    maps = _maps(2, 5, 6, 1)
    weights, direction = torch.randn(2, 60, generator=torch.Generator().manual_seed(1))
    step = 1e-2 * direction.reshape(maps[0].shape)

    def total(sign: float) -> Tensor:
        shifted = [part + sign * step * (k == moved) for k, part in enumerate(maps)]
        volume = correlation_volume(shifted[0], shifted[1], CorrelationGeometry(radius=1))
        return (volume.flatten() * weights[: volume.numel()]).sum()

    maps[moved].requires_grad_()
    total(0).backward()

    gradient = maps[moved].grad
    assert gradient is not None
    with torch.no_grad():
        expected = float(total(1) - total(-1)) / 2
    assert float((gradient * step).sum()) == pytest.approx(expected, rel=0.01)


def test_a_patch_without_features_correlates_with_nothing() -> None:
    """Where a map is zero the correlation is 0, and so is what it teaches."""
    first, second = _maps()
    dark = torch.zeros_like(first).requires_grad_()

    volume = correlation_volume(dark, second, CorrelationGeometry(radius=1))
    volume.square().sum().backward()

    assert float(volume.detach().abs().max()) == 0
    assert dark.grad is not None
    assert bool(dark.grad.isfinite().all())


def test_half_precision_is_not_used() -> None:
    """Within autocast the volume is the same: a cosine near 1 needs more than 8 bits."""
    first, second = _maps()
    geometry = CorrelationGeometry(radius=1)

    with torch.autocast("cpu", torch.bfloat16):
        volume = correlation_volume(first, second, geometry)

    assert torch.equal(volume, correlation_volume(first, second, geometry))


@pytest.mark.parametrize("size", [3, 7])
def test_local_mean_counts_what_is_inside(size: int) -> None:
    """At an edge the mean is over the neighbors that there are."""
    maps = _maps(rows=6, columns=9)[0]
    half = size // 2

    without = subtract_local_mean(maps, size)

    for row, column in ((0, 0), (3, 4), (5, 8), (2, 0)):
        near = maps[
            ..., max(row - half, 0) : row + half + 1, max(column - half, 0) : column + half + 1
        ]
        expected = maps[..., row, column] - near.mean((-1, -2))
        torch.testing.assert_close(without[..., row, column], expected, atol=ROUND_OFF, rtol=0)


def test_without_their_mean_unrelated_positive_features_do_not_correlate() -> None:
    """Features after a rectifier have a cosine near 1 whatever they show."""
    first, second = (maps.exp() for maps in _maps(16, 32, 32))
    geometry = CorrelationGeometry(radius=1)

    raw = correlation_volume(first, second, geometry)
    free = correlation_volume(subtract_local_mean(first), subtract_local_mean(second), geometry)

    assert raw.mean() > 0.3
    assert free.mean().abs() < 0.02


@pytest.mark.parametrize("step", [1, 3])
def test_diagonals_are_summed(step: int) -> None:
    """Each row counts shifted by one more step; the spare row does not count."""
    products = torch.randn(2, 4, 20, generator=torch.Generator().manual_seed(0))

    total = sum_diagonals(products, step)

    for t in range(20 - 2 * step):
        expected = sum(products[:, u, t + u * step] for u in range(3))
        torch.testing.assert_close(total[:, t], expected, atol=ROUND_OFF, rtol=0)


def test_box_matrix_sums_neighbors() -> None:
    """Three of five numbers at each of three places."""
    box = box_matrix(5, 3, torch.device("cpu"))

    assert (box @ torch.tensor([1.0, 10.0, 100.0, 1000.0, 10000.0])).tolist() == [111, 1110, 11100]


@pytest.mark.parametrize(
    ("sizes", "message"), [((2, 1, 1), "odd side, got 2"), ((3, 0, 4), "got 0 and 4")]
)
def test_impossible_sizes_are_refused(sizes: tuple[int, int, int], message: str) -> None:
    """A patch has a middle and moves."""
    with pytest.raises(ScanError, match=message):
        CorrelationGeometry(*sizes)
