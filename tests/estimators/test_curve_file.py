"""Curve files."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonosweep.errors import RecipeError
from sonosweep.estimators.curve_file import read_curve, write_curve
from sonosweep.estimators.decorrelation_curve import DecorrelationCurve
from tests.io.damage import assert_reads_or_explains, damaged

widths = st.floats(0.01, 100)


@given(
    count=st.integers(1, 6),
    width=widths,
    exponent=st.floats(0.3, 4),
    peak=st.floats(0.1, 1),
    preset=st.text(max_size=30).filter(lambda text: text.isprintable() or "\x7f" in text),
)
def test_a_curve_survives_its_file(tmp_path_factory, count, width, exponent, peak, preset):
    """What was calibrated on Monday is the same on Tuesday, to the last digit."""
    curve = DecorrelationCurve(
        depth_mm=tuple(float(k) for k in range(count)),
        width_mm=tuple(width + k for k in range(count)),
        exponent=exponent,
        peak=peak,
        fineness_per_mm2=(2.5,) * count,
        source="length",
        preset=preset,
        quality={"length_mm": 42.0, "odd name": 1e-9},
    )
    path = tmp_path_factory.mktemp("curve") / "probe.toml"

    write_curve(curve, path)

    assert read_curve(path) == curve


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("exponent = 2.0", "exponent = 'steep'"), "exponent in .* valid number"),
        (("exponent = 2.0", "exponent = 9.0"), "exponent of a decorrelation curve must be"),
        (("exponent = 2.0", "exponent = nan"), "exponent in .* finite"),
        (("peak = 1.0", "peek = 1.0"), "peak in .* required"),
        (("peak = 1.0", "peak = 1.0\nmood = 1"), "mood in .* not permitted"),
        (("width_mm = [0.42]", "width_mm = [0.42, 0.5]"), "one width per depth"),
        (("version = 1", "version = 2"), "version in"),
        (("[quality]", "[quality"), "no decorrelation curve"),
    ],
)
def test_a_wrong_field_is_named(tmp_path, change, message):
    """A slip in an edited file is found by name, not by a strange volume."""
    path = tmp_path / "probe.toml"
    write_curve(DecorrelationCurve(), path)
    path.write_text(path.read_text().replace(*change))

    with pytest.raises(RecipeError, match=message):
        read_curve(path)


@pytest.mark.parametrize("content", [b"", b"\xff\xfe\x00", b"\x93NUMPY", b"[" * 5000])
def test_other_files_are_refused(tmp_path, content):
    """A file that is no curve says so in one sentence."""
    path = tmp_path / "probe.toml"
    path.write_bytes(content)

    with pytest.raises(RecipeError):
        read_curve(path)


def test_a_missing_file_is_named(tmp_path):
    """A path with a typing error is shown back."""
    with pytest.raises(RecipeError, match=r"cannot read '.*none\.toml'"):
        read_curve(tmp_path / "none.toml")


@given(data=st.data())
def test_damaged_curves_are_read_or_explained(tmp_path_factory, data):
    """Cut, flipped and random bytes give a curve or one sentence."""
    path = tmp_path_factory.mktemp("curve") / "probe.toml"
    write_curve(DecorrelationCurve(), path)
    path.write_bytes(data.draw(damaged(path.read_bytes())))

    assert_reads_or_explains(lambda: read_curve(path))
