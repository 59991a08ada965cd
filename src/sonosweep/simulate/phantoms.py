"""Phantoms: uniform, with wires, with cysts, with vessels. Nothing in them is random.

A phantom is a block with x and z centered at 0 and its surface at y = 0.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, UInt8

from sonosweep.errors import ScanError
from sonosweep.simulate.body import Body, Tissue, Vessel
from sonosweep.simulate.tube_kernels import paint_tube
from sonosweep.simulate.tubes import code_of, labels_except, paint_vessels
from sonosweep.simulate.voxels import Point, first_voxel, voxel_counts

BRIGHT_DB = 13.75  # of wires: the brightest code there is
_HIT = 0.87  # of a voxel's size: a ball of this radius holds the center of at least one


class Cyst(NamedTuple):
    """A ball within a phantom.

    Attributes:
        center_mm: x, y and z.
        radius_mm: Of the ball.
        level_db: Of its scatterers' amplitude, relative to 1; ``None`` if it has none.
    """

    center_mm: Point
    radius_mm: float
    level_db: float | None = None


Wire = tuple[Point, Point]
CYSTS = (
    Cyst((-8.0, 12.0, 0.0), 3.0),
    Cyst((8.0, 12.0, 0.0), 3.0, 10.0),
    Cyst((-8.0, 26.0, 0.0), 4.0),
    Cyst((8.0, 26.0, 0.0), 4.0, 6.0),
)
WIRES = tuple(((x, y, -20.0), (x, y, 20.0)) for y in (10.0, 20.0, 30.0) for x in (-10.0, 0.0, 10.0))


def uniform_phantom(
    size_mm: Point = (40.0, 40.0, 40.0), *, level_db: float = 0.0, spacing_mm: float = 0.5
) -> Body:
    """Return a block that scatters equally everywhere.

    Args:
        size_mm: Lateral (x), axial (y) and elevational (z) extent.
        level_db: Of its scatterers' amplitude, relative to 1.
        spacing_mm: Size of a voxel.

    Raises:
        ScanError: If the block is empty or too large.
    """
    return _body("uniform phantom", _block("uniform phantom", size_mm, spacing_mm, level_db))


def wire_phantom(
    wires_mm: Sequence[Wire] = WIRES,
    size_mm: Point = (40.0, 40.0, 40.0),
    *,
    diameter_mm: float = 0.25,
    background_db: float | None = None,
    spacing_mm: float = 0.25,
) -> Body:
    """Return straight wires, by default nine along z.

    Args:
        wires_mm: The two ends of each; equal ends make a bead.
        size_mm: Extent of the block along x, y and z.
        diameter_mm: Of the wires; thinner ones than a voxel are drawn one or two voxels wide.
        background_db: Level of what is around them; ``None``: a silent bath.
        spacing_mm: Size of a voxel.

    Raises:
        ScanError: If the block is empty or too large, or nothing in it scatters.
    """
    block = _block("wire phantom", size_mm, spacing_mm, background_db)
    radius = max(diameter_mm / 2, _HIT * spacing_mm)
    for ends in wires_mm:
        _paint(block, np.array(ends), radius, Tissue.FASCIA, code_of(BRIGHT_DB))
    return _body("wire phantom", block)


def cyst_phantom(
    cysts: Sequence[Cyst] = CYSTS,
    size_mm: Point = (40.0, 40.0, 40.0),
    *,
    level_db: float = 0.0,
    spacing_mm: float = 0.25,
) -> Body:
    """Return balls, by default two without scatterers and two bright ones, in uniform tissue.

    Args:
        cysts: The balls.
        size_mm: Extent of the block along x, y and z.
        level_db: Of the tissue around them.
        spacing_mm: Size of a voxel.

    Raises:
        ScanError: If the block is empty or too large.
    """
    block = _block("cyst phantom", size_mm, spacing_mm, level_db)
    for cyst in cysts:
        label = Tissue.GEL if cyst.level_db is None else Tissue.FAT
        code = 0 if cyst.level_db is None else code_of(cyst.level_db)
        _paint(block, np.array((cyst.center_mm, cyst.center_mm)), cyst.radius_mm, label, code)
    return _body("cyst phantom", block)


def vessel_phantom(
    vessels: Sequence[Vessel] | None = None,
    size_mm: Point = (40.0, 32.0, 60.0),
    *,
    level_db: float = 0.0,
    spacing_mm: float = 0.25,
) -> Body:
    """Return tubes of blood with exact center lines in uniform tissue.

    Args:
        vessels: The tubes; by default a straight vein, a curved artery, and a branch of it.
        size_mm: Extent of the block along x, y and z.
        level_db: Of the tissue around them.
        spacing_mm: Size of a voxel.

    Raises:
        ScanError: If the block is empty or too large.
    """
    tubes = tuple(default_vessels() if vessels is None else vessels)
    block = _block("vessel phantom", size_mm, spacing_mm, level_db)
    paint_vessels(block.tissue, block.echogenicity, block.origin_mm, spacing_mm, tubes)
    return _body("vessel phantom", block, tubes)


def default_vessels() -> tuple[Vessel, Vessel, Vessel]:
    """Return a straight vein, an artery that winds by 5 mm, and a branch that leaves it."""
    along = np.linspace(-29.0, 29.0, 117)
    vein = np.stack((np.full_like(along, 10.0), np.full_like(along, 9.0), along), axis=1)
    artery = np.stack((5 * np.sin(along / 14) - 6, 17 + 3 * np.cos(along / 20), along), axis=1)
    start = len(along) // 3
    gone = (along - along[start])[start:, None]
    aside = np.array([[9.0, 7.0, 0.0]]) * (1 - np.exp(-gone / 12))
    branch = artery[start] + aside + gone * np.array([[0.05, 0.0, 1.0]])
    return (
        Vessel("vein", "vein", vein, np.full(len(vein), 1.5), 20.0),
        Vessel("artery", "artery", artery, np.full(len(artery), 1.2), 100.0),
        Vessel("branch", "artery", branch, np.linspace(0.9, 0.6, len(branch)), 60.0),
    )


class _Block(NamedTuple):
    """Voxels of a phantom in the making."""

    tissue: UInt8[np.ndarray, "z y x"]
    echogenicity: UInt8[np.ndarray, "z y x"]
    spacing_mm: float
    origin_mm: Point


def _block(name: str, size_mm: Point, spacing_mm: float, level_db: float | None) -> _Block:
    """Return uniform tissue, or a silent bath."""
    counts = voxel_counts(name, size_mm, spacing_mm)
    label, code = (Tissue.GEL, 0) if level_db is None else (Tissue.MUSCLE, code_of(level_db))
    return _Block(
        np.full(counts[::-1], label, np.uint8),
        np.full(counts[::-1], code, np.uint8),
        spacing_mm,
        first_voxel(counts, spacing_mm, 0.0),
    )


def _paint(
    block: _Block, ends_mm: Float[np.ndarray, "2 3"], radius_mm: float, label: Tissue, code: int
) -> None:
    """Draw a rod or a ball."""
    if not (np.isfinite(ends_mm).all() and np.isfinite(radius_mm) and radius_mm > 0):
        raise ScanError(
            "places in a phantom must be finite numbers and radii above 0 mm, got"
            f" {ends_mm.tolist()} and {radius_mm:g}"
        )
    paint_tube(
        block.tissue,
        block.echogenicity,
        np.array(block.origin_mm),
        block.spacing_mm,
        ends_mm,
        np.full(2, radius_mm),
        int(label),
        np.full(2, float(code)),
        labels_except(),
    )


def _body(name: str, block: _Block, vessels: tuple[Vessel, ...] = ()) -> Body:
    return Body(
        name=name,
        subject=name.replace(" ", "-"),
        tissue=block.tissue,
        echogenicity=block.echogenicity,
        spacing_mm=block.spacing_mm,
        origin_mm=block.origin_mm,
        skin_depth_mm=np.zeros(block.tissue.shape[::2], np.float32),
        vessels=vessels,
    )
