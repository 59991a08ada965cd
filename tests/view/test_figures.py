"""Figures are well-formed, and what they draw is where the numbers say."""

import re
from xml.etree import ElementTree

import numpy as np
import pytest
import torch
from hypothesis import given
from numpy.testing import assert_allclose

from sonosweep.scan import Trajectory
from sonosweep.view.camera import project, view_rotation
from sonosweep.view.figures import (
    Track,
    draw_drift,
    draw_steps,
    draw_trajectories,
    frame_outlines,
    padded_box,
)
from sonosweep.view.plots import MAX_POINTS, Series, draw_lines

from ..strategies import poses, sweeps
from .conftest import FRAMES, straight

ROUND_OFF_MM = 1e-9  # float64 on coordinates below 1 m
SVG = "{http://www.w3.org/2000/svg}"


def paths(drawn: str) -> list[np.ndarray]:
    """Return the points of every path of a picture, checking that it is well-formed."""
    found = ElementTree.fromstring(drawn).iter(f"{SVG}path")
    data = [path.get("d") or "" for path in found]
    return [np.array(re.findall(r"(-?[\d.]+) (-?[\d.]+)", one), dtype=float) for one in data if one]


def words(drawn: str) -> list[str]:
    """Return every text of a picture."""
    return [text.text or "" for text in ElementTree.fromstring(drawn).iter(f"{SVG}text")]


@given(sweeps(8), poses())
def test_outlines_do_not_see_the_reference(image_to_reference, reference_to_world):
    """Moving the tracker moves no outline: they are seen from the first frame."""
    expected = frame_outlines([Trajectory(image_to_reference)], (40.0, 30.0))[0]

    moved = frame_outlines([Trajectory(reference_to_world @ image_to_reference)], (40.0, 30.0))[0]

    assert_allclose(moved, expected, atol=ROUND_OFF_MM)
    assert_allclose(
        moved[0], [[0, 0, 0], [40, 0, 0], [40, 30, 0], [0, 30, 0], [20, 0, 0]], atol=1e-9
    )


def test_the_viewer_stands_before_the_first_frame_and_above():
    """Lateral runs right, axial down, and what is deeper in elevation is higher and farther."""
    right, down, away = project(np.eye(3), view_rotation())

    assert right[0] > 0
    assert down[1] > 0
    assert away[2] > 0 > away[1]


def test_two_trajectories_have_two_colors_and_both_names():
    """A reader can tell the tracked from the sensorless path, also without colour sight."""
    tracks = [Track("tracked", straight(0.5)), Track("sensorless <b>", straight(0.4))]

    drawn = draw_trajectories(tracks, (40.0, 30.0))

    assert {"tracked", "sensorless <b>"} <= set(words(drawn))
    assert "#0072b2" in drawn
    assert "#d55e00" in drawn
    assert {"lateral (mm)", "axial (mm)", "elevational (mm)"} <= set(words(drawn))


@given(sweeps(30, largest_step_mm=20.0, largest_turn_rad=0.4))
def test_trajectories_stay_on_the_page(image_to_reference):
    """However a sweep turns, its picture is drawn inside of its frame."""
    drawn = draw_trajectories([Track("a", Trajectory(image_to_reference))], (40.0, 30.0))

    points = np.concatenate(paths(drawn))
    assert points.min() >= 0
    assert (points.max(axis=0) <= (560, 520)).all()


def test_one_frame_can_be_drawn():
    """A single frame has no path and no steps, but a place."""
    still = [Track("one", Trajectory(torch.eye(4, dtype=torch.float64)[None]))]

    assert len(paths(draw_trajectories(still, (40.0, 30.0)))) >= 1
    assert len(paths(draw_trajectories(still))) >= 1
    assert paths(draw_steps(still)) == []


def test_a_box_has_thickness():
    """Frames in one plane still get a box to be drawn in."""
    low, high = padded_box(np.array([[0.0, 0, 5], [20, 10, 5]]))

    assert (high - low).tolist() == [20.0, 10.0, 1.0]


def test_a_drift_curve_rises_as_its_numbers_do():
    """Drift that grows linearly is a straight line from the lower left to the upper right."""
    (curve,) = paths(draw_drift([("sensorless", np.linspace(0, 3, 50), 1)]))

    slopes = np.diff(curve[:, 1]) / np.diff(curve[:, 0])
    assert_allclose(slopes, slopes.mean(), atol=0.005)  # two decimals of a unit per 21 units
    assert slopes.mean() < 0


def test_steps_show_six_numbers_and_their_band():
    """Each degree of freedom has its panel with its unit; a standard deviation is a band."""
    drawn = draw_steps([Track("tracked", straight(0.5)), Track("estimated", straight(0.4, 0.02))])

    assert {"elevational (mm)", "yaw (°)"} <= set(words(drawn))
    assert "estimated (band: ±1 SD)" in words(drawn)
    sizes = sorted(len(points) for points in paths(drawn))
    assert sizes == [FRAMES - 1] * 12 + [2 * (FRAMES - 1)] * 6


def test_gaps_stay_gaps():
    """Samples that are not finite break the line and are not drawn over."""
    y = np.array([0.0, 1, np.nan, 3, 4])

    drawn = draw_lines((Series("a", np.arange(5.0), y),), "t", "x", "y")

    assert [len(points) for points in paths(drawn)] == [2, 2]


def test_long_scans_keep_their_extremes():
    """A peak of one frame in a hundred thousand is still seen."""
    y = np.zeros(100_000)
    y[70_001] = 1.0

    (curve,) = paths(draw_lines((Series("a", np.arange(1e5), y),), "t", "x", "y"))

    assert len(curve) <= MAX_POINTS + 2
    assert (curve[:, 1] < curve[:, 1].max() - 100).sum() == 1


@pytest.mark.parametrize("y", [np.zeros(4), np.full(4, np.nan), np.empty(0), np.full(4, 1e12)])
def test_any_values_give_a_picture(y):
    """Constant, missing and huge values are drawn without a warning."""
    drawn = draw_lines((Series("a", np.arange(float(len(y))), y),), "t", "x", "y")

    assert ElementTree.fromstring(drawn).tag == f"{SVG}svg"
