"""Speckle agrees with a simulation of the waves, of the same scatterers: PyMUST.

``golden/make_speckle.py`` says how the images were made. Nothing was fitted to them but what
the default beam says of its origin: the center frequency, on another scene.
"""

from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from sonosweep.imaging import PixelGrid
from sonosweep.simulate import Beam
from sonosweep.simulate.speckle import render_points
from tests.simulate.speckle_bodies import correlation

GOLDEN = np.load(Path(__file__).parent / "golden" / "speckle_pymust.npz")
SPACING_MM = float(GOLDEN["spacing_mm"])
PIXELS = GOLDEN["echoes"].shape[-1]
FIRST_MM = GOLDEN["middle_mm"] - (PIXELS - 1) / 2 * SPACING_MM
GRID = PixelGrid(PIXELS, PIXELS, (SPACING_MM, SPACING_MM), (float(FIRST_MM[0]), float(FIRST_MM[1])))
BEAM = Beam()
CARRIER = np.exp(4j * np.pi * GRID.axial_mm / BEAM.wavelength_mm)[:, None]
TURNS_DEG = GOLDEN["turns_deg"].tolist()


def turn_matrix(degrees: float) -> np.ndarray:
    """Return the matrix that turns rows of points, the lateral axis to the axial one."""
    cosine, sine = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    return np.array([[cosine, sine], [-sine, cosine]])


def of_waves(number: int) -> np.ndarray:
    """Return the echoes that PyMUST computed, without the carrier."""
    real, imaginary = GOLDEN["echoes"][number].astype(np.float64)
    return (real + 1j * imaginary) / CARRIER


def of_ours(number: int) -> np.ndarray:
    """Return our echoes of the same scatterers."""
    flat = GOLDEN["points_mm"].astype(float) @ turn_matrix(TURNS_DEG[number]) + GOLDEN["middle_mm"]
    points = np.column_stack([flat, np.zeros(len(flat))])
    return render_points(points, GOLDEN["amplitudes"].astype(float), BEAM, GRID)


def turned_back(echoes: np.ndarray, degrees: float) -> np.ndarray:
    """Return echoes, with their carrier, at the points of the frame that was not turned."""
    axis = np.arange(-2.1, 2.1, 0.025)
    here = np.stack(np.meshgrid(axis, axis), axis=-1) @ turn_matrix(degrees)
    at = (here[..., ::-1] + (PIXELS - 1) / 2 * SPACING_MM) / SPACING_MM
    at = np.moveaxis(at, -1, 0)
    there = map_coordinates(echoes.real, at) + 1j * map_coordinates(echoes.imag, at)
    return there * np.exp(4j * np.pi * here[..., 1] / BEAM.wavelength_mm)


@pytest.mark.parametrize("number", range(len(TURNS_DEG)))
def test_envelopes_are_those_of_a_simulation_of_the_waves(number: int) -> None:
    """The point spread function stands for 31 plane waves and delay-and-sum."""
    ours, waves = np.abs(of_ours(number)), np.abs(of_waves(number))
    assert np.corrcoef(ours.ravel(), waves.ravel())[0, 1] > 0.95


@pytest.mark.parametrize("number", range(1, len(TURNS_DEG)))
def test_turning_decorrelates_as_in_a_simulation_of_the_waves(number: int) -> None:
    """After a turn in the plane, echoes differ as much as those of the waves."""
    lost = []
    for frames in (of_ours, of_waves):
        still, turned = (turned_back(frames(n), TURNS_DEG[n]) for n in (0, number))
        lost.append(abs(correlation(still, turned)))
    assert lost[0] == pytest.approx(lost[1], abs=0.03)
