"""Element positions turned from a file's axes into ours: lateral, axial, elevational."""

import numpy as np
from jaxtyping import Float

from sonosweep.errors import FormatError

FLATNESS = 0.05
"""An array in one plane is thinner than this part of its width, and a straight one flatter."""

FARTHEST_M = 100.0


def plane_coordinates(
    positions: Float[np.ndarray, "elements xyz=3"],
    looks_along: Float[np.ndarray, "xyz=3"] | None,
    file_name: str,
) -> Float[np.ndarray, "elements xyz=3"]:
    """Return positions whose axes are lateral, axial and elevational; the origin stays.

    The axes are turned, never mirrored: the axial axis lies in the array's plane, along the
    direction in which the elements look; the first element is on the left.

    Args:
        positions: In meters.
        looks_along: Direction in which the elements look on average; ``None`` looks from
            their middle to the file's origin, or along its last axis from a full ring.
        file_name: For messages.

    Raises:
        FormatError: If the elements do not lie in a plane, or nothing tells which is the
            plane of a straight array.
    """
    check_places(positions, file_name)
    spread = positions - positions.mean(axis=0)
    _, sizes, axes = np.linalg.svd(spread, full_matrices=False)
    if len(sizes) < 3 or sizes[0] == 0:
        raise FormatError(f"the elements of '{file_name}' are not at several places")
    if sizes[2] > FLATNESS * sizes[0]:
        raise FormatError(
            f"the array of '{file_name}' does not lie in a plane: only plane arrays are read"
        )
    size = float(np.ptp(spread @ axes[0]))
    is_straight = sizes[1] < FLATNESS * sizes[0]
    across = axes[0] if is_straight else axes[2]
    axial = _without(-positions.mean(axis=0) if looks_along is None else looks_along, across)
    smallest = FLATNESS * (size if looks_along is None else 1.0)
    if not np.linalg.norm(axial) > smallest:
        if is_straight:
            raise FormatError(f"'{file_name}' does not tell in which direction its elements look")
        axial = max((_without(axis, across) for axis in np.eye(3)), key=_length_then_last)
    axial = axial / np.linalg.norm(axial)
    lateral = axes[0] if is_straight else np.cross(axial, axes[2])
    if (spread[-1] - spread[0]) @ lateral < 0:
        lateral = -lateral
    return positions @ np.column_stack([lateral, axial, np.cross(lateral, axial)])


def check_places(positions_m: Float[np.ndarray, "elements xyz=3"], file_name: str) -> None:
    """Refuse elements that are too few, or so far away that their places must be damaged.

    Raises:
        FormatError: If so.
    """
    if len(positions_m) < 2 or not np.abs(positions_m).max() < FARTHEST_M:
        raise FormatError(
            f"'{file_name}' must tell where at least 2 elements are, in meters and less than"
            f" {FARTHEST_M:g} m from the origin"
        )


def _without(vector: Float[np.ndarray, "3"], axis: Float[np.ndarray, "3"]) -> np.ndarray:
    return vector - (vector @ axis) * axis


def _length_then_last(axis: np.ndarray) -> tuple[float, int]:
    return round(float(np.linalg.norm(axis)), 6), int(abs(axis).argmax())
