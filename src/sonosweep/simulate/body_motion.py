"""How a body moves while it is scanned: pressure of the probe, the pulse, breathing.

All of it looks the same when time runs backward, so that nothing but the prior can tell which
way a sweep went: slow wandering and sinusoids, and a pulse that falls as it rises.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from sonosweep.errors import ScanError
from sonosweep.simulate.body import Body, Vessel
from sonosweep.simulate.deformation import Deformation, PulsingArtery
from sonosweep.simulate.tissue_motion import body_to_plane
from sonosweep.simulate.wander import Wander, slow_wander

PRESSURE_SCALE_S = 2.0  # over which a hand changes its pressure
LARGEST_STRAIN = 0.25
LARGEST_PULSE = 0.5
PULSE_SHARPNESS = 3  # power of the raised cosine: arteries are wide for a third of a beat
STEEPEST_ARTERY = 0.35  # cosine to the elevational axis; one that lies in the image has no middle


@dataclass(frozen=True)
class BodyMotionSettings:
    """What moves tissue, and how much; nothing by default.

    Attributes:
        strain: Mean axial compression by the probe.
        strain_variation: Standard deviation of its slow changes.
        pulse: By which part of its radius an artery swells with each heart beat.
        heart_rate_hz: Beats per second.
        breathing_mm: How far the body moves to either side of its mean place.
        breathing_rate_hz: Breaths per second.
    """

    strain: float = 0.0
    strain_variation: float = 0.0
    pulse: float = 0.0
    heart_rate_hz: float = 1.1
    breathing_mm: float = 0.0
    breathing_rate_hz: float = 0.25

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ScanError: If one is negative, not a number or too large.
        """
        for name, value in vars(self).items():
            if not (np.isfinite(value) and value >= 0):
                raise ScanError(f"{name} of a body must be 0 or more, got {value:g}")
        if self.strain > LARGEST_STRAIN or self.pulse > LARGEST_PULSE:
            raise ScanError(
                f"a probe compresses tissue by {LARGEST_STRAIN:g} at most and arteries swell by"
                f" {LARGEST_PULSE:g} of their radius at most, got {self.strain:g} and"
                f" {self.pulse:g}"
            )


@dataclass(frozen=True, eq=False)
class BodyMotion:
    """How the body moves at every moment of one sweep.

    Attributes:
        settings: How much.
        pressure: Change of the strain.
        heart_phase_rad: At time 0.
        breathing_phase_rad: At time 0.
        breathing_direction: Unit vector in body coordinates.
    """

    settings: BodyMotionSettings
    pressure: Wander
    heart_phase_rad: float
    breathing_phase_rad: float
    breathing_direction: tuple[float, float, float]

    def pulse_at(self, time_s: float) -> float:
        """Return how far through its swelling an artery is: 0 at rest, 1 at its widest."""
        angle = 2 * np.pi * self.settings.heart_rate_hz * time_s + self.heart_phase_rad
        return float((0.5 + 0.5 * np.cos(angle)) ** PULSE_SHARPNESS)

    def deformation_at(
        self, time_s: float, plane_to_body: Float[np.ndarray, "4 4"], body: Body
    ) -> Deformation:
        """Return how tissue is displaced at a time, under a probe at a place."""
        chosen = self.settings
        change = float(self.pressure(np.array([time_s]))[0])
        strain = float(np.clip(chosen.strain + change, 0.0, LARGEST_STRAIN))
        angle = 2 * np.pi * chosen.breathing_rate_hz * time_s + self.breathing_phase_rad
        breath = chosen.breathing_mm * float(np.sin(angle))
        x, y, z = (breath * part for part in self.breathing_direction)
        still = Deformation((x, y, z), strain)
        swelling = chosen.pulse * self.pulse_at(time_s)
        if swelling == 0:
            return still
        arteries = tuple(
            PulsingArtery(center, radius, swelling * radius)
            for vessel in body.vessels
            if vessel.kind == "artery"
            for center, radius in crossings(vessel, body_to_plane(plane_to_body, still))
        )
        return Deformation(still.shift_mm, strain, arteries)


def draw_body_motion(settings: BodyMotionSettings, generator: np.random.Generator) -> BodyMotion:
    """Return random motion of a body of these sizes."""
    pressure = slow_wander(generator, settings.strain_variation, PRESSURE_SCALE_S)
    heart, breathing = generator.uniform(0, 2 * np.pi, size=2)
    # Mostly up and down, as an arm that rests beside the chest.
    direction = np.array([0.0, 1.0, 0.0]) + generator.normal(0, 0.3, 3)
    x, y, z = (float(part) for part in direction / np.linalg.norm(direction))
    return BodyMotion(settings, pressure, float(heart), float(breathing), (x, y, z))


def crossings(
    vessel: Vessel, affine: Float[np.ndarray, "4 4"]
) -> list[tuple[tuple[float, float], float]]:
    """Return where a vessel crosses the image plane, and the radius of its lumen there.

    Args:
        vessel: Its center line is in body coordinates.
        affine: Body to plane coordinates.

    Returns:
        Lateral and axial place in plane coordinates and the radius, mm, of each crossing
        that is not nearly parallel to the plane.
    """
    line = vessel.centerline_mm @ affine[:3, :3].T + affine[:3, 3]
    found = []
    for k in np.flatnonzero((line[:-1, 2] < 0) != (line[1:, 2] < 0)):
        step = line[k + 1] - line[k]
        if abs(step[2]) < STEEPEST_ARTERY * np.linalg.norm(step):
            continue
        x, y, _ = line[k] - line[k, 2] / step[2] * step
        found.append(((float(x), float(y)), float(vessel.radius_mm[k])))
    return found
