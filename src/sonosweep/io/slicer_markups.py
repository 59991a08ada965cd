"""A trajectory as a curve that 3D Slicer draws (``.mrk.json``).

The points are the centers of the frames, or their origins, in LPS by the world rule.
"""

import json
import os
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from sonosweep.geometry import transform_points
from sonosweep.io.atomic import write_beside
from sonosweep.io.world import World, reference_to_lps
from sonosweep.scan import Trajectory

SCHEMA = (
    "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources"
    "/Schema/markups-schema-v1.0.3.json#"
)
# Slicer redraws all control points at every move of the mouse; more of them make it slow.
MOST_POINTS = 1000
YELLOW = (1.0, 0.8, 0.2)


def write_slicer_curve(
    trajectory: Trajectory,
    path: str | os.PathLike,
    world: World = "ras",
    point_mm: tuple[float, float] = (0.0, 0.0),
    name: str = "trajectory",
) -> None:
    """Write the way of one point of the image as an open curve.

    Long trajectories are thinned evenly to a thousand points, first and last kept.

    Args:
        trajectory: What to draw.
        path: Ends in ``.mrk.json``.
        world: How our reference is stated as LPS.
        point_mm: The point, lateral and axial; give the center of the frame to follow it.
            The default is the origin, which is the center of the first pixel.
        name: What Slicer calls the curve.

    Raises:
        FormatError: If the file cannot be written.
    """
    frames = len(trajectory.image_to_reference)
    chosen = torch.linspace(0, frames - 1, min(frames, MOST_POINTS)).round().long()
    point = torch.tensor([[*point_mm, 0.0]], dtype=torch.float64)
    turn = torch.from_numpy(reference_to_lps(world).copy())
    poses = trajectory.image_to_reference[chosen].to(torch.float64)
    points_lps = transform_points(poses, point)[:, 0] @ turn
    markup = {
        "type": "Curve",
        "coordinateSystem": "LPS",
        "coordinateUnits": "mm",
        "locked": True,
        "fixedNumberOfControlPoints": False,
        "labelFormat": "%N-%d",
        "curve": {"type": "linear"},
        "controlPoints": _control_points(points_lps, chosen.tolist()),
        "display": {
            "visibility": True,
            "color": YELLOW,
            "selectedColor": YELLOW,
            "pointLabelsVisibility": False,
            "propertiesLabelVisibility": False,
            "glyphScale": 0.5,
            "lineThickness": 0.3,
        },
    }
    document = {"@schema": SCHEMA, "markups": [{"name": name, **markup}]}
    with write_beside(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        json.dump(document, file, indent=1)


def _control_points(
    points_lps_mm: Float[Tensor, "points xyz=3"], frames: list[int]
) -> list[dict[str, Any]]:
    return [
        {
            "id": str(number + 1),
            "label": f"frame {frame}",
            "position": [value + 0.0 for value in position],
            "selected": True,
            "locked": True,
            "visibility": True,
            "positionStatus": "defined",
        }
        for number, (frame, position) in enumerate(zip(frames, points_lps_mm.tolist(), strict=True))
    ]
