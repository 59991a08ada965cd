"""Phantoms of the simulator."""

import numpy as np
import pytest
from scipy import ndimage

from sonosweep.errors import ScanError
from sonosweep.simulate.body import REFERENCE_CODE, Tissue, Vessel, echo_amplitude
from sonosweep.simulate.phantoms import (
    Cyst,
    cyst_phantom,
    default_vessels,
    uniform_phantom,
    vessel_phantom,
    wire_phantom,
)


def centers_mm(body):
    """Return z, y, x of all voxel centers, each ready to be broadcast."""
    x0, y0, z0 = body.origin_mm
    z, y, x = (np.arange(count) * body.spacing_mm for count in body.tissue.shape)
    return (z + z0)[:, None, None], (y + y0)[:, None], x + x0


def test_a_uniform_phantom_scatters_equally_everywhere():
    """Its blocks reach from the surface at y = 0, centered in x and z; -6 dB halve echoes."""
    body = uniform_phantom((20.0, 10.0, 30.0), level_db=-6.0, spacing_mm=0.5)
    z, y, x = centers_mm(body)

    assert body.tissue.shape == (60, 20, 40)
    assert (body.echogenicity == REFERENCE_CODE - 24).all()
    assert echo_amplitude()[body.echogenicity[0, 0, 0]] == pytest.approx(0.501, abs=0.001)
    assert x[0] == -x[-1]
    assert z[0] == -z[-1]
    assert y[0] == pytest.approx(0.25)
    assert (body.skin_depth_mm == 0).all()


def test_a_wire_is_where_it_was_put():
    """A slanted wire in a silent bath is a line of bright voxels around it."""
    ends = ((-8.0, 4.0, -9.0), (6.0, 12.0, 9.0))
    body = wire_phantom([ends], (20.0, 16.0, 20.0))
    z, y, x = centers_mm(body)
    wire = body.echogenicity > 0
    share = (z + 9) / 18
    off = np.sqrt((x + 8 - 14 * share) ** 2 + (y - 4 - 8 * share) ** 2)

    assert (body.echogenicity[wire] == 255).all()
    assert off[wire].max() < 0.35
    inner = np.abs(z[:, 0, 0]) < 8.9
    assert wire.any(axis=(1, 2))[inner].all()
    assert set(np.unique(body.tissue)) == {Tissue.GEL, Tissue.FASCIA}


def test_nine_wires_by_default():
    """The usual phantom has three rows of three wires along z."""
    body = wire_phantom(background_db=-20.0)

    assert ndimage.label(body.echogenicity == 255)[1] == 9
    assert (body.echogenicity > 0).all()


def test_cysts_are_balls_of_their_level():
    """A cyst has the volume and place of its ball; one without a level is silent."""
    cysts = (Cyst((-4.0, 8.0, 1.0), 3.0), Cyst((5.0, 9.0, -2.0), 2.0, 12.0))
    body = cyst_phantom(cysts, (20.0, 18.0, 12.0))

    silent, bright = body.echogenicity == 0, body.echogenicity == REFERENCE_CODE + 48
    for found, cyst in zip((silent, bright), cysts, strict=True):
        volume = found.sum() * body.spacing_mm**3
        assert volume == pytest.approx(4 / 3 * np.pi * cyst.radius_mm**3, rel=0.03)
        middle = np.array(ndimage.center_of_mass(found))[::-1] * body.spacing_mm
        assert middle + body.origin_mm == pytest.approx(cyst.center_mm, abs=0.02)


def test_vessels_are_around_their_center_lines():
    """The lumen of a straight tube holds the voxels within its radius and no others."""
    line = np.stack((np.zeros(21), np.full(21, 6.0), np.linspace(-10, 10, 21)), axis=1)
    tube = Vessel("tube", "vein", line, np.full(21, 1.5), 10.0)
    body = vessel_phantom([tube], (12.0, 12.0, 16.0))
    z, y, x = centers_mm(body)
    off = np.broadcast_to(np.hypot(x, y - 6.0) + 0 * z, body.tissue.shape)

    assert np.array_equal(body.tissue == Tissue.VEIN, off <= 1.5)
    assert body.echogenicity[off <= 1.5].max() < REFERENCE_CODE - 100
    wall = body.tissue == Tissue.VESSEL_WALL
    assert wall.any()
    assert off[wall].max() < 1.5 + 0.25
    assert body.vessels == (tube,)


def test_default_vessels_branch_and_stay_apart():
    """There is one vein, and one tree of arteries: the branch starts on the winding artery."""
    body = vessel_phantom()
    _, artery, branch = default_vessels()

    assert np.abs(artery.centerline_mm - branch.centerline_mm[0]).sum(axis=1).min() < 1e-9
    for label in (Tissue.ARTERY, Tissue.VEIN):
        assert ndimage.label(body.tissue == label, np.ones((3, 3, 3)))[1] == 1


@pytest.mark.parametrize(
    ("line", "radii", "message"),
    [
        ([[0, 0, 0]], [1], "needs two points or more, with a radius each, got 1 points"),
        ([[0, 0, 0], [0, 0, np.nan]], [1, 1], "needs finite points and speed"),
        ([[0, 0, 0], [0, 0, 1]], [1, 0], "radii above 0 mm"),
    ],
)
def test_a_vessel_is_a_tube(line, radii, message):
    """Points that are missing or not numbers, and radii of 0, are refused."""
    with pytest.raises(ScanError, match=message):
        Vessel("odd", "vein", np.array(line, np.float64), np.array(radii, np.float64), 10.0)


@pytest.mark.parametrize(
    "make", [uniform_phantom, wire_phantom, cyst_phantom, vessel_phantom], ids=lambda f: f.__name__
)
def test_a_phantom_is_the_same_every_time(make):
    """Nothing in a phantom is random."""
    one, two = make(), make()

    assert np.array_equal(one.tissue, two.tissue)
    assert np.array_equal(one.echogenicity, two.echogenicity)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: uniform_phantom((10.0, 0.0, 10.0)), "is empty: its depth must be above 0"),
        (lambda: uniform_phantom((10.0, 10.0, np.inf)), "length must be above 0, got inf"),
        (lambda: uniform_phantom(spacing_mm=0.0), "voxel size must be above 0 mm, got 0"),
        (lambda: uniform_phantom((1e3, 1e3, 1e3)), "more than 150000000 voxels"),
        (lambda: wire_phantom([]), "is empty: nothing in it scatters"),
        (
            lambda: wire_phantom([((90.0, 5.0, 0.0), (90.0, 5.0, 9.0))]),
            "is empty: nothing in it scatters",
        ),
        (lambda: cyst_phantom([Cyst((0.0, 0.0, 0.0), -1.0)]), "radii above 0 mm, got"),
        (
            lambda: wire_phantom([((np.nan, 5.0, 0.0), (0.0, 5.0, 9.0))]),
            "must be finite numbers",
        ),
    ],
)
def test_phantoms_that_cannot_be_are_refused(make, message):
    """An empty phantom, or one that would not fit in memory, is refused in one sentence."""
    with pytest.raises(ScanError, match=message):
        make()
