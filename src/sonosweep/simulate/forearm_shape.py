"""The outer form of a forearm: skin, layers, and the two bones.

Arm coordinates, used while a forearm is drawn: ``across`` from the middle of a right arm
toward the thumb, ``y`` into the arm, ``along`` from the wrist (0) to the elbow (250 mm).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.interpolate import PchipInterpolator

from sonosweep.simulate.smooth_noise import SmoothNoise, draw_noise

ARM_LENGTH_MM = 250.0
Field = Float[np.ndarray, "..."]


@dataclass(frozen=True, eq=False)
class BoneShape:
    """A bone of elliptic cross-section with a crest toward its neighbor.

    Attributes:
        across: Of its middle, in half widths of the arm, along the arm.
        depth: Of its middle, in thicknesses of the arm, along the arm.
        half_width_mm: Along the arm.
        half_height_mm: Along the arm.
        side: +1 for the one on the side of the thumb, -1 for the other.
        crest: How much farther it reaches toward its neighbor.
    """

    across: PchipInterpolator
    depth: PchipInterpolator
    half_width_mm: PchipInterpolator
    half_height_mm: PchipInterpolator
    side: float
    crest: float


@dataclass(frozen=True, eq=False)
class ArmShape:
    """Size and layers of one arm.

    Attributes:
        half_width_mm: Along the arm.
        thickness_mm: Along the arm.
        flatness: Exponent of the superellipse that is its cross-section on the probe's
            side; 2 is an ellipse.
        crest_mm: y of the skin's highest line along the arm.
        skin_mm: Thickness of the skin.
        fat_mm: Mean thickness of the fat beneath it.
        fat_noise: Unevenness of the fat, of (along, across).
        bones: Radius and ulna.
        bone_noise: Unevenness of their surfaces.
    """

    half_width_mm: PchipInterpolator
    thickness_mm: PchipInterpolator
    flatness: float
    crest_mm: SmoothNoise
    skin_mm: float
    fat_mm: float
    fat_noise: SmoothNoise
    bones: tuple[BoneShape, BoneShape]
    bone_noise: SmoothNoise

    def skin_y(self, across_mm: Field, along_mm: Field) -> Field:
        """Return y of the outer skin surface; beside the arm, that of its middle."""
        share = np.minimum(np.abs(across_mm) / self.half_width_mm(along_mm), 1.0)
        height = (1 - share**self.flatness) ** (1 / self.flatness)
        half = self.thickness_mm(along_mm) / 2
        return self._crest(along_mm) + half * (1 - height)

    def skin_distance(self, across_mm: Field, y_mm: Field, along_mm: Field) -> Field:
        """Return the distance below the outer skin surface; negative outside."""
        half = self.thickness_mm(along_mm) / 2
        width = self.half_width_mm(along_mm)
        up = (y_mm - self._crest(along_mm) - half) / half
        power = np.where(up < 0, self.flatness, 2.0)
        aside = np.abs(across_mm) / width + 1e-6
        up = np.abs(up) + 1e-6
        radius = (aside**power + up**power) ** (1 / power)
        slope = np.hypot(
            (aside / radius) ** (power - 1) / width, (up / radius) ** (power - 1) / half
        )
        return (1 - radius) / slope

    def fat_below(self, across_mm: Field, along_mm: Field) -> Field:
        """Return the thickness of the fat."""
        uneven = np.exp(0.28 * self.fat_noise(along_mm, across_mm))
        return np.maximum(self.fat_mm * uneven, 0.9)

    def middle_y(self, along_mm: Field) -> Field:
        """Return y of the middle of the arm, half of its thickness down."""
        return self._crest(along_mm) + self.thickness_mm(along_mm) / 2

    def bone_center(self, bone: BoneShape, along_mm: Field) -> tuple[Field, Field]:
        """Return across and y of a bone's middle."""
        y = self._crest(along_mm) + bone.depth(along_mm) * self.thickness_mm(along_mm)
        return bone.across(along_mm) * self.half_width_mm(along_mm), y

    def bone_distance(self, across_mm: Field, y_mm: Field, along_mm: Field) -> Field:
        """Return the distance from the nearest bone's surface; negative inside."""
        bump = 0.5 * self.bone_noise(along_mm, y_mm, across_mm)
        each = [self._distance_from(bone, across_mm, y_mm, along_mm) for bone in self.bones]
        return np.minimum(*each) + bump

    def membrane_distance(self, across_mm: Field, y_mm: Field, along_mm: Field) -> Field:
        """Return the signed distance from the membrane between the bones."""
        (x0, y0), (x1, y1) = (self.bone_center(bone, along_mm) for bone in self.bones)
        share = (across_mm - x1) / (x0 - x1)
        off = y_mm - (y1 + (y0 - y1) * np.clip(share, 0, 1))
        beside = np.maximum(np.abs(share - 0.5) - 0.5, 0) * np.abs(x0 - x1)
        return off * (1 + 50 * beside**2)

    def _crest(self, along_mm: Field) -> Field:
        """Return y of the highest line, 0 in the middle of the arm."""
        middle = self.crest_mm(np.array([ARM_LENGTH_MM / 2]))[0]
        return 0.9 * (self.crest_mm(along_mm) - middle)

    def _distance_from(self, bone: BoneShape, across: Field, y: Field, along: Field) -> Field:
        x0, y0 = self.bone_center(bone, along)
        wide, high = bone.half_width_mm(along), bone.half_height_mm(along)
        aside, up = across - x0 + 1e-6, y - y0 + 1e-6
        inward = -bone.side * aside / np.hypot(aside, up)
        grown = 1 + bone.crest * np.maximum(inward, 0) ** 4
        radius = np.hypot(aside / wide, up / high)
        return (radius - grown) * radius / np.hypot(aside / wide**2, up / high**2)


