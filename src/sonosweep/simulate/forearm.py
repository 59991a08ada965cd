"""Forearms: a different one for each subject, continuous over 250 mm.

An arm is drawn in arm coordinates (see :mod:`sonosweep.simulate.forearm_shape`) and then put
into the body's, as a left or a right one, with z toward the elbow or toward the wrist.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8

from sonosweep.errors import ScanError
from sonosweep.simulate.body import Body, Tissue, Vessel
from sonosweep.simulate.coded_voxels import CodedVoxels
from sonosweep.simulate.forearm_fields import (
    CELLS_MM,
    COARSE_MM,
    coarse_fields,
    draw_tables,
    draw_tones,
)
from sonosweep.simulate.forearm_kernels import fill_forearm
from sonosweep.simulate.forearm_muscles import muscle_table
from sonosweep.simulate.forearm_nerves import BUNDLE_DB, NERVE_DB, Nerve, draw_nerves
from sonosweep.simulate.forearm_palette import forearm_palette
from sonosweep.simulate.forearm_shape import ARM_LENGTH_MM, ArmShape, draw_shape
from sonosweep.simulate.forearm_vessels import draw_vessels
from sonosweep.simulate.seeds import generator, subject_name
from sonosweep.simulate.tube_kernels import paint_nerve
from sonosweep.simulate.tubes import code_of, labels_except, paint_vessels
from sonosweep.simulate.voxels import Point, first_voxel, voxel_counts

ABOVE_SKIN_MM = 4.0  # of gel above the crest of the skin
LARGEST_LENGTH_MM = 280.0
SLICES_AT_ONCE = 32

Codes = UInt8[np.ndarray, "z y x"]


def forearm(
    subject: int,
    *,
    spacing_mm: float = 0.3,
    width_mm: float = 90.0,
    depth_mm: float = 50.0,
    length_mm: float = ARM_LENGTH_MM,
) -> Body:
    """Return the forearm of a subject, the flexor side up.

    The middle of the arm is at x = 0 and z = 0, and the skin there at y = 0, with 4 mm of
    gel above. Subjects differ in size, fat, the places of muscles, bones and vessels, in
    echogenicity, in left and right, and in whether z runs to the elbow or to the wrist.
    A subject's anatomy is the same on every grid, but for what is thinner than a voxel.

    Args:
        subject: Number of the subject.
        spacing_mm: Size of a voxel.
        width_mm: Extent along x, across the arm.
        depth_mm: Extent along y, from 4 mm above the skin; the far skin is 40 to 65 mm down.
        length_mm: Extent along z, at most 280 mm.

    Raises:
        ScanError: If there is no such subject, or such a body cannot be.
    """
    name = subject_name(subject)
    if length_mm > LARGEST_LENGTH_MM:
        raise ScanError(f"a forearm is at most {LARGEST_LENGTH_MM:g} mm long, got {length_mm:g}")
    counts = voxel_counts("forearm", (width_mm, depth_mm, length_mm), spacing_mm)
    arm = _draw_arm(subject, counts, spacing_mm)
    inner_vessels = draw_vessels(generator(subject, 0, "anatomy vessels"), arm.shape)
    nerves = draw_nerves(generator(subject, 0, "anatomy nerves"), arm.shape, inner_vessels)
    vessels = tuple(piece for vessel in inner_vessels for piece in _in_body(arm, vessel))
    codes, palette = np.empty(counts[::-1], np.uint8), forearm_palette()
    fill = _filler(arm)
    for first in range(0, len(codes), SLICES_AT_ONCE):
        some = slice(first, first + SLICES_AT_ONCE)
        tissue, echogenicity = np.empty((2, *codes[some].shape), np.uint8)
        fill(tissue, echogenicity, first)
        for nerve in nerves:
            _paint_nerve(arm, nerve, tissue, echogenicity, arm.along_mm[some])
        paint_vessels(tissue, echogenicity, arm.slice_mm(first), spacing_mm, vessels)
        palette.encode(tissue, echogenicity, codes[some])
    skin = arm.shape.skin_y(arm.across_mm, arm.along_mm[:, None])
    return Body(
        name="forearm",
        subject=name,
        tissue=CodedVoxels(codes, palette.tissue),
        echogenicity=CodedVoxels(codes, palette.echogenicity),
        spacing_mm=spacing_mm,
        origin_mm=arm.origin_mm,
        skin_depth_mm=skin.astype(np.float32),
        vessels=vessels,
    )


@dataclass(frozen=True, eq=False)
class _Arm:
    """An arm and how it lies in the body's voxels.

    Attributes:
        subject: Whose.
        shape: Its form.
        mirror: x per ``across``: +1 or -1.
        direction: ``along`` per z: +1 if z runs to the elbow, else -1.
        origin_mm: Center of voxel (0, 0, 0).
        spacing_mm: Of voxels.
        counts: Voxels along x, y and z.
    """

    subject: int
    shape: ArmShape
    mirror: float
    direction: float
    origin_mm: Point
    spacing_mm: float
    counts: tuple[int, int, int]

    @property
    def across_mm(self) -> Float[np.ndarray, " columns"]:
        """Return where the voxels' columns are across the arm."""
        x = self.origin_mm[0] + self.spacing_mm * np.arange(self.counts[0])
        return self.mirror * x

    @property
    def along_mm(self) -> Float[np.ndarray, " slices"]:
        """Return where the voxels' slices are along the arm."""
        z = self.origin_mm[2] + self.spacing_mm * np.arange(self.counts[2])
        return ARM_LENGTH_MM / 2 + self.direction * z

    def slice_mm(self, number: int) -> Point:
        """Return the center of the first voxel of a slice."""
        x, y, z = self.origin_mm
        return x, y, z + self.spacing_mm * number


