"""What the objects refuse."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from torch.testing import assert_close

from sonosweep.errors import ScanError
from sonosweep.scan import (
    Calibration,
    ChannelData,
    Companion,
    Probe,
    Region,
    Scan,
    Trajectory,
    Volume,
    VolumeGrid,
    calibration_from_matrix,
    pixel_to_image,
    select_frames,
    select_tracked,
    voxel_to_reference,
)

from ..strategies import poses, scans

ROUND_OFF_MM = 1e-9  # float64 on coordinates below 1 m
FRAMES = np.zeros((4, 6, 5), np.uint8)
EYE = torch.eye(4, dtype=torch.float64)


def test_counts_that_differ_are_named():
    """Four frames with three poses, five times or two companion frames are refused."""
    with pytest.raises(ScanError, match="4 frames but 3 poses in 'x'"):
        Scan("x", FRAMES, image_to_reference=EYE.expand(3, 4, 4))
    with pytest.raises(ScanError, match="4 frames but 5 timestamps"):
        Scan("x", FRAMES, timestamps_s=torch.arange(5).double())
    with pytest.raises(ScanError, match="4 frames but 2 power_doppler frames"):
        Scan("x", FRAMES, companions={"power_doppler": Companion(FRAMES[:2], (1.0, 1.0))})


def test_poses_must_be_rigid_where_tracked():
    """A scaled pose and a NaN are refused, unless the tracker says it missed that frame."""
    bad = EYE.repeat(4, 1, 1)
    bad[2] = float("nan")
    seen = torch.tensor([True, True, False, True])

    with pytest.raises(ScanError, match="pose of frame 2"):
        Scan("x", FRAMES, image_to_reference=bad)

    assert Scan("x", FRAMES, image_to_reference=bad, tracked=seen).tracked is seen


def test_times_must_increase():
    """Equal or falling times are refused with the frame's number."""
    with pytest.raises(ScanError, match="frame 2 is not later than frame 1"):
        Scan("x", FRAMES, timestamps_s=torch.tensor([0.0, 1.0, 1.0, 2.0]).double())
    with pytest.raises(ScanError, match="not numbers"):
        Scan("x", FRAMES, timestamps_s=torch.tensor([0.0, 1.0, float("nan"), 2.0]).double())


@pytest.mark.parametrize("spacing", [(0.0, 0.1), (0.1, -1.0), (float("nan"), 0.1), (0.1, 1e9)])
def test_spacing_must_make_sense(spacing):
    """Zero, negative, absent and absurd pixel sizes are refused."""
    with pytest.raises(ScanError, match="pixel spacing must be above 0 mm"):
        Calibration(spacing_mm=spacing)


@given(poses())
def test_a_pixel_matrix_is_split_and_put_together(image_to_probe):
    """Spacing, lean and rigid pose multiply back to the matrix that was measured."""
    scale = EYE.clone()
    scale[0, 0], scale[1, 1], scale[0, 1] = 0.08, 0.09, 0.004
    measured = image_to_probe @ scale

    found = calibration_from_matrix(measured)

    assert found.image_to_probe is not None
    assert_close(found.spacing_mm, (0.08, 0.09))
    together = found.image_to_probe @ pixel_to_image(found)
    assert_close(together[:, [0, 1, 3]], measured[:, [0, 1, 3]], atol=ROUND_OFF_MM, rtol=0)


@given(poses())
def test_row_column_pixels_from_one_land_where_the_source_says(image_to_probe):
    """A source that counts (row, column) from 1 and we agree on where a pixel is."""
    row_column_to_probe = image_to_probe @ torch.diag(torch.tensor([0.2, 0.3, 1, 1]).double())

    found = calibration_from_matrix(row_column_to_probe, "row_column", 1)

    assert found.image_to_probe is not None
    theirs = row_column_to_probe @ torch.tensor([8.0, 5.0, 0, 1], dtype=torch.float64)
    ours = (
        found.image_to_probe
        @ pixel_to_image(found)
        @ torch.tensor([4.0, 7.0, 0, 1], dtype=torch.float64)
    )
    assert_close(ours, theirs, atol=ROUND_OFF_MM, rtol=0)
    assert_close(found.spacing_mm, (0.3, 0.2))


