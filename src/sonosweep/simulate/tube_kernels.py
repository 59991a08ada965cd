"""Loops that draw tubes and nerves into voxels."""

import math
from typing import no_type_check

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
@no_type_check
def paint_tube(tissue, echo, origin, spacing, points, radii, label, codes, replaceable):
    """Label the voxels whose centers are within a tube.

    Args:
        tissue: Labels, ``(z, y, x)``.
        echo: Echogenicity codes.
        origin: x, y, z of the center of the first voxel.
        spacing: Size of a voxel.
        points: Along the tube's middle, x, y, z; straight between them.
        radii: At each point, linear between them.
        label: To write.
        codes: To write where the tube's side faces sideways, and where up or down.
        replaceable: Per label, whether it may be overwritten.
    """
    low, high = np.empty(3, np.int64), np.empty(3, np.int64)
    size = np.array((tissue.shape[2], tissue.shape[1], tissue.shape[0]))
    axis, place = np.empty(3), np.empty(3)
    for n in range(points.shape[0] - 1):
        widest = max(radii[n], radii[n + 1])
        square = 1e-12
        for k in range(3):
            first, last = points[n, k], points[n + 1, k]
            axis[k] = last - first
            square += axis[k] * axis[k]
            low[k] = max(0, math.ceil((min(first, last) - widest - origin[k]) / spacing))
            high[k] = min(
                size[k], math.floor((max(first, last) + widest - origin[k]) / spacing) + 1
            )
        for iz in range(low[2], high[2]):
            place[2] = origin[2] + iz * spacing - points[n, 2]
            for iy in range(low[1], high[1]):
                place[1] = origin[1] + iy * spacing - points[n, 1]
                for ix in range(low[0], high[0]):
                    place[0] = origin[0] + ix * spacing - points[n, 0]
                    share = place[0] * axis[0] + place[1] * axis[1] + place[2] * axis[2]
                    share = min(max(share / square, 0.0), 1.0)
                    radius = radii[n] + share * (radii[n + 1] - radii[n])
                    away = 0.0
                    for k in range(3):
                        away += (place[k] - share * axis[k]) ** 2
                    if away <= radius * radius and replaceable[tissue[iz, iy, ix]]:
                        facing = (place[1] - share * axis[1]) ** 2 / (away + 1e-12)
                        tissue[iz, iy, ix] = label
                        echo[iz, iy, ix] = np.uint8(codes[0] + facing * (codes[1] - codes[0]))


@njit(cache=True, nogil=True)
@no_type_check
def paint_nerve(tissue, echo, origin, spacing, ellipses, fascicles, label, codes, replaceable):
    """Draw a nerve: dark bundles in bright tissue, in every slice.

    Args:
        tissue: Labels, ``(z, y, x)``.
        echo: Echogenicity codes.
        origin: x, y, z of the center of the first voxel.
        spacing: Size of a voxel.
        ellipses: Per slice x, y of the middle, half width, half height, turn, and by how
            much the bundles are turned within.
        fascicles: Middle and radius of the bundles, as shares of the nerve's.
        label: To write.
        codes: Of bundles, and of the tissue between and around.
        replaceable: Per label, whether it may be overwritten.
    """
    for iz in range(tissue.shape[0]):
        x, y, wide, high, turn, twist = ellipses[iz]
        cos, sin = math.cos(turn), math.sin(turn)
        reach = max(wide, high)
        first_row = max(0, math.ceil((y - reach - origin[1]) / spacing))
        last_row = min(tissue.shape[1], math.floor((y + reach - origin[1]) / spacing) + 1)
        first = max(0, math.ceil((x - reach - origin[0]) / spacing))
        last = min(tissue.shape[2], math.floor((x + reach - origin[0]) / spacing) + 1)
        for iy in range(first_row, last_row):
            for ix in range(first, last):
                aside, down = origin[0] + ix * spacing - x, origin[1] + iy * spacing - y
                u, v = (cos * aside + sin * down) / wide, (cos * down - sin * aside) / high
                if u * u + v * v > 1 or not replaceable[tissue[iz, iy, ix]]:
                    continue
                s = math.cos(twist) * u + math.sin(twist) * v
                t = math.cos(twist) * v - math.sin(twist) * u
                code = codes[1]
                for f in range(fascicles.shape[0]):
                    off = (s - fascicles[f, 0]) ** 2 + (t - fascicles[f, 1]) ** 2
                    if off < fascicles[f, 2] ** 2:
                        code = codes[0]
                tissue[iz, iy, ix] = label
                echo[iz, iy, ix] = code
