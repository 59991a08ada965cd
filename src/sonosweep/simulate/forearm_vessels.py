"""The blood vessels of a forearm: arteries, their branches and veins, veins in the fat.

Everything here is in arm coordinates (see :mod:`sonosweep.simulate.forearm_shape`), center
lines too; points follow the blood, in arteries to the wrist and in veins to the elbow.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy import ndimage

from sonosweep.simulate.body import Vessel
from sonosweep.simulate.forearm_paths import (
    Stations,
    clearance,
    fascia_y,
    keep_inside,
    path_through,
    settle,
    under_skin_y,
)
from sonosweep.simulate.forearm_shape import ArmShape
from sonosweep.simulate.smooth_noise import draw_noise

STEP_MM = 1.0  # between points
BEYOND_MM = 20.0  # that vessels go on past the wrist and the elbow
ELBOW_MM = 250.0 + BEYOND_MM
TRIES = 16  # for a branch that meets no other vessel
ENOUGH_MM = 0.6  # between lumens, for their walls
JOIN_MM = 5.0  # of a branch, in which it may touch the vessel it leaves


def draw_vessels(generator: np.random.Generator, arm: ArmShape) -> tuple[Vessel, ...]:
    """Return the vessels of a new arm."""
    arteries = _draw_arteries(generator, arm)
    vessels = [*arteries, *_draw_companions(generator, arm, arteries)]
    for vessel in _superficial_veins(generator, arm):
        vessels.append(_settled(arm, vessel, arteries))
    for name, parent, count in (("radial", arteries[1], 3), ("ulnar", arteries[2], 3)):
        for number in range(count):
            upward = number == 0
            branch = _draw_branch(generator, arm, parent, vessels, upward=upward)
            vessels.append(replace(branch, name=f"{name} branch {number + 1}"))
    return tuple(vessels)


def _draw_arteries(generator: np.random.Generator, arm: ArmShape) -> tuple[Vessel, ...]:
    """Return brachial, radial and ulnar artery, and the one on the membrane."""
    fork = generator.uniform(200.0, 236.0)
    middle, deep = generator.uniform(-0.02, 0.08), generator.uniform(7.0, 10.0)
    shift = generator.normal(0, 0.03, 4)
    sizes = generator.uniform((1.7, 1.0, 1.05), (2.3, 1.5, 1.6))
    speeds = generator.uniform((90.0, 60.0, 60.0), (180.0, 140.0, 140.0))
    start = (fork, middle, deep)
    above = np.array(((fork - 30, middle + 0.05, deep), start, (300, middle - 0.08, deep - 1)))
    radial = np.array(
        ((-30, 0.46, 1.5), (25, 0.45 + shift[0], 2.2), (125, 0.36 + shift[1], 6.0), start)
    )
    ulnar = np.array(
        ((-30, -0.48, 1.5), (25, -0.46 + shift[2], 4.0), (125, -0.3 + shift[3], 11.0), start)
    )
    down = np.arange(ELBOW_MM, fork, -STEP_MM)
    brachial = _trunk(
        generator, arm, "brachial artery", np.append(down, fork), above, sizes[0], fork
    )
    below = np.append(np.arange(fork, -BEYOND_MM, -STEP_MM), -BEYOND_MM)
    first = _trunk(generator, arm, "radial artery", below, radial, sizes[1], fork)
    second = _trunk(generator, arm, "ulnar artery", below, ulnar, sizes[2], fork)
    trunks = [
        replace(vessel, mean_speed_mm_per_s=float(speed))
        for vessel, speed in zip((brachial, first, second), speeds, strict=True)
    ]
    return (*trunks, _interosseous(generator, arm, trunks))


def _trunk(
    generator: np.random.Generator,
    arm: ArmShape,
    name: str,
    along: Float[np.ndarray, " points"],
    stations: Stations,
    radius_mm: float,
    fork: float,
) -> Vessel:
    """Return an artery; all wander less near the fork, where they meet."""
    points = path_through(arm, along, stations)
    free = np.clip(np.abs(along - fork) / 25, 0, 1)
    points[:, 0] += 1.2 * free * draw_noise(generator, 25.0)(along)
    points[:, 1] += 0.6 * free * draw_noise(generator, 20.0)(along)
    radii = radius_mm * (0.85 + 0.15 * np.clip(along / 250, 0, 1))
    return Vessel(name, "artery", keep_inside(arm, points, radii), radii, 0.0)


def _interosseous(generator: np.random.Generator, arm: ArmShape, trunks: list[Vessel]) -> Vessel:
    """Return the branch of the ulnar artery that runs on the membrane between the bones."""
    ulnar = trunks[2].centerline_mm
    start = ulnar[int(generator.uniform(12, 25))]
    along = np.arange(start[2], generator.uniform(35, 70), -STEP_MM)
    (x0, y0), (x1, y1) = (arm.bone_center(bone, along) for bone in arm.bones)
    target = np.stack(((x0 + x1) / 2, (y0 + y1) / 2 - 2.0, along), axis=1)
    target[:, 0] += 1.0 * draw_noise(generator, 20.0)(along)
    share = 1 - np.exp(-(((start[2] - along) / 18) ** 1.5))
    points = start + share[:, None] * (target - start)
    points[:, 2] = along
    radii = np.linspace(0.85, 0.55, len(along)) * generator.uniform(0.8, 1.1)
    points[1:] = keep_inside(arm, points, radii)[1:]
    return Vessel("interosseous artery", "artery", points, radii, generator.uniform(30, 70))


def _draw_companions(
    generator: np.random.Generator, arm: ArmShape, arteries: tuple[Vessel, ...]
) -> list[Vessel]:
    """Return the two veins beside each artery; those of the radial artery join the others."""
    brachial, radial, ulnar, _ = arteries
    main = [
        _companion(generator, arm, (ulnar, brachial), f"ulnar vein {n + 1}", n) for n in range(2)
    ]
    main = [_settled(arm, vein, arteries) for vein in main]
    joined = []
    for n in range(2):
        vein = _companion(generator, arm, (radial, brachial), f"radial vein {n + 1}", n)
        fork = radial.centerline_mm[0, 2]
        joined.append(_settled(arm, _joining(vein, main[n], fork - 16, fork + 8), arteries))
    return main + joined


def _companion(
    generator: np.random.Generator,
    arm: ArmShape,
    course: tuple[Vessel, Vessel],
    name: str,
    number: int,
) -> Vessel:
    """Return a vein beside arteries that follow one another, from the wrist on."""
    line = np.concatenate([vessel.centerline_mm[::-1] for vessel in course])
    artery = np.concatenate([vessel.radius_mm[::-1] for vessel in course])
    along = line[:, 2]
    radii = generator.uniform(0.55, 0.8) * ndimage.gaussian_filter1d(artery, 15)
    radii *= np.exp(0.12 * draw_noise(generator, 12.0)(along))
    angle = np.pi * number + 0.45 * draw_noise(generator, 35.0)(along) + generator.normal(0, 0.25)
    beside = artery + radii + generator.uniform(0.8, 1.4)
    points = line.copy()
    points[:, 0] += beside * np.cos(angle)
    points[:, 1] += beside * np.sin(angle)
    return Vessel(name, "vein", points, radii, generator.uniform(10, 35))


def _joining(vein: Vessel, into: Vessel, begins_mm: float, ends_mm: float) -> Vessel:
    """Return a vein that bends into another one and ends on its center line."""
    last = int(np.searchsorted(into.centerline_mm[:, 2], ends_mm))
    points = vein.centerline_mm[vein.centerline_mm[:, 2] < ends_mm - STEP_MM / 2]
    goal = np.stack(
        [
            np.interp(points[:, 2], into.centerline_mm[:, 2], into.centerline_mm[:, k])
            for k in (0, 1, 2)
        ],
        axis=1,
    )
    share = np.clip((points[:, 2] - begins_mm) / (ends_mm - begins_mm), 0, 1)
    share = share * share * (3 - 2 * share)
    points = points + share[:, None] * (goal - points)
    points = np.concatenate((points, into.centerline_mm[last : last + 1]))
    radii = np.append(vein.radius_mm[: len(points) - 1], vein.radius_mm[len(points) - 2])
    return replace(vein, centerline_mm=points, radius_mm=radii)


def _superficial_veins(generator: np.random.Generator, arm: ArmShape) -> list[Vessel]:
    """Return three long veins in the fat, and shorter ones that flow into them."""
    along = np.arange(-BEYOND_MM, ELBOW_MM, STEP_MM)
    veins = []
    for name, aside in (("cephalic", 0.55), ("median", 0.02), ("basilic", -0.58)):
        share = aside + generator.normal(0, 0.07) + 0.05 * draw_noise(generator, 45.0)(along)
        x = share * arm.half_width_mm(along) + 0.8 * draw_noise(generator, 14.0)(along)
        trunk = _in_fat(generator, arm, f"{name} vein", x, along, generator.uniform(0.7, 1.5))
        veins.append(trunk)
        for number in range(int(generator.integers(1, 4))):
            veins.append(_tributary(generator, arm, trunk, f"{name} tributary {number + 1}"))
    return veins


def _tributary(
    generator: np.random.Generator,
    arm: ArmShape,
    trunk: Vessel,
    name: str,
) -> Vessel:
    """Return a vein in the fat that flows into another one."""
    joint = int(generator.integers(60, 260))
    length = int(generator.uniform(30, 80))
    first = max(joint - length, 0)
    along = trunk.centerline_mm[first : joint + 1, 2]
    gone = along[-1] - along
    aside = generator.choice((-1, 1)) * generator.uniform(5, 14)
    spread = 1 - np.exp(-gone / generator.uniform(8, 20))
    wander = draw_noise(generator, 14.0)(along)
    x = trunk.centerline_mm[first : joint + 1, 0] + spread * (aside + wander)
    vein = _in_fat(generator, arm, name, x, along, generator.uniform(0.35, 0.7))
    blend = np.exp(-gone / 4)[:, None]
    points = vein.centerline_mm + blend * (trunk.centerline_mm[joint] - vein.centerline_mm[-1])
    return replace(vein, centerline_mm=points)


def _in_fat(
    generator: np.random.Generator,
    arm: ArmShape,
    name: str,
    across: Float[np.ndarray, " points"],
    along: Float[np.ndarray, " points"],
    radius_mm: float,
) -> Vessel:
    """Return a vein in the middle of the fat, as thick as the fat allows."""
    fat = arm.fat_below(across, along)
    radii = np.clip(radius_mm * np.exp(0.1 * draw_noise(generator, 15.0)(along)), 0.3, 0.4 * fat)
    depth = arm.skin_mm + np.maximum(fat * generator.uniform(0.4, 0.7), radii + 0.3)
    y = under_skin_y(arm, across, along, depth)
    points = np.stack((across, y, along), axis=1)
    return Vessel(name, "vein", points, radii, generator.uniform(8, 30))


def _draw_branch(
    generator: np.random.Generator,
    arm: ArmShape,
    parent: Vessel,
    others: list[Vessel],
    *,
    upward: bool,
) -> Vessel:
    """Return a branch of an artery that meets no other vessel, the freest of some tries."""
    branches, rooms = [], []
    for _ in range(TRIES):
        branches.append(_try_branch(generator, arm, parent, upward))
        beyond = slice(int(JOIN_MM / STEP_MM), None)
        points, radii = branches[-1].centerline_mm[beyond], branches[-1].radius_mm[beyond]
        off_bone = float((arm.bone_distance(*points.T) - radii).min())
        rooms.append(min(clearance(points, radii, others), off_bone))
        if rooms[-1] > ENOUGH_MM:
            break
    return branches[int(np.argmax(rooms))]


def _try_branch(
    generator: np.random.Generator,
    arm: ArmShape,
    parent: Vessel,
    upward: bool,
) -> Vessel:
    """Return a branch that leaves at a random place and angle."""
    start = int(generator.integers(25, len(parent.radius_mm) - 60))
    origin = parent.centerline_mm[start]
    onward = parent.centerline_mm[start + 4] - origin
    onward /= np.linalg.norm(onward)
    length = generator.uniform(22, 50)
    gone = np.arange(0, length, STEP_MM)
    angle = -np.pi / 2 + generator.normal(0, 0.3) if upward else generator.uniform(-np.pi, np.pi)
    depth = origin[1] - float(fascia_y(arm, origin[:1], origin[2:])[0])
    reach = max(depth + 1.0, 3.0) if upward else generator.uniform(6, 13)
    direction = np.array((np.cos(angle), np.sin(angle), 0.0))
    aside = reach * (1 - np.exp(-gone / generator.uniform(6, 12)))
    points = origin + gone[:, None] * onward + aside[:, None] * direction
    settled = 1 - np.exp(-gone / 8)
    points[:, 0] += 0.7 * settled * draw_noise(generator, 12.0)(gone)
    points[:, 1] += 0.4 * settled * draw_noise(generator, 12.0)(gone)
    thickest = generator.uniform(0.45, 0.65) * parent.radius_mm[start]
    radii = np.linspace(max(thickest, 0.4), 0.3, len(gone))
    points[3:] = keep_inside(arm, points, radii)[3:]
    return Vessel("", "artery", points, radii, generator.uniform(20, 60))


def _settled(arm: ArmShape, vein: Vessel, arteries: tuple[Vessel, ...]) -> Vessel:
    """Return a vein moved off the bones, the skin and the arteries."""
    points = settle(arm, vein.centerline_mm, vein.radius_mm, arteries)
    return replace(vein, centerline_mm=points)