def test_a_pixel_matrix_that_is_flat_is_refused():
    """Columns that point the same way, and NaN, are no calibration."""
    flat = EYE.clone()
    flat[:3, 1] = flat[:3, 0]
    with pytest.raises(ScanError, match="onto a line"):
        calibration_from_matrix(flat)
    with pytest.raises(ScanError, match="not numbers"):
        calibration_from_matrix(EYE * float("nan"))


def test_trajectory_and_volume_checks():
    """Counts, rigidity and sizes of results are checked too."""
    with pytest.raises(ScanError, match="pose 1 of the trajectory"):
        Trajectory(torch.stack([EYE, 2 * EYE]))
    with pytest.raises(ScanError, match="at least one pose"):
        Trajectory(torch.zeros(0, 4, 4).double())
    with pytest.raises(ScanError, match="step deviations must be"):
        Trajectory(torch.stack([EYE, EYE]), step_std=-torch.ones(1, 6).double())
    with pytest.raises(ScanError, match="at least one voxel"):
        VolumeGrid((0, 1, 1), (1.0, 1.0, 1.0))
    with pytest.raises(ScanError, match="right-handed"):
        VolumeGrid(
            (1, 1, 1),
            (1.0, 1.0, 1.0),
            direction=((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, -1.0)),
        )
    with pytest.raises(ScanError, match="on a grid of"):
        Volume(np.zeros((2, 3, 4)), VolumeGrid((2, 3, 4), (1.0, 1.0, 1.0)))
    with pytest.raises(ScanError, match="a region needs"):
        Region((0, 0, 0, 5))


def test_channel_data_checks():
    """Channels must be as many as elements, delays one per transmit and element."""
    probe = Probe("p", torch.zeros(3, 3), 0.3, 5e6)
    with pytest.raises(ScanError, match="4 channels but probe 'p' has 3 elements"):
        ChannelData("x", np.zeros((1, 2, 4, 9)), probe, 2e7)
    with pytest.raises(ScanError, match="transmit delays"):
        ChannelData("x", np.zeros((1, 2, 3, 9)), probe, 2e7, transmit_delays_s=torch.zeros(1, 3))
    with pytest.raises(ScanError, match="must be above 0"):
        Probe("p", torch.zeros(3, 3), 0.0, 5e6)


def test_voxels_worked_example():
    """Voxel (1, 2, 3) of a grid whose x axis points along the reference's y."""
    grid = VolumeGrid(
        (9, 9, 9),
        (0.5, 1.0, 2.0),
        (10.0, 20.0, 30.0),
        ((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    )

    point = voxel_to_reference(grid) @ torch.tensor([1.0, 2, 3, 1], dtype=torch.float64)

    assert point.tolist() == [8.0, 20.5, 36.0, 1.0]


@given(scans())
def test_selecting_frames_selects_everything_with_them(scan):
    """Pixels, times and poses of the chosen frames stay together."""
    chosen = select_frames(scan, [1, 3])

    assert np.array_equal(chosen.frames[:], np.asarray(scan.frames)[[1, 3]])
    assert_close(chosen.timestamps_s, scan.timestamps_s[[1, 3]])
    assert_close(chosen.image_to_reference, scan.image_to_reference[[1, 3]])
    with pytest.raises(ScanError, match="frames 0 to 4"):
        select_frames(scan, [7])


@given(scans())
def test_untracked_frames_are_left_out(scan):
    """Only frames with a pose remain; without any pose the reader's reason is given."""
    seen = torch.tensor([True, False, True, True, False])

    tracked = select_tracked(replace(scan, tracked=seen))

    assert len(tracked.frames) == 3
    with pytest.raises(ScanError, match="no tracker was connected"):
        select_tracked(
            replace(scan, image_to_reference=None, notes={"poses": "no tracker was connected"})
        )
