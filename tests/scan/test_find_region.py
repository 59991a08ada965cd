"""Where the image is within a frame."""

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sonosweep.errors import ScanError
from sonosweep.io.sequence import read_sequence
from sonosweep.scan import Region, Scan
from sonosweep.scan.find_region import find_region, locate_image

# Edges of made-up sectors: speckle leaves dark pixels on them.
EDGE_PX = 6


def speckle(seed, frames, rows, columns):
    """Frames of Rayleigh speckle, a new pattern in each."""
    generator = np.random.default_rng(seed)
    return generator.rayleigh(40, (frames, rows, columns)).clip(0, 255).astype(np.uint8)


def sector(rows, columns, apex_row=-60, near=80, far=260, half_angle_deg=33):
    """Which pixels a curved probe in the middle of the top edge sees."""
    row, column = np.mgrid[:rows, :columns]
    x, y = column - (columns - 1) / 2, row - apex_row
    radius, angle = np.hypot(x, y), np.degrees(np.abs(np.arctan2(x, y)))
    return (radius >= near) & (radius <= far) & (angle <= half_angle_deg)


@given(st.integers(0, 99), st.integers(0, 40), st.integers(0, 30), st.integers(60, 100))
@settings(max_examples=20)
def test_a_rectangle_on_black_is_found_to_the_pixel(seed, column, row, size):
    """The rectangle of a linear probe, wherever it lies within the frame."""
    frames = np.zeros((8, 150, 170), np.uint8)
    frames[:, row : row + size, column : column + size + 20] = speckle(seed, 8, size, size + 20)

    found = find_region(frames)

    assert found.rectangle_px == (column, row, size + 20, size)
    assert found.mask is None


def test_text_and_gray_scale_are_not_image():
    """What never changes, however large, is not the image, and neither is a thin line."""
    frames = np.zeros((8, 200, 240), np.uint8)
    frames[:, 40:140, 60:160] = speckle(1, 8, 100, 100)
    frames[:, 20:180, 190:215] = np.linspace(255, 0, 160, dtype=np.uint8)[:, None]
    frames[:, 5:17, 5:120:3] = 255
    frames[:, 90, 160:190] = 255

    assert find_region(frames).rectangle_px == (60, 40, 100, 100)


def test_a_border_need_not_be_black():
    """A gray window round the image is border, too."""
    frames = np.full((6, 120, 120), 77, np.uint8)
    frames[:, 20:100, 30:90] = speckle(2, 6, 80, 60)

    assert find_region(frames).rectangle_px == (30, 20, 60, 80)


def test_a_shadow_does_not_notch_the_image():
    """A rib's shadow that reaches the bottom in every frame stays within the rectangle."""
    frames = np.zeros((6, 160, 160), np.uint8)
    frames[:, 10:150, 20:140] = speckle(3, 6, 140, 120)
    frames[:, 60:150, 70:95] = 0

    found = find_region(frames)

    assert found.rectangle_px == (20, 10, 120, 140)
    assert found.mask is None


def test_a_sector_gets_a_mask():
    """A curved probe sees a sector; shadows do not notch it and the probe's curve does."""
    seen = sector(210, 300)
    frames = speckle(4, 8, 210, 300) * seen
    frames[:, 120:, 150:170] = 0

    found = find_region(frames)

    assert found.mask is not None
    edge = np.abs(np.hypot(*np.gradient(seen.astype(float)))) > 0
    wrong = found.mask != seen
    assert wrong.mean() < 0.01
    rows, columns = np.nonzero(wrong)
    edges = np.argwhere(edge)
    for row, column in zip(rows[::5], columns[::5], strict=True):
        assert np.hypot(*(edges - (row, column)).T).min() <= EDGE_PX
    middle = seen[:, 150].argmax()
    assert abs(found.mask[:, 150].argmax() - middle) <= 2


