"""Without being told, an image covers what the array sees."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from sonosweep.errors import ScanError
from sonosweep.imaging.field_of_view import (
    field_of_view,
    recorded_depth_mm,
    surrounding_radius_mm,
)
from sonosweep.scan import Probe, modalities
from tests.imaging import channel_sweeps as made

RECORDED = modalities(made.sweep())
LINEAR, ONE_WAY = RECORDED["b_mode"], RECORDED["photoacoustic"]


def arc_probe(radius_mm, opening_rad, elements=64):
    """Return elements on a circle around the origin, with the opening at the top."""
    angle = torch.linspace(opening_rad / 2, 2 * math.pi - opening_rad / 2, elements).double()
    return Probe(
        "arc",
        torch.stack([radius_mm * angle.sin(), -radius_mm * angle.cos(), 0 * angle], dim=1),
        0.5,
        5e6,
    )


def test_depth_of_the_recording():
    """Echoes go there and back, photoacoustic waves only back."""
    assert recorded_depth_mm(LINEAR) == pytest.approx(400 / 20e6 * 1540e3 / 2)
    assert recorded_depth_mm(ONE_WAY) == pytest.approx(400 / 20e6 * 1540e3)


def test_in_front_of_a_linear_array():
    """As wide as its elements, symmetric, and a square unless recorded less deep."""
    grid = field_of_view(LINEAR)

    assert grid.columns == 256
    assert 256 * grid.spacing_mm[0] == pytest.approx(32 * 0.3)
    assert grid.lateral_mm[0] == pytest.approx(-grid.lateral_mm[-1])
    assert grid.axial_mm[-1] == pytest.approx(32 * 0.3, abs=grid.spacing_mm[1])
    shallow = replace(LINEAR, samples=np.asarray(LINEAR.samples)[..., :100])
    assert field_of_view(shallow).axial_mm[-1] < 100 / 20e6 * 1540e3 / 2


def test_in_the_middle_of_a_ring():
    """Elements around the body show a square about the middle."""
    ring = replace(ONE_WAY, probe=arc_probe(40.5, 1.5, made.ELEMENTS))

    grid = field_of_view(ring)

    assert surrounding_radius_mm(ring.probe) == pytest.approx(40.5)
    assert grid.rows == grid.columns == 256
    assert grid.axial_mm == pytest.approx(grid.lateral_mm)
    assert grid.lateral_mm[-1] == pytest.approx(0.3 * 40.5, rel=0.01)


def test_the_depth_within_a_ring_is_that_of_all_sides():
    """The square around the middle is as large as asked for."""
    ring = replace(ONE_WAY, probe=arc_probe(40.5, 1.5, made.ELEMENTS))

    grid = field_of_view(ring, pixel_mm=0.1, depth_mm=15.0)

    assert (grid.columns, grid.rows) == (300, 300)
    assert grid.lateral_mm[-1] == pytest.approx(15.0, abs=0.1)


def test_positions_in_meters_are_noticed():
    """An array of 20 um is one whose unit is wrong, and the sentence says where to look."""
    tiny = replace(LINEAR.probe, element_positions_mm=1e-3 * LINEAR.probe.element_positions_mm)

    with pytest.raises(ScanError, match=r"mm wide and .* check the positions of the elements"):
        field_of_view(replace(LINEAR, probe=tiny))


def test_arrays_that_do_not_surround():
    """A line and a flat arc have their image in front."""
    assert surrounding_radius_mm(made.probe()) is None
    assert surrounding_radius_mm(arc_probe(60.0, 2 * math.pi - 1.0)) is None


@pytest.mark.parametrize("data", [LINEAR, replace(ONE_WAY, probe=arc_probe(40.5, 1.5, 32))])
def test_what_is_asked_for_holds(data):
    """Counts, pixel size and depth are exactly those that were given."""
    every = field_of_view(data, 30, 40, 0.2)
    deep = field_of_view(data, pixel_mm=0.1, depth_mm=5.0)

    assert (every.columns, every.rows, every.spacing_mm) == (30, 40, (0.2, 0.2))
    assert deep.axial_mm[-1] == pytest.approx(5.0, abs=0.11)
    assert deep.spacing_mm == (0.1, 0.1)
    fine = field_of_view(data, rows=200, depth_mm=5.0)
    assert fine.rows == 200
    assert fine.axial_mm[-1] == pytest.approx(5.0, abs=fine.spacing_mm[1])


@pytest.mark.parametrize(
    ("asked", "sentence"),
    [
        ({"columns": 0}, "columns of an image must be above 0, got 0"),
        ({"pixel_mm": float("nan")}, "pixel size of an image must be above 0, got nan"),
        ({"depth_mm": -3.0}, "depth of an image must be above 0, got -3"),
        ({"depth_mm": 0.4}, "must end below that, not at 0.4 mm"),
        ({"rows": 10, "depth_mm": 9.0, "pixel_mm": 0.1}, "only one of --rows and --depth-mm"),
        ({"pixel_mm": 1e-5}, "is too large"),
    ],
)
def test_images_that_make_no_sense(asked, sentence):
    """No pixels, no size, or more than fit."""
    with pytest.raises(ScanError, match=sentence):
        field_of_view(LINEAR, **asked)


def test_an_array_of_one_element():
    """Its image has no width of its own, but one can be given."""
    single = replace(
        LINEAR,
        samples=np.asarray(LINEAR.samples)[:, :, :1],
        probe=Probe("single", torch.zeros(1, 3).double(), 0.3, 5e6),
        transmit_delays_s=None,
    )

    with pytest.raises(ScanError, match="lie at one place"):
        field_of_view(single)
