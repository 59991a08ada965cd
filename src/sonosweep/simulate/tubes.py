"""Vessels drawn into voxels, so that labels and center lines agree."""

import numpy as np
from jaxtyping import Bool, UInt8

from sonosweep.simulate.body import REFERENCE_CODE, Tissue, Vessel
from sonosweep.simulate.tube_kernels import paint_tube

BLOOD_DB = -34.0
ARTERY_WALL_DB = (-3.0, 4.0)  # at the sides of a vessel, and where the beam meets it upright
VEIN_WALL_DB = (-7.0, 1.0)
ARTERY_WALL_MM = 0.3
VEIN_WALL_MM = 0.18


def code_of(level_db: float) -> int:
    """Return the echogenicity code of a level in dB of amplitude 1."""
    return int(np.clip(round(REFERENCE_CODE + 4 * level_db), 1, 255))


def labels_except(*kept: Tissue) -> Bool[np.ndarray, " labels"]:
    """Return per label whether it may be overwritten: all but ``kept``."""
    replaceable = np.ones(len(Tissue), np.bool_)
    replaceable[list(kept)] = False
    return replaceable


def paint_vessels(
    tissue: UInt8[np.ndarray, "z y x"],
    echogenicity: UInt8[np.ndarray, "z y x"],
    origin_mm: tuple[float, float, float],
    spacing_mm: float,
    vessels: tuple[Vessel, ...],
) -> None:
    """Draw walls, then veins, then arteries, so that lumens are joined where vessels meet.

    A voxel is in a lumen if its center is within the radius of a center line. Walls leave
    skin and bone as they are.
    """
    walls = labels_except(Tissue.OUTSIDE, Tissue.GEL, Tissue.SKIN, Tissue.BONE)
    everything = labels_except()
    ordered = sorted(vessels, key=lambda vessel: vessel.kind == "artery")
    for lumen in (False, True):
        for vessel in ordered:
            artery = vessel.kind == "artery"
            thickness = ARTERY_WALL_MM if artery else VEIN_WALL_MM
            levels = ARTERY_WALL_DB if artery else VEIN_WALL_DB
            label, radius, replaceable = Tissue.VESSEL_WALL, vessel.radius_mm, walls
            if lumen:
                label, levels = Tissue[vessel.kind.upper()], (BLOOD_DB, BLOOD_DB)
                replaceable = everything
            else:
                radius = radius + max(thickness, 0.6 * spacing_mm)
            paint_tube(
                tissue,
                echogenicity,
                np.array(origin_mm),
                spacing_mm,
                vessel.centerline_mm.astype(np.float64),
                radius.astype(np.float64),
                int(label),
                np.array([float(code_of(level)) for level in levels]),
                replaceable,
            )
