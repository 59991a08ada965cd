"""How the face of a probe rests on the skin."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy import ndimage

from sonosweep.simulate.body import Body

SMOOTHING_MM = 3.0  # the probe does not follow pores and hairs
OFFSETS = 25  # points along the face at which the skin is felt
PITCH_ARM_MM = 5.0  # how far before and behind the face its slope is felt
SOFTNESS_MM = 0.3  # over which the highest points of the skin share the load
STEEPEST_RAD = np.deg2rad(25.0)


@dataclass(frozen=True, eq=False)
class Contact:
    """The face's place for each frame.

    Attributes:
        depth_mm: Body y of the face's middle when it just touches.
        pitch_rad: Turn about the lateral axis that lays it on the skin.
        roll_rad: Turn about the elevational axis that does.
    """

    depth_mm: Float[np.ndarray, " frames"]
    pitch_rad: Float[np.ndarray, " frames"]
    roll_rad: Float[np.ndarray, " frames"]


@dataclass(frozen=True, eq=False)
class Skin:
    """The smoothed outer surface of a body.

    Attributes:
        depth_mm: Body y on the voxels' (z, x) grid.
        spacing_mm: Of the voxels.
        origin_mm: Body x and z of the first voxel.
    """

    depth_mm: Float[np.ndarray, "z x"]
    spacing_mm: float
    origin_mm: tuple[float, float]

    def at(
        self, across_mm: Float[np.ndarray, "*places"], along_mm: Float[np.ndarray, "*places"]
    ) -> Float[np.ndarray, "*places"]:
        """Return the depth at these places; beyond the edge it is that of the edge."""
        rows = (along_mm - self.origin_mm[1]) / self.spacing_mm
        columns = (across_mm - self.origin_mm[0]) / self.spacing_mm
        return ndimage.map_coordinates(
            self.depth_mm, np.stack([rows, columns]), order=1, mode="nearest"
        )


def skin_of(body: Body) -> Skin:
    """Return the surface on which a probe slides."""
    depth = ndimage.gaussian_filter(
        body.skin_depth_mm.astype(np.float64), SMOOTHING_MM / body.spacing_mm, mode="nearest"
    )
    return Skin(depth, body.spacing_mm, (body.origin_mm[0], body.origin_mm[2]))


def lay_on_skin(
    skin: Skin,
    across_mm: Float[np.ndarray, " frames"],
    along_mm: Float[np.ndarray, " frames"],
    yaw_rad: Float[np.ndarray, " frames"],
    width_mm: float,
) -> Contact:
    """Return where a flat face touches: upright to the skin, on its highest points.

    Args:
        skin: The surface.
        across_mm: Body x of the face's middle.
        along_mm: Body z of the face's middle.
        yaw_rad: Turn of the lateral axis about body y, from body x.
        width_mm: Length of the face that rests on the skin.
    """
    cos, sin = np.cos(yaw_rad)[:, None], np.sin(yaw_rad)[:, None]
    offsets = np.linspace(-width_mm / 2, width_mm / 2, OFFSETS)
    # A turn about y takes x to (cos, 0, -sin) and z to (sin, 0, cos).
    felt = skin.at(across_mm[:, None] + cos * offsets, along_mm[:, None] - sin * offsets)
    lean = offsets * np.exp(-0.5 * (4 * offsets / width_mm) ** 2)  # mostly on its middle
    slope = _gentle(felt @ lean / (offsets @ lean))
    arms = np.array([-PITCH_ARM_MM, PITCH_ARM_MM])
    ends = skin.at(across_mm[:, None] + sin * arms, along_mm[:, None] + cos * arms)
    rise = _gentle((ends[:, 1] - ends[:, 0]) / (2 * PITCH_ARM_MM))
    above = felt - slope[:, None] * offsets
    highest = above.min(axis=1, keepdims=True)
    load = np.exp((highest - above) / SOFTNESS_MM).mean(axis=1)
    depth = highest[:, 0] - SOFTNESS_MM * np.log(load)
    return Contact(depth, pitch_rad=-np.arctan(rise), roll_rad=np.arctan(slope))


def _gentle(slope: np.ndarray) -> np.ndarray:
    """Return a slope that is never steeper than a hand would tilt the probe."""
    steepest = np.tan(STEEPEST_RAD)
    return steepest * np.tanh(slope / steepest)
