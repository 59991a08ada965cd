"""Round numbers and escaped markup."""

from xml.etree import ElementTree

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonosweep.view import svg

ROUND_OFF = 1e-6  # relative, of sums of float64 steps

spans = st.floats(1e-6, 1e9)


@given(st.floats(-1e6, 1e6), spans)
def test_ticks_lie_on_the_axis(low, span):
    """Every round number of an axis lies between its ends, and there are two at the least."""
    ticks = svg.nice_ticks(low, low + span)

    slack = ROUND_OFF * (span + abs(low))
    assert all(low - slack <= tick <= low + span + slack for tick in ticks)
    assert 2 <= len(ticks) <= 25 or span < 1e-9 * abs(low)


@given(spans)
def test_scale_bars_are_round_and_fit(width_mm):
    """A scale bar is 1, 2 or 5 times a power of ten, and between a tenth and 0.3 of the width."""
    length = svg.nice_length_mm(width_mm)

    assert 0.1 * width_mm <= length <= 0.3 * width_mm * (1 + ROUND_OFF)
    assert f"{length:e}"[:8] in ("1.000000", "2.000000", "5.000000")


@given(st.text(st.characters(exclude_categories=["Cs", "Cc"], exclude_characters="\ufffe\uffff")))
def test_any_name_survives_as_text(name):
    """A name with markup in it is shown as it is and adds no element."""
    drawn = svg.figure(10, 10, name, svg.text(name, 1, 2))

    root = ElementTree.fromstring(drawn)
    assert [child.tag.rsplit("}")[-1] for child in root] == ["title", "text"]
    assert (root[1].text or "") == name


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        (-0.5, f"{svg.MINUS}0.5"),
        (-0.0, "0"),
        (1e-17, f"1e{svg.MINUS}17"),
        (1200.0, "1200"),
    ],
)
def test_numbers_read_well(value, shown):
    """Axes write a true minus sign and no negative zero."""
    assert svg.number_label(value) == shown
