"""Forearms: a different one for each subject, continuous over 250 mm."""

import numpy as np

from sonosweep.errors import ScanError
from sonosweep.simulate.anatomy_texture import sheet_table
from sonosweep.simulate.body import Body
from sonosweep.simulate.forearm_kernels import FIELDS, fill_forearm
from sonosweep.simulate.forearm_muscles import muscle_table
from sonosweep.simulate.forearm_shape import ARM_LENGTH_MM, draw_shape
from sonosweep.simulate.seeds import generator, subject_name
from sonosweep.simulate.smooth_noise import draw_noise
from sonosweep.simulate.voxels import first_voxel, voxel_counts

ABOVE_SKIN_MM = 4.0  # of gel above the crest of the skin
LARGEST_LENGTH_MM = 280.0
COARSE_MM = (1.0, 1.0, 5.0)  # grid of smooth fields along x, y and z
MUSCLE_CELL_MM = (4.0, 0.125, 0.75)  # cells of the tables of sheets along z, y, x
FAT_CELL_MM = (6.0, 0.125, 1.5)


def forearm(
    subject: int,
    *,
    spacing_mm: float = 0.25,
    width_mm: float = 90.0,
    depth_mm: float = 50.0,
    length_mm: float = ARM_LENGTH_MM,
) -> Body:
    """Return the forearm of a subject, the flexor side up.

    The middle of the arm is at x = 0 and z = 0, and the skin there at y = 0, with 4 mm of
    gel above. Subjects differ in size, fat, the places of muscles, bones and vessels, in
    echogenicity, in left and right, and in whether z runs to the elbow or to the wrist.
    A subject's anatomy is the same on every grid.

    Args:
        subject: Number of the subject.
        spacing_mm: Size of a voxel.
        width_mm: Extent along x, across the arm.
        depth_mm: Extent along y; the far skin is 50 to 70 mm down.
        length_mm: Extent along z, at most 280 mm.

    Raises:
        ScanError: If there is no such subject or no such grid.
    """
    name = subject_name(subject)
    if length_mm > LARGEST_LENGTH_MM:
        raise ScanError(f"a forearm is at most {LARGEST_LENGTH_MM:g} mm long, got {length_mm:g}")
    counts = voxel_counts("forearm", (width_mm, depth_mm, length_mm), spacing_mm)
    origin = first_voxel(counts, spacing_mm, -ABOVE_SKIN_MM)
    shape_zyx = counts[::-1]
    frame = _Frame(subject, origin, spacing_mm, shape_zyx)
    tissue, echo = np.empty(shape_zyx, np.uint8), np.empty(shape_zyx, np.uint8)
    frame.fill(tissue, echo)
    return Body(
        name="forearm",
        subject=name,
        tissue=tissue,
        echogenicity=echo,
        spacing_mm=spacing_mm,
        origin_mm=origin,
        skin_depth_mm=frame.skin(),
    )


class _Frame:
    def __init__(self, subject, origin, spacing, shape):
        self.subject, self.origin, self.spacing, self.shape_zyx = subject, origin, spacing, shape
        sides = generator(subject, 0, "anatomy sides")
        self.mirror, self.direction = (float(s) for s in sides.choice((-1.0, 1.0), 2))
        self.arm = draw_shape(generator(subject, 0, "anatomy shape"))

    def axes(self):
        return [o + self.spacing * np.arange(n) for o, n in zip(self.origin, self.shape_zyx[::-1])]

    def along(self, z):
        return ARM_LENGTH_MM / 2 + self.direction * z

    def skin(self):
        x, _, z = self.axes()
        return self.arm.skin_y(self.mirror * x[None], self.along(z)[:, None]).astype(np.float32)

    def fields(self):
        x, y, z = self.axes()
        nodes = [
            a[0] + step * np.arange(int(np.ceil((a[-1] - a[0]) / step)) + 2)
            for a, step in zip((x, y, z), COARSE_MM)
        ]
        start = np.array([n[0] for n in nodes])
        across = self.mirror * nodes[0]
        a, yy, xx = self.along(nodes[2])[:, None, None], nodes[1][:, None], across
        g = generator(self.subject, 0, "anatomy fields")
        wx = 0.8 * draw_noise(g, 22.0, 7.0, 7.0)(a, yy, xx) + 0.25 * draw_noise(g, 9.0, 3.0, 3.0)(
            a, yy, xx
        )
        wy = 0.7 * draw_noise(g, 22.0, 7.0, 9.0)(a, yy, xx) + 0.2 * draw_noise(g, 9.0, 3.0, 4.0)(
            a, yy, xx
        )
        bright = 1.6 * draw_noise(g, 18.0, 5.0, 6.0)(a, yy, xx)
        arm = self.arm
        d = arm.skin_distance(xx, yy, a)
        out = np.empty((FIELDS, *np.broadcast_shapes(a.shape, yy.shape, xx.shape)), np.float32)
        out[0] = d
        out[1] = d - arm.skin_mm - arm.fat_below(xx, a) + 0.25 * wy
        out[2] = arm.bone_distance(xx + 0.3 * wx, yy + 0.3 * wy, a)
        out[3] = arm.membrane_distance(xx, yy + 0.5 * wy, a)
        out[4], out[5], out[6] = self.mirror * wx, wy, bright
        out[7] = yy - arm.middle_y(a)
        return out, start

    def fill(self, tissue, echo):
        fields, _ = self.fields()
        g = generator(self.subject, 0, "anatomy texture")
        tables = np.stack(
            (
                sheet_table(
                    g,
                    cell_mm=MUSCLE_CELL_MM,
                    spread_mm=(9.0, 0.32, 1.3),
                    thickness_mm=0.11,
                    coverage=0.45,
                ),
                sheet_table(
                    g,
                    cell_mm=FAT_CELL_MM,
                    spread_mm=(9.0, 0.4, 4.0),
                    thickness_mm=0.10,
                    coverage=0.5,
                ),
            )
        )
        cells = np.array((MUSCLE_CELL_MM, FAT_CELL_MM))
        _, _, z = self.axes()
        muscles = muscle_table(
            generator(self.subject, 0, "anatomy muscles"),
            self.arm,
            self.along(z),
            self.mirror,
            self.direction,
        )
        fill_forearm(
            tissue,
            echo,
            np.array(self.origin),
            self.spacing,
            fields,
            np.array(COARSE_MM),
            muscles,
            tables,
            cells,
            self.tones(),
        )

    def tones(self):
        g = generator(self.subject, 0, "anatomy tones")
        t = g.normal(0, 1, 13)
        thick = max(0.0, 0)
        return np.array(
            [
                self.arm.skin_mm,
                g.uniform(0.4, 1.1),
                max(g.uniform(0.16, 0.28), 0.5 * self.spacing),
                6 + t[0],
                0 + t[1],
                -14 + 1.5 * t[2],
                13 + t[3],
                7 + t[4],
                -11 + 1.5 * t[5],
                2 + t[6],
                1 + t[7],
                11 + t[8],
                -20,
            ],
            np.float32,
        )
