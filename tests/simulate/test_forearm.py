"""Simulated forearms."""

import time
from collections import defaultdict
from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial import cKDTree

from sonosweep.errors import ScanError
from sonosweep.simulate.body import Body, Tissue, Vessel
from sonosweep.simulate.coded_voxels import CodedVoxels
from sonosweep.simulate.forearm import forearm
from sonosweep.simulate.forearm_palette import LEVELS, forearm_palette
from sonosweep.simulate.seeds import generator

SUBJECT = 900_001
SPARSE_MM = 0.05  # of the points by which center lines are replaced
ALL_BYTES = 75e6
CPU_S = 4.0


@pytest.fixture(scope="module")
def arm() -> Body:
    """Return the forearm on a fine grid, with all voxels in plain arrays."""
    return plain(forearm(SUBJECT, spacing_mm=0.25))


def plain(body: Body) -> Body:
    """Return a body whose voxels are looked up."""
    tissue, echogenicity = np.asarray(body.tissue), np.asarray(body.echogenicity)
    return replace(body, tissue=tissue, echogenicity=echogenicity)


def dense_lines(vessels: tuple[Vessel, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return points along all center lines, as dense as SPARSE_MM, and their radii."""
    nodes = []
    for vessel in vessels:
        line = np.column_stack((vessel.centerline_mm, vessel.radius_mm))
        lengths = np.linalg.norm(np.diff(vessel.centerline_mm, axis=0), axis=1)
        for first, last, length in zip(line[:-1], line[1:], lengths, strict=True):
            shares = np.linspace(0, 1, int(length / SPARSE_MM) + 2)[:, None]
            nodes.append(first + shares * (last - first))
    every = np.concatenate(nodes)
    return every[:, :3], every[:, 3]


def voxel_of(body: Body, points_mm: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the z, y, x indices of the voxels that hold points."""
    index = np.rint((points_mm - np.array(body.origin_mm)) / body.spacing_mm).astype(int)
    return tuple(index.T[::-1])


def same_bytes(one: Body, two: Body) -> bool:
    """Return whether two bodies agree to the last bit."""
    lines = [
        np.array_equal(a.centerline_mm, b.centerline_mm)
        and np.array_equal(a.radius_mm, b.radius_mm)
        for a, b in zip(one.vessels, two.vessels, strict=True)
    ]
    arrays = ("tissue", "echogenicity", "skin_depth_mm")
    return all(lines) and all(np.array_equal(getattr(one, a), getattr(two, a)) for a in arrays)


def test_a_subject_always_has_the_same_arm():
    """The same number gives the same bytes."""
    assert same_bytes(forearm(900_002, length_mm=6.0), forearm(900_002, length_mm=6.0))


def test_subjects_differ():
    """Two arms differ in layers, muscles and vessels."""
    one, two = (
        plain(forearm(subject, spacing_mm=1.0, length_mm=100.0)) for subject in (900_003, 900_004)
    )

    inside = (one.tissue > Tissue.GEL) & (two.tissue > Tissue.GEL)
    assert (one.tissue != two.tissue)[inside].mean() > 0.15
    assert one.skin_depth_mm != pytest.approx(two.skin_depth_mm, abs=0.3)
    first, second = dense_lines(one.vessels)[0], dense_lines(two.vessels)[0]
    assert np.median(cKDTree(first).query(second[::50])[0]) > 1.0


def test_every_tissue_is_there(arm):
    """Skin, fat, fascia, muscle, tendon, nerve, bone, walls, blood, and gel above."""
    shares = np.bincount(arm.tissue[::8].ravel(), minlength=len(Tissue)) / arm.tissue[::8].size

    assert (shares > 0.001).all()
    assert shares[Tissue.MUSCLE] > 0.2
    assert 0.03 < shares[Tissue.BONE] < 0.12


def test_echoes_are_ordered_as_on_a_scanner(arm):
    """Blood is darkest; fascia, skin and tendon outshine muscle, and so does a bone's surface."""
    mean = ndimage.mean(arm.echogenicity[::8], arm.tissue[::8], range(len(Tissue)))
    bone = arm.tissue[::8] == Tissue.BONE
    surface = bone & ~ndimage.binary_erosion(bone)

    assert mean[Tissue.ARTERY] == mean[Tissue.VEIN] < mean[Tissue.MUSCLE] - 100 / 4
    for bright in (Tissue.FASCIA, Tissue.SKIN, Tissue.TENDON, Tissue.NERVE, Tissue.VESSEL_WALL):
        assert mean[bright] > mean[Tissue.MUSCLE] + 6 * 4
    assert np.median(arm.echogenicity[::8][surface]) > mean[Tissue.FASCIA]
    assert arm.echogenicity[arm.tissue <= Tissue.GEL].max() == 0
    assert arm.echogenicity[arm.tissue > Tissue.GEL].min() > 0


def test_layers_follow_one_another_into_the_arm(arm):
    """Below gel comes skin, then fat, then fascia; the skin is where the body says it is."""
    slices, columns = np.arange(20, 980, 60), np.arange(100, 260, 20)
    for j in slices:
        for i in columns:
            column = arm.tissue[j, :, i]
            _, first = np.unique(column, return_index=True)
            order = [int(column[k]) for k in sorted(first)][:4]
            blood = {Tissue.VEIN, Tissue.VESSEL_WALL}
            assert order[:3] == [Tissue.GEL, Tissue.SKIN, Tissue.FAT] or set(order) & blood
            top = arm.origin_mm[1] + arm.spacing_mm * np.argmax(column == Tissue.SKIN)
            assert 0 <= top - arm.skin_depth_mm[j, i] < 1.1 * arm.spacing_mm


def test_a_flat_probe_touches_the_skin(arm):
    """The crest is at y = 0 in the middle; over a 38 mm array the skin falls by under 3 mm."""
    middle = arm.skin_depth_mm[495:505, 175:185]
    reach = round(19 / arm.spacing_mm)
    falls = arm.skin_depth_mm[:, [180 - reach, 180 + reach]] - arm.skin_depth_mm[:, 180:181]

    assert np.abs(middle).max() < 0.05
    assert 0 < falls.min() < falls.max() < 3.0


def test_slices_continue_one_another(arm):
    """From slice to slice few labels change, and only where their boundaries move."""
    for k in (0, 130, 377, 500, 801, 998):
        this, following = arm.tissue[k], arm.tissue[k + 1]
        changed = this != following
        near = np.zeros_like(changed)
        for label in np.unique(following):
            grown = ndimage.binary_dilation(this == label, np.ones((3, 3)), iterations=3)
            near |= (following == label) & grown
        assert 0 < changed.mean() < 0.02
        assert near[changed].mean() > 0.98


def test_fibre_streaks_run_along_the_arm(arm):
    """Muscle looks alike 8 times farther along the arm than in depth, aside in between."""
    part = slice(400, 600)
    muscle = arm.tissue[part] == Tissue.MUSCLE
    code = np.where(muscle, arm.echogenicity[part], 0).astype(np.float32)
    size = (1, 17, 17)
    mean = ndimage.uniform_filter(code, size)
    mean /= np.maximum(ndimage.uniform_filter(muscle.astype(np.float32), size), 1e-3)
    detail = np.where(muscle, code - mean, 0)

    def alike(axis: int, lag: int) -> float:
        a, b = np.moveaxis(detail, axis, 0), np.moveaxis(muscle, axis, 0)
        return float((a[lag:] * a[:-lag])[b[lag:] & b[:-lag]].mean())

    power = float((detail[muscle] ** 2).mean())
    assert alike(1, 2) < 0.1 * power  # 0.5 mm deeper
    assert alike(0, 4) > 0.6 * power  # 1 mm along
    assert alike(0, 8) > 0.3 * power  # 2 mm along, on a slope of up to 13 degrees
    assert alike(0, 12) > 2 * alike(2, 12)  # along against aside


def test_center_lines_agree_with_labels(arm):
    """Every voxel of blood is within a radius of a center line, and every such point in blood."""
    blood = np.argwhere((arm.tissue == Tissue.ARTERY) | (arm.tissue == Tissue.VEIN))[::29, ::-1]
    places = blood * arm.spacing_mm + np.array(arm.origin_mm)
    outside = np.full(len(places), np.inf)
    for vessel in arm.vessels:
        line, radii = dense_lines((vessel,))
        distances, nearest = cKDTree(line).query(places)
        outside = np.minimum(outside, distances - radii[nearest])
    assert outside.max() < SPARSE_MM

    lines, radii = dense_lines(arm.vessels)
    wide = radii > arm.spacing_mm
    labels = arm.tissue[voxel_of(arm, lines[wide])]
    assert np.isin(labels, (Tissue.ARTERY, Tissue.VEIN)).all()


def test_each_vessel_is_of_its_kind(arm):
    """An artery's line is in arterial blood; a vein's too, but where arteries' branches start."""
    for vessel in arm.vessels:
        labels = arm.tissue[voxel_of(arm, vessel.centerline_mm)]
        own = (labels == Tissue[vessel.kind.upper()]).mean()
        assert own == 1.0 if vessel.kind == "artery" else own > 0.9


def test_vessels_are_unbroken_and_joined(arm):
    """All arteries are one tree of at least two bifurcations; side veins end in a vein."""
    arteries = arm.tissue == Tissue.ARTERY
    columns, rows = (arteries.any(axis=(0, axis)) for axis in (1, 2))
    _, count = ndimage.label(arteries[:, rows][:, :, columns], np.ones((3, 3, 3)))
    assert count == 1
    assert sum("branch" in vessel.name for vessel in arm.vessels) >= 2

    lines = {vessel.name: vessel for vessel in arm.vessels}
    for name, vessel in lines.items():
        assert np.linalg.norm(np.diff(vessel.centerline_mm, axis=0), axis=1).max() < 4.0
        if "branch" in name:
            parent = lines[name.split()[0] + " artery"].centerline_mm
            assert cKDTree(parent).query(vessel.centerline_mm[0])[0] < 1e-6
        if "tributary" in name:
            trunk = lines[name.split()[0] + " vein"].centerline_mm
            assert cKDTree(trunk).query(vessel.centerline_mm[-1])[0] < 2.0


def test_vessels_stay_in_soft_tissue(arm):
    """No lumen cuts the skin's surface or a bone: walls lie between."""
    lines, radii = dense_lines(arm.vessels)
    skin = arm.skin_depth_mm[voxel_of(arm, lines)[0], voxel_of(arm, lines)[2]]
    assert (lines[:, 1] - radii > skin).all()

    blood = (arm.tissue[::5] == Tissue.ARTERY) | (arm.tissue[::5] == Tissue.VEIN)
    around = ndimage.binary_dilation(blood, np.ones((1, 3, 3)))
    assert not (around & (arm.tissue[::5] == Tissue.BONE)).any()


def test_blood_flows_out_in_arteries_and_back_in_veins(arm):
    """Along z, trunks of arteries and veins run against each other."""
    signs = defaultdict(set)
    for vessel in arm.vessels:
        signs[vessel.kind].add(np.sign(vessel.centerline_mm[-1, 2] - vessel.centerline_mm[0, 2]))

    assert len(signs["artery"]) == len(signs["vein"]) == 1
    assert signs["artery"] != signs["vein"]


def test_anatomy_does_not_depend_on_the_grid(arm):
    """The same place has the same tissue on a coarser, wider and deeper grid."""
    coarse = forearm(SUBJECT, spacing_mm=0.5, width_mm=120.0, depth_mm=70.0, length_mm=60.0)
    x, y, z = np.meshgrid(np.arange(-35.0, 36, 3), np.arange(0.0, 42, 3), np.arange(-28.0, 29, 4))
    places = np.stack((x.ravel(), y.ravel(), z.ravel()), axis=1)

    fine_labels = arm.tissue[voxel_of(arm, places)]
    coarse_labels = coarse.tissue[voxel_of(coarse, places)]

    assert (fine_labels == coarse_labels).mean() > 0.93  # the rest: lines thinner than 0.5 mm


def test_below_the_arm_is_nothing():
    """A deep grid shows the far skin, and beyond it neither gel nor tissue."""
    body = forearm(SUBJECT, spacing_mm=0.5, width_mm=150.0, depth_mm=110.0, length_mm=5.0)
    column = body.tissue[5, :, 150]
    far = np.flatnonzero(column == Tissue.SKIN).max()

    assert 40 < body.origin_mm[1] + far * body.spacing_mm < 75
    assert (column[far + 1 :] == Tissue.OUTSIDE).all()


def test_the_body_fits_in_memory(arm):
    """Tissue and echogenicity share one byte per voxel; with the skin they take under 75 MB."""
    body = forearm(SUBJECT, spacing_mm=0.25, length_mm=5.0)
    assert isinstance(body.tissue, CodedVoxels)
    assert isinstance(body.echogenicity, CodedVoxels)
    assert body.tissue.codes is body.echogenicity.codes
    assert arm.tissue.nbytes + arm.skin_depth_mm.nbytes < ALL_BYTES


def test_voxels_keep_their_tissue_and_nearly_their_echo():
    """In the palette, each tissue stays what it is and varies in steps of at most 1 dB."""
    palette = forearm_palette()
    for label, levels in LEVELS.items():
        wanted = np.arange(min(levels), max(levels) + 1, dtype=np.uint8)
        tissue = np.full((1, 1, wanted.size), int(label), np.uint8)
        codes = np.empty_like(tissue)
        palette.encode(tissue, wanted[None, None], codes)
        found = palette.echogenicity[codes[0, 0]].astype(int)
        assert (palette.tissue[codes] == int(label)).all()
        assert np.abs(found - wanted).max() <= (20 if label == Tissue.NERVE else 2)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"subject": -1}, "number from 0 to 999999, got -1"),
        ({"subject": 1, "length_mm": 300.0}, "at most 280 mm long, got 300"),
        ({"subject": 1, "width_mm": 0.0}, "width must be above 0, got 0"),
        ({"subject": 1, "spacing_mm": float("nan")}, "voxel size must be above 0 mm, got nan"),
        ({"subject": 1, "spacing_mm": 0.01}, "make it smaller or voxels larger"),
    ],
)
def test_impossible_arms_are_refused(wrong, message):
    """One sentence says what is wrong."""
    with pytest.raises(ScanError, match=message):
        forearm(**wrong)


@pytest.mark.slow
def test_nothing_in_the_anatomy_says_where_z_points():
    """Of 24 subjects about half have the wrist at the low end of z, in left and right arms."""
    wrist_first = []
    for subject in range(900_100, 900_124):
        body = plain(forearm(subject, spacing_mm=2.0))
        tendon = (body.tissue == Tissue.TENDON).sum(axis=(1, 2))
        wrist_first.append(tendon[:40].sum() > tendon[-40:].sum())
        direction = generator(subject, 0, "anatomy sides").choice((-1.0, 1.0), 2)[1]
        assert wrist_first[-1] == (direction > 0)
    # 4 or fewer, or 20 or more, of 24 by chance: 0.15 %.
    assert 4 < sum(wrist_first) < 20


@pytest.mark.slow
def test_an_arm_is_made_in_seconds(arm):
    """A forearm of 72 million voxels takes at most 4 s of one processor."""
    times = []
    for subject in (900_005, 900_006):
        start = time.process_time()
        forearm(subject, spacing_mm=0.25)
        times.append(time.process_time() - start)
    assert min(times) < CPU_S