def draw_shape(generator: np.random.Generator) -> ArmShape:
    """Return the form of a new arm."""
    size = generator.uniform(0.9, 1.1)
    fat_mm = generator.uniform(1.6, 6.5)
    wrist, belly, elbow = size * generator.uniform((36, 43, 43), (40, 47, 47))
    flat = generator.uniform(0.60, 0.70)
    return ArmShape(
        half_width_mm=_along(wrist, (wrist + belly) / 2, belly, elbow),
        thickness_mm=_along(*(2 * flat * np.array([0.88 * wrist, 0.95 * belly, belly, elbow]))),
        flatness=generator.uniform(2.4, 3.0),
        crest_mm=draw_noise(generator, 45.0),
        skin_mm=generator.uniform(1.0, 1.7),
        fat_mm=fat_mm,
        fat_noise=draw_noise(generator, 35.0, 18.0),
        bones=_draw_bones(generator, size),
        bone_noise=draw_noise(generator, 15.0, 4.0, 4.0),
    )


def _along(*values: float) -> PchipInterpolator:
    """Return what has these values at the wrist, a third and two thirds up, and the elbow."""
    places = np.array([-30.0, 0, 80, 160, 250, 280])
    return PchipInterpolator(places, [values[0], *values, values[-1]])


def _draw_bones(generator: np.random.Generator, size: float) -> tuple[BoneShape, BoneShape]:
    apart, depth = generator.uniform(0.36, 0.46), generator.uniform(0.50, 0.57)
    grown = size * generator.uniform(0.92, 1.08, 2)
    radius = BoneShape(
        across=_along(apart * 0.95, apart, apart * 0.95, apart * 0.62),
        depth=_along(depth * 0.95, depth, depth * 0.98, depth * 0.94),
        half_width_mm=_along(*(grown[0] * np.array([11.0, 7.0, 6.5, 8.5]))),
        half_height_mm=_along(*(grown[0] * np.array([7.0, 6.0, 6.0, 7.5]))),
        side=1.0,
        crest=generator.uniform(0.15, 0.35),
    )
    ulna = BoneShape(
        across=_along(-apart * 1.05, -apart, -apart * 0.95, -apart * 0.6),
        depth=_along(depth * 1.02, depth * 1.04, depth * 1.06, depth * 1.08),
        half_width_mm=_along(*(grown[1] * np.array([6.5, 6.0, 7.0, 10.0]))),
        half_height_mm=_along(*(grown[1] * np.array([6.0, 6.0, 7.0, 9.5]))),
        side=-1.0,
        crest=generator.uniform(0.15, 0.35),
    )
    return radius, ulna