def _draw_arm(subject: int, counts: tuple[int, int, int], spacing_mm: float) -> _Arm:
    mirror, direction = generator(subject, 0, "anatomy sides").choice((-1.0, 1.0), 2)
    shape = draw_shape(generator(subject, 0, "anatomy shape"))
    origin = first_voxel(counts, spacing_mm, -ABOVE_SKIN_MM)
    return _Arm(subject, shape, float(mirror), float(direction), origin, spacing_mm, counts)


def _filler(arm: _Arm) -> Callable[[Codes, Codes, int], None]:
    """Return what fills all but vessels and nerves in slices from a given one on."""
    extents = [arm.spacing_mm * (count - 1) for count in arm.counts]
    x, y, z = (
        first + step * np.arange(int(np.ceil(extent / step)) + 2)
        for first, step, extent in zip(arm.origin_mm, COARSE_MM, extents, strict=True)
    )
    fields = coarse_fields(
        generator(arm.subject, 0, "anatomy fields"),
        arm.shape,
        arm.mirror * x,
        y,
        ARM_LENGTH_MM / 2 + arm.direction * z,
        arm.mirror,
    )
    rest = (
        np.array(arm.origin_mm),
        arm.spacing_mm,
        fields,
        np.array(COARSE_MM),
        muscle_table(
            generator(arm.subject, 0, "anatomy muscles"), arm.shape, arm.along_mm, arm.mirror
        ),
        draw_tables(generator(arm.subject, 0, "anatomy texture")),
        np.array(CELLS_MM),
        draw_tones(generator(arm.subject, 0, "anatomy tones"), arm.shape, arm.spacing_mm),
    )
    return lambda tissue, echogenicity, first: fill_forearm(tissue, echogenicity, first, *rest)


def _paint_nerve(
    arm: _Arm,
    nerve: Nerve,
    tissue: Codes,
    echogenicity: Codes,
    along_mm: Float[np.ndarray, " slices"],
) -> None:
    paint_nerve(
        tissue,
        echogenicity,
        np.array(arm.origin_mm),
        arm.spacing_mm,
        nerve.at(along_mm, arm.mirror),
        nerve.fascicles,
        int(Tissue.NERVE),
        np.array((code_of(BUNDLE_DB), code_of(NERVE_DB))),
        labels_except(Tissue.OUTSIDE, Tissue.GEL, Tissue.SKIN, Tissue.BONE),
    )


def _in_body(arm: _Arm, vessel: Vessel) -> list[Vessel]:
    """Return a vessel in body coordinates: the pieces of it that are within the voxels."""
    across, y, along = vessel.centerline_mm.T
    points = np.column_stack((arm.mirror * across, y, arm.direction * (along - ARM_LENGTH_MM / 2)))
    first = np.array(arm.origin_mm)
    last = first + arm.spacing_mm * (np.array(arm.counts) - 1)
    nodes = np.column_stack((points, vessel.radius_mm))
    pieces = [_piece(nodes, run, first, last) for run in _runs(_inside(points, first, last))]
    return [
        Vessel(vessel.name, vessel.kind, piece[:, :3], piece[:, 3], vessel.mean_speed_mm_per_s)
        for piece in pieces
    ]


def _inside(
    points: Float[np.ndarray, "points xyz=3"],
    first: Float[np.ndarray, "xyz=3"],
    last: Float[np.ndarray, "xyz=3"],
) -> Bool[np.ndarray, " points"]:
    return np.all((points >= first) & (points <= last), axis=1)


def _runs(inside: Bool[np.ndarray, " points"]) -> list[slice]:
    """Return the stretches of two points or more that are inside."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], inside, [False]))))
    return [
        slice(int(begin), int(end))
        for begin, end in zip(edges[::2], edges[1::2], strict=True)
        if end - begin > 1
    ]


def _piece(
    nodes: Float[np.ndarray, "points 4"],
    run: slice,
    first: Float[np.ndarray, "xyz=3"],
    last: Float[np.ndarray, "xyz=3"],
) -> Float[np.ndarray, "piece 4"]:
    """Return points and radii that are inside, up to where the line leaves the box."""
    parts = [nodes[run]]
    if run.start > 0:
        parts.insert(0, _leaving(nodes[run.start], nodes[run.start - 1], first, last))
    if run.stop < len(nodes):
        parts.append(_leaving(nodes[run.stop - 1], nodes[run.stop], first, last))
    return np.concatenate(parts)


def _leaving(
    inner: Float[np.ndarray, " 4"],
    outer: Float[np.ndarray, " 4"],
    first: Float[np.ndarray, "xyz=3"],
    last: Float[np.ndarray, "xyz=3"],
) -> Float[np.ndarray, "nodes 4"]:
    """Return the node on the side of the box between one inside and one outside.

    None, if the inside one is there already.
    """
    step = outer[:3] - inner[:3]
    room = np.where(step > 0, last - inner[:3], first - inner[:3])
    shares = np.divide(room, step, out=np.ones(3), where=step != 0)
    share = min(shares.min(), 1.0)
    node = inner + share * (outer - inner)
    return node[None] if share > 1e-3 else np.empty((0, 4))