def test_no_border_no_cut():
    """Frames that are image from edge to edge are kept whole."""
    assert find_region(speckle(5, 5, 90, 110)).rectangle_px == (0, 0, 110, 90)
    assert find_region(speckle(5, 1, 90, 110)).rectangle_px == (0, 0, 110, 90)


def test_nothing_to_find():
    """Black, empty and NaN frames give the whole frame, not an error."""
    for frames in (
        np.zeros((3, 20, 30), np.uint8),
        np.zeros((0, 20, 30), np.uint8),
        np.full((3, 20, 30), np.nan, np.float32),
    ):
        found = find_region(frames)
        assert found.rectangle_px == (0, 0, 30, 20)
        assert found.mask is None


def test_pixel_type_and_colour_do_not_matter():
    """The same image in 16 bits, in floats and in colour has the same region."""
    frames = np.zeros((6, 120, 120), np.uint8)
    frames[:, 20:100, 30:90] = speckle(6, 6, 80, 60)

    for other in (
        frames.astype(np.uint16) * 200,
        frames.astype(np.float32) / 255,
        np.repeat(frames[..., None], 3, axis=-1),
    ):
        assert find_region(other).rectangle_px == (30, 20, 60, 80)


def test_few_frames_are_read():
    """Of a long scan only the sampled frames are read, each once and alone."""

    class Counted:
        shape, dtype = (5000, 50, 60), np.dtype(np.uint8)

        def __init__(self):
            self.asked = []

        def __len__(self):
            return 5000

        def __getitem__(self, index):
            self.asked.append(index)
            return speckle(index, 1, 50, 60)[0]

    frames = Counted()
    find_region(frames)

    assert len(frames.asked) == len(set(frames.asked)) == 24
    assert {0, 4999} <= set(frames.asked)


def test_liver_sweep(recordings):
    """The curved probe's sector fills the frame but for its corners and the probe."""
    with h5py.File(recordings / "imfusion_liver_sweep" / "liver_sweep.h5") as file:
        found = find_region(file["images"])

    column, row, width, height = found.rectangle_px
    assert column <= 5
    assert row <= 2
    assert width >= 730
    assert height >= 588
    assert found.mask is not None
    assert found.mask.mean() == pytest.approx(0.63, abs=0.02)
    assert not found.mask[5, 370]  # between the ends of the probe
    assert found.mask[30, 370]
    assert not found.mask[0, 0]
    assert found.mask[560, 420]  # in a shadow


@pytest.mark.parametrize(
    ("name", "rectangle"),
    [
        # Read off the files: the columns and rows that are ever above 2 of 255.
        ("plus_bone_l14/BoneUltrasound_L14.igs.mha", (176, 1, 467, 614)),
        ("plus_spine_freehand/SpinePhantomFreehand.igs.mha", (187, 12, 445, 590)),
    ],
)
def test_linear_probes(recordings, name, rectangle):
    """The rectangle of a linear probe lies in the middle of the recorded screen."""
    found = find_region(read_sequence(recordings / name).frames)

    assert found.rectangle_px == rectangle
    assert found.mask is None


def test_the_image_is_looked_for_within_a_rectangle():
    """A rectangle with a border is narrowed to the image; its pixels are those of the frame."""
    frames = np.zeros((6, 160, 200), np.uint8)
    frames[:, 40:140, 60:160] = speckle(3, 6, 100, 100)
    scan = Scan("x", frames, region=Region((20, 30, 160, 125)))

    asked = locate_image(Scan("x", frames), (20, 30, 160, 125))
    stated = locate_image(scan)

    assert asked.region.rectangle_px == (60, 40, 100, 100)
    assert stated.region.rectangle_px == (60, 40, 100, 100)
    with pytest.raises(ScanError, match="does not fit"):
        locate_image(scan, (100, 0, 160, 125))


def test_a_mask_stays_as_it_is():
    """Where a scan says pixel by pixel what is image, nobody looks again."""
    region = Region((0, 0, 8, 8), np.eye(8, dtype=bool))

    located = locate_image(Scan("x", np.zeros((2, 8, 8), np.uint8), region=region))

    assert located.region is region
