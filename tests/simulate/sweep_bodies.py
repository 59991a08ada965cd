"""A small arm made by hand, so that tests of sweeps need no forearm."""

from typing import Literal

import numpy as np

from sonosweep.imaging import centered_grid
from sonosweep.simulate import REFERENCE_CODE, Body, Tissue, Vessel
from sonosweep.simulate.motion import MotionSettings

SMALL_GRID = centered_grid(96, 96, (0.25, 0.25), 0.5)
SKIN_MM = 1.0
ARTERY_MM, ARTERY_RADIUS_MM = (-4.0, 8.0), 1.2
VESSEL_SLOPE = 0.25
VEIN_MM, VEIN_RADIUS_MM = (5.0, 12.0), 1.5


def block(
    code: int = REFERENCE_CODE,
    size_mm: tuple[float, float, float] = (40.0, 32.0, 30.0),
    spacing_mm: float = 0.25,
) -> Body:
    """Return uniform muscle from y = 0 down, around x = 0 and z = 0."""
    shape = tuple(round(size / spacing_mm) for size in size_mm[::-1])
    return Body(
        name="block",
        subject="simulated-900001",
        tissue=np.full(shape, int(Tissue.MUSCLE), np.uint8),
        echogenicity=np.full(shape, code, np.uint8),
        spacing_mm=spacing_mm,
        origin_mm=(-spacing_mm * (shape[2] - 1) / 2, 0.0, -spacing_mm * (shape[0] - 1) / 2),
        skin_depth_mm=np.zeros((shape[0], shape[2]), np.float32),
    )


def arm(spacing_mm: float = 0.25, muscle_db: float = -8.0) -> Body:
    """Return muscle under skin, with an artery and a vein along z."""
    body = block(REFERENCE_CODE + round(muscle_db * 4), spacing_mm=spacing_mm)
    tissue, echo = np.asarray(body.tissue), np.asarray(body.echogenicity)
    z, y, x = (
        origin + spacing_mm * np.arange(count)
        for origin, count in zip(body.origin_mm[::-1], tissue.shape, strict=True)
    )
    tissue[:, y < SKIN_MM] = int(Tissue.SKIN)
    echo[:, y < SKIN_MM] = REFERENCE_CODE + 20
    vessels = []
    for name, label, (across, deep), radius, speed in (
        ("artery", Tissue.ARTERY, ARTERY_MM, ARTERY_RADIUS_MM, 300.0),
        ("vein", Tissue.VEIN, VEIN_MM, VEIN_RADIUS_MM, 150.0),
    ):
        middle = deep + VESSEL_SLOPE * z[:, np.newaxis, np.newaxis]
        lumen = np.hypot(x - across, y[:, np.newaxis] - middle) < radius
        tissue[lumen], echo[lumen] = int(label), REFERENCE_CODE - 160
        # Not quite upright to the image, as vessels are, so that flow has an axial part.
        line = np.stack([np.full(z.shape, across), deep + VESSEL_SLOPE * z, z], axis=1)
        kind: Literal["artery", "vein"] = "artery" if label == Tissue.ARTERY else "vein"
        vessels.append(Vessel(name, kind, line, np.full(len(z), radius), speed))
    return Body(
        body.name,
        body.subject,
        tissue,
        echo,
        body.spacing_mm,
        body.origin_mm,
        body.skin_depth_mm,
        tuple(vessels),
    )


def steady(frames: int = 12, length_mm: float = 6.0, **changes: float) -> MotionSettings:
    """Return a straight sweep as of a robot's arm."""
    chosen = {"speed_variation": 0.0, "hand_unsteadiness": 0.0, "tremor_mm": 0.0, **changes}
    return MotionSettings(
        shape="straight",
        length_mm=length_mm,
        frames=frames,
        pauses=0,
        contact_width_mm=24.0,
        **chosen,  # type: ignore[arg-type]
    )
