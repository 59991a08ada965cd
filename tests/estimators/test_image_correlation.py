"""The correlation of frames, against NumPy's correlation coefficient."""

import numpy as np
import pytest
import torch
from torch import Tensor

from sonosweep.errors import ScanError
from sonosweep.estimators.image_correlation import ShiftRange, image_correlation

ROUND_OFF = 1e-5  # of a coefficient in float32, of frames from 0 to 1


def _frames(rows: int = 48, columns: int = 64) -> list[Tensor]:
    generator = torch.Generator().manual_seed(0)
    return [torch.rand(2, 1, rows, columns, generator=generator) for _ in range(2)]


@pytest.mark.parametrize("shifts", [ShiftRange(), ShiftRange(0, 2), ShiftRange(4, 1)])
def test_it_is_the_correlation_coefficient_of_blocks(shifts: ShiftRange) -> None:
    """Every number is NumPy's coefficient of a block and the block it has moved to."""
    first, second = _frames()
    axial, lateral = shifts.axial_radius, shifts.lateral_radius
    block = 16

    volume = image_correlation(first, second, block, shifts).numpy()

    assert volume.shape == (2, 3, 4, *shifts.count)
    margins = ((axial, axial), (lateral, lateral))
    moved = np.pad(second[1, 0].numpy(), margins)
    for index in np.ndindex(volume.shape[1:]):
        row, column = block * index[0], block * index[1]
        stays = first[1, 0].numpy()[row : row + block, column : column + block]
        row, column = row + index[2], column + index[3]
        moves = moved[row : row + block, column : column + block]
        expected = np.corrcoef(stays.ravel(), moves.ravel())[0, 1]
        assert volume[1][index] == pytest.approx(expected, abs=ROUND_OFF)


@pytest.mark.parametrize(("rows", "columns"), [(0, 0), (2, -4), (-3, 5)])
def test_a_shift_moves_the_peak(rows: int, columns: int) -> None:
    """Blocks inside the frame correlate fully where they have gone."""
    first = _frames(64, 64)[0]
    second = first.roll((rows, columns), (2, 3))
    shifts = ShiftRange()

    inside = image_correlation(first, second, 16, shifts)[:, 1:-1, 1:-1]

    peak = inside[..., shifts.axial_radius + rows, shifts.lateral_radius + columns]
    torch.testing.assert_close(peak, torch.ones_like(peak), atol=ROUND_OFF, rtol=0)
    assert torch.equal(inside.amax((-1, -2)), peak)


def test_gain_and_offset_do_not_matter() -> None:
    """A brighter display of the next frame correlates as before, away from the edge."""
    first, second = _frames()
    shifts = ShiftRange(0, 0)

    volume = image_correlation(first, second, 16, shifts)
    brighter = image_correlation(first, 0.5 * second + 0.4, 16, shifts)

    torch.testing.assert_close(brighter, volume, atol=ROUND_OFF, rtol=0)


def test_black_blocks_correlate_with_nothing() -> None:
    """Where there is no speckle there is nothing to follow."""
    first, second = _frames()

    volume = image_correlation(first, torch.zeros_like(second), 16, ShiftRange())

    assert float(volume.abs().max()) == 0


def test_half_precision_is_not_used() -> None:
    """Within autocast the volume is the same."""
    first, second = _frames()

    with torch.autocast("cpu", torch.bfloat16):
        volume = image_correlation(first, second, 16, ShiftRange())

    assert torch.equal(volume, image_correlation(first, second, 16, ShiftRange()))


def test_negative_radii_are_refused() -> None:
    """A block cannot move less than not at all."""
    with pytest.raises(ScanError, match="not negative, got -1 and 5"):
        ShiftRange(axial_radius=-1)
