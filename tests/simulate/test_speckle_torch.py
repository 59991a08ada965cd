"""The torch renderer makes the frames of the numba one."""

import numpy as np
import pytest
import torch

from sonosweep.errors import ScanError
from sonosweep.imaging import SectorGrid, centered_grid
from sonosweep.simulate import STILL, Beam, Deformation, PulsingArtery, splat_torch
from sonosweep.simulate.speckle import SpeckleRenderer
from tests.simulate.speckle_bodies import block, pose

ROUNDING = 1e-4
"""Of the root mean square: single precision of phases of some thousand radians."""
ARTERIES = (PulsingArtery((1.0, 9.0), 1.5, 0.2), PulsingArtery((-3.0, 7.0), 1.0, 0.1))
DEFORMED = Deformation((0.1, 0.2, -0.3), 0.07, ARTERIES)
LINEAR = Beam(), centered_grid(90, 80, (0.1484, 0.1484), 0.5)
CONVEX = (
    Beam(3.5e6, 0.35, 0.9, 1.2, 30.0, 1540.0, 40.0),
    SectorGrid(96, 100, 0.0105, 0.2, 0.5, 40.0),
)
DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]


def mottled():
    """Return a body whose echogenicity differs from voxel to voxel, with silent ones."""
    body = block((20.0, 20.0, 16.0), 0.5)
    rng = np.random.default_rng(0)
    body.echogenicity[:] = rng.integers(0, 230, body.echogenicity.shape)
    body.echogenicity[rng.random(body.echogenicity.shape) < 0.2] = 0
    return body


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("deformation", [STILL, DEFORMED])
@pytest.mark.parametrize(("beam", "grid"), [LINEAR, CONVEX])
def test_both_engines_make_the_same_frames(beam, grid, deformation, device) -> None:
    """A frame is a sum over the same scatterers, whichever processor adds them up."""
    where = pose(0.3, -0.4, 1.1, (4, 5, -7))
    numba = SpeckleRenderer(mottled(), beam, grid, seed=1)
    other = SpeckleRenderer(mottled(), beam, grid, seed=1, engine="torch", device=device)
    expected = numba.iq(where, deformation)
    difference = np.abs(other.iq(where, deformation) - expected).max()
    assert difference < ROUNDING * np.sqrt(np.mean(np.abs(expected[expected != 0]) ** 2))


@pytest.mark.parametrize("engine", ["numba", "torch"])
def test_frames_rendered_together_are_those_rendered_alone(engine, monkeypatch) -> None:
    """A batch is its frames, also where its scatterers do not fit into memory at once."""
    grid = centered_grid(40, 30, (0.1484, 0.1484), 2.0)
    renderer = SpeckleRenderer(mottled(), Beam(), grid, seed=1, engine=engine)
    poses = np.stack([pose(z=z, degrees=(z, 0, 2 * z)) for z in (-1.0, 0.0, 2.0)])
    deformations = [STILL, DEFORMED, STILL]
    alone = [renderer.iq(p, d) for p, d in zip(poses, deformations, strict=True)]
    monkeypatch.setattr(splat_torch, "MOST_SCATTERERS", 30_000)
    together = renderer.iq_tensor(poses, deformations).numpy()
    assert together == pytest.approx(np.stack(alone), abs=1e-5)


def test_a_frame_of_silence_is_silent() -> None:
    """Away from the body there is nothing to add up."""
    renderer = SpeckleRenderer(mottled(), *LINEAR, seed=1, engine="torch")
    assert np.abs(renderer.iq(pose(z=500.0))).max() == 0


def test_an_unknown_device_is_named() -> None:
    """A device that torch cannot use is an error of the user, told in one sentence."""
    with pytest.raises(ScanError, match="device 'abacus'"):
        SpeckleRenderer(mottled(), *LINEAR, seed=1, engine="torch", device="abacus")
