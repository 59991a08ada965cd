"""How many voxels a body has, and where they are."""

import math

from sonosweep.errors import ScanError

Point = tuple[float, float, float]
MOST_VOXELS = 150_000_000  # of one body, which then takes 300 MB


def voxel_counts(name: str, size_mm: Point, spacing_mm: float) -> tuple[int, int, int]:
    """Return the number of voxels along x, y and z.

    Raises:
        ScanError: If a number is not positive and finite, or memory would not do.
    """
    for what, value in zip(("width", "depth", "length"), size_mm, strict=True):
        if not (math.isfinite(value) and value > 0):
            raise ScanError(f"phantom '{name}' is empty: its {what} must be above 0, got {value:g}")
    if not (math.isfinite(spacing_mm) and spacing_mm > 0):
        raise ScanError(f"voxel size must be above 0 mm, got {spacing_mm:g}")
    if math.prod(size_mm) / spacing_mm**3 > MOST_VOXELS:
        raise ScanError(
            f"phantom '{name}' of {size_mm[0]:g} x {size_mm[1]:g} x {size_mm[2]:g} mm has more"
            f" than {MOST_VOXELS} voxels of {spacing_mm:g} mm: make it smaller or voxels larger"
        )
    x, y, z = (max(1, round(value / spacing_mm)) for value in size_mm)
    return x, y, z


def first_voxel(counts: tuple[int, int, int], spacing_mm: float, top_mm: float) -> Point:
    """Return the center of voxel (0, 0, 0) of a block centered in x and z.

    Args:
        counts: Voxels along x, y and z.
        spacing_mm: Their size.
        top_mm: y of the block's upper side.
    """
    x, _, z = counts
    return -spacing_mm * (x - 1) / 2, top_mm + spacing_mm / 2, -spacing_mm * (z - 1) / 2
