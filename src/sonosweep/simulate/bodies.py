"""Bodies by name: the forearms of a subject, and phantoms long enough for a sweep."""

from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import numpy as np

from sonosweep.errors import ScanError
from sonosweep.simulate.body import Body
from sonosweep.simulate.coded_voxels import codes_and_values
from sonosweep.simulate.forearm import forearm
from sonosweep.simulate.phantoms import (
    WIRES,
    cyst_phantom,
    uniform_phantom,
    vessel_phantom,
    wire_phantom,
)

BodyName = Literal["forearm", "uniform", "wires", "cysts", "vessels"]
Side = Literal["left", "right"]

PHANTOM_MM = (80.0, 45.0)  # across and deep: as wide as an arm
BACKGROUND_DB = -10.0  # of what is around wires
LONGEST_MM = 400.0


def named_body(
    name: BodyName, subject: int = 0, side: Side = "right", length_mm: float = 120.0
) -> Body:
    """Return what is to be scanned.

    Args:
        name: Which kind.
        subject: Number of the subject, for a forearm.
        side: Which forearm; the two of a subject mirror each other.
        length_mm: Extent of a phantom along the sweep; a forearm has 250 mm.

    Raises:
        ScanError: If there is no such body.
    """
    if name == "forearm":
        body = forearm(subject)
        return body if side == "right" else _mirrored(body)
    if name not in PHANTOMS:
        raise ScanError(f"there is no body '{name}'; known are forearm, {', '.join(PHANTOMS)}")
    if not 0 < length_mm <= LONGEST_MM:
        raise ScanError(f"a phantom is up to {LONGEST_MM:g} mm long, got {length_mm:g} mm")
    return PHANTOMS[name]((*PHANTOM_MM, length_mm))


def _wires(size_mm: tuple[float, float, float]) -> Body:
    ends = (-size_mm[2] / 2, size_mm[2] / 2)
    wires = [((x, y, ends[0]), (x, y, ends[1])) for (x, y, _), _ in WIRES]
    return wire_phantom(wires, size_mm, background_db=BACKGROUND_DB)


PHANTOMS: dict[str, Callable[[tuple[float, float, float]], Body]] = {
    "uniform": lambda size_mm: uniform_phantom(size_mm, spacing_mm=1.0),
    "wires": _wires,
    "cysts": lambda size_mm: cyst_phantom(size_mm=size_mm),
    "vessels": lambda size_mm: vessel_phantom(size_mm=size_mm),
}


def _mirrored(body: Body) -> Body:
    """Return the body as a mirror across x shows it; its voxels are turned where they are."""
    arrays = (codes_and_values(voxels)[0] for voxels in (body.tissue, body.echogenicity))
    for slices in {id(array): array for array in arrays}.values():
        for voxels in slices:  # a second set of voxels would need much memory
            voxels[:] = voxels[:, ::-1].copy()
    x, y, z = body.origin_mm
    last = x + body.spacing_mm * (body.tissue.shape[2] - 1)
    flip = np.array([-1.0, 1.0, 1.0])
    return replace(
        body,
        origin_mm=(-last, y, z),
        skin_depth_mm=np.ascontiguousarray(body.skin_depth_mm[:, ::-1]),
        vessels=tuple(
            replace(vessel, centerline_mm=vessel.centerline_mm * flip) for vessel in body.vessels
        ),
    )
