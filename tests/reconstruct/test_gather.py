"""Gather compounding: exact, order-free, hole-free, and nearer the truth."""

import numpy as np
import pytest
import torch

from sonosweep.errors import ScanError
from sonosweep.geometry import pose_from_parts, rotation_from_euler, scale_pixels
from sonosweep.reconstruct.forward import compound_forward
from sonosweep.reconstruct.gather import GatherCompounder
from sonosweep.reconstruct.grid import grid_of_sweep
from sonosweep.reconstruct.planes import gaps_mm, planes_of_frames
from sonosweep.reconstruct.retire import compound_gather
from sonosweep.scan import VolumeGrid, voxel_to_reference

from .oracles import gather
from .sweeps import PIXEL_TO_IMAGE, frames_of_phantom, phantom, winding_sweep

# Samples lie on sixteenths of a pixel, where the phantom's gray levels are steep: half a
# sixteenth in both directions of 60 levels per pixel; weights have 64 levels.
LARGEST_ERROR = 5.0
TYPICAL_ERROR = 0.6
ROWS, COLUMNS = 40, 32


def sweep(frames=30, noise=0.0):
    """Return frames of the phantom, their poses and their grid."""
    poses = winding_sweep(frames)
    pixels = frames_of_phantom(poses, ROWS, COLUMNS, noise)
    return pixels, poses, grid_of_sweep(poses, PIXEL_TO_IMAGE, ROWS, COLUMNS, 0.3)


def truth(grid):
    """Return the phantom at the voxels of a grid."""
    index = np.stack(np.meshgrid(*(np.arange(n) for n in grid.size), indexing="ij"), -1)
    matrix = voxel_to_reference(grid).numpy()
    return phantom(index @ matrix[:3, :3].T + matrix[:3, 3]).transpose(2, 1, 0)


def stream(frames, poses, grid, **options):
    """Return the compounder that took the frames one by one."""
    compounder = GatherCompounder(grid, PIXEL_TO_IMAGE, frames.shape[1:], frames.dtype, **options)
    for frame, pose in zip(frames, poses, strict=True):
        compounder.add(frame, pose)
    return compounder


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_voxels_are_distance_weighted_means(axis, dtype):
    """Sweeps along each axis agree with the plain definition in double precision."""
    frames, poses, _ = sweep(15)
    turn = torch.eye(4, dtype=torch.float64)
    turn[:3, :3] = torch.roll(turn[:3, :3], axis, dims=0)  # a cyclic change of axes
    poses = turn @ poses
    grid = grid_of_sweep(poses, PIXEL_TO_IMAGE, ROWS, COLUMNS, 0.3)
    expected, weight = gather(frames, poses, PIXEL_TO_IMAGE, grid, np.full(15, 0.7))

    volume = compound_gather(
        frames.astype(dtype), poses, PIXEL_TO_IMAGE, grid, radius_mm=0.7, prefilter=1, threads=1
    )

    sure = weight > 0.1  # below, 64 levels of weight are coarse
    error = np.abs(volume.voxels - expected)[sure]
    assert error.max() < LARGEST_ERROR
    assert error.mean() < TYPICAL_ERROR
    assert (volume.coverage[sure] > 0).all()
    assert (volume.coverage[weight == 0] == 0).all()


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_one_by_one_or_all_at_once(dtype):
    """Streaming, a stack and the whole recorded sweep give the same bits."""
    frames, poses, grid = sweep()
    frames = frames.astype(dtype)
    recorded = compound_gather(frames, poses, PIXEL_TO_IMAGE, grid, threads=1)
    stacked = GatherCompounder(grid, PIXEL_TO_IMAGE, (ROWS, COLUMNS), dtype, threads=3)
    stacked.add(frames, poses)

    streamed = stream(frames, poses, grid).volume()

    for other in (stacked.volume(), recorded):
        assert np.array_equal(streamed.voxels, other.voxels)
        assert np.array_equal(streamed.coverage, other.coverage)


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_threads_change_nothing(dtype):
    """The volume is the same to the bit for 1, 2, 3 and 8 threads."""
    frames, poses, grid = sweep()
    frames = frames.astype(dtype)
    one = compound_gather(frames, poses, PIXEL_TO_IMAGE, grid, threads=1)

    for threads in (2, 3, 8):
        many = compound_gather(frames, poses, PIXEL_TO_IMAGE, grid, threads=threads)
        assert np.array_equal(one.voxels, many.voxels)
        assert np.array_equal(one.coverage, many.coverage)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_a_frame_taken_out_was_never_there(dtype):
    """Removing frames leaves exactly the volume of the others; removing all, an empty one."""
    frames, poses, grid = sweep(12)
    frames = frames.astype(dtype)
    # A fixed radius, because without frame 4 the gap before frame 5 would be another.
    compounder = stream(frames, poses, grid, radius_mm=0.8)
    kept = [k for k in range(12) if k not in (4, 9)]
    others = stream(frames[kept], poses[kept], grid, radius_mm=0.8).volume()

    compounder.remove(frames[[4, 9]], poses[[4, 9]])

    assert np.array_equal(compounder.volume().voxels, others.voxels)
    assert np.array_equal(compounder.volume().coverage, others.coverage)
    for k in kept:
        compounder.remove(frames[k], poses[k])
    assert not compounder.volume().voxels.any()
    assert not compounder.volume().coverage.any()


def test_only_what_was_added_can_be_taken_out():
    """Another frame, another pose or a second time is refused, and nothing changes."""
    frames, poses, grid = sweep(4)
    compounder = stream(frames, poses, grid)
    before = compounder.volume().voxels

    with pytest.raises(ScanError, match="was not added at this pose"):
        compounder.remove(frames[0], poses[1])
    with pytest.raises(ScanError, match="frame 1 of those"):
        compounder.remove(frames[[2, 2]], poses[[2, 2]])

    assert np.array_equal(compounder.volume().voxels, before)


def test_a_refined_pose_replaces_the_old_one():
    """Taking a frame out and adding it where it belongs is as if it had been there."""
    frames, poses, grid = sweep(8)
    wrong = poses.clone()
    wrong[-1, 0, 3] += 0.5
    compounder = stream(frames, wrong, grid, radius_mm=0.8)

    compounder.remove(frames[-1], wrong[-1])
    compounder.add(frames[-1], poses[-1])

    right = stream(frames, poses, grid, radius_mm=0.8).volume()
    assert np.array_equal(compounder.volume().voxels, right.voxels)


def test_a_jump_begins_a_new_sweep():
    """After a jump of 50 mm a frame counts two voxels far, as the first frame of all does."""
    frames, poses, grid = sweep(2)
    jumped = poses.clone()
    jumped[1, 2, 3] += 50.0
    grid = grid_of_sweep(jumped, PIXEL_TO_IMAGE, ROWS, COLUMNS, 0.3)

    auto = compound_gather(frames, jumped, PIXEL_TO_IMAGE, grid)
    fixed = compound_gather(frames, jumped, PIXEL_TO_IMAGE, grid, radius_mm=0.6)

    assert np.array_equal(auto.coverage, fixed.coverage)


def test_an_emptied_volume_starts_anew():
    """Taking all frames out and adding them again gives the first volume again."""
    frames, poses, grid = sweep(6)
    compounder = stream(frames, poses, grid)
    before = compounder.volume()

    compounder.remove(frames, poses)
    compounder.add(frames, poses)

    assert np.array_equal(compounder.volume().voxels, before.voxels)
    assert np.array_equal(compounder.volume().coverage, before.coverage)


def test_foreign_byte_order_and_views_are_frames_too():
    """Big-endian, read-only and strided frames give what plain ones give."""
    frames, poses, grid = sweep(5)
    plain = compound_gather(frames.astype(np.uint16), poses, PIXEL_TO_IMAGE, grid)
    foreign = frames.astype(">u2")
    foreign.flags.writeable = False
    wide = np.repeat(frames, 2, axis=2)[:, :, ::2]

    assert np.array_equal(
        compound_gather(foreign, poses, PIXEL_TO_IMAGE, grid).voxels, plain.voxels
    )
    assert np.array_equal(stream(foreign, poses, grid).volume().voxels, plain.voxels)
    assert np.array_equal(
        stream(wide, poses, grid).volume().voxels,
        compound_gather(frames, poses, PIXEL_TO_IMAGE, grid).voxels,
    )


def test_gather_is_nearer_the_truth_than_forward():
    """On noisy frames of a phantom, gathering has the smallest error of all modes."""
    frames, poses, grid = sweep(40, noise=0.25)
    expected = truth(grid)
    options = {"interpolation": "linear", "threads": 1}
    linear = compound_forward(frames, poses, PIXEL_TO_IMAGE, grid, **options)
    nearest = compound_forward(frames, poses, PIXEL_TO_IMAGE, grid, threads=1)

    gathered = compound_gather(frames, poses, PIXEL_TO_IMAGE, grid, threads=1)

    common = (linear.coverage > 0) & (nearest.coverage > 0) & (gathered.coverage > 0)

    def rms(volume):
        return np.sqrt(np.mean((volume.voxels.astype(float) - expected)[common] ** 2))

    assert common.mean() > 0.3
    assert rms(gathered) < 0.9 * rms(linear)
    assert rms(linear) < rms(nearest)


def test_the_radius_closes_the_gaps_of_a_fast_sweep():
    """With a third of the frames, gathering covers what forward leaves as holes."""
    frames, poses, grid = sweep(60)
    full = compound_gather(frames, poses, PIXEL_TO_IMAGE, grid, threads=1)
    swept = full.coverage > 2  # inside, not the rim

    thinned = frames[::6], poses[::6], PIXEL_TO_IMAGE, grid
    holes = compound_forward(*thinned, interpolation="linear", threads=1)
    gathered = compound_gather(*thinned, threads=1)

    assert (gathered.coverage[swept] > 0).mean() > 0.99
    assert (holes.coverage[swept] > 0).mean() < 0.9


def test_constant_frames_make_a_constant_volume():
    """0, 1, 254 and 255 come out as they went in, with and without a prefilter."""
    poses = winding_sweep(6)
    grid = grid_of_sweep(poses, PIXEL_TO_IMAGE, 21, 17, 0.25)

    for gray in (0, 1, 254, 255):
        for prefilter in (1, 2, 3):
            frames = np.full((6, 21, 17), gray, np.uint8)
            volume = compound_gather(frames, poses, PIXEL_TO_IMAGE, grid, prefilter=prefilter)
            assert (volume.voxels[volume.coverage > 0] == gray).all()
            assert (volume.coverage > 0).mean() > 0.4


def test_masked_pixels_never_show():
    """Whatever a masked pixel holds, the volume is the same, and some of it is left."""
    frames, poses, grid = sweep(10)
    mask = np.random.default_rng(5).random((ROWS, COLUMNS)) > 0.05
    changed = frames.copy()
    changed[:, ~mask] = 255

    for prefilter in (1, 2):
        options = {"mask": mask, "prefilter": prefilter, "threads": 1}
        one = compound_gather(frames, poses, PIXEL_TO_IMAGE, grid, **options)
        other = compound_gather(changed, poses, PIXEL_TO_IMAGE, grid, **options)
        assert np.array_equal(one.voxels, other.voxels)
        assert (one.coverage > 0).mean() > 0.1


def test_checkerboards_are_not_masked():
    """Saturated black and white pixels, side by side, are pixels like others."""
    frames = (np.indices((8, 8)).sum(axis=0) % 2 * 255).astype(np.uint8)[None]
    grid = VolumeGrid(size=(8, 8, 1), spacing_mm=(1.0, 1.0, 1.0))
    poses = torch.eye(4, dtype=torch.float64)[None]
    one = scale_pixels((1.0, 1.0))

    volume = compound_gather(frames, poses, one, grid, mask=np.ones((8, 8), bool))

    assert np.abs(volume.voxels[0].astype(int) - frames[0]).max() <= 1


def test_confidence_weighs_and_zero_is_absent():
    """A frame of confidence 0 changes nothing; one of a half pulls half as much."""
    frames = np.stack((np.full((6, 6), 100, np.uint8), np.full((6, 6), 190, np.uint8)))
    poses = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    grid = grid_of_sweep(poses, PIXEL_TO_IMAGE, 6, 6, 0.2)

    def gray(second):
        confidence = torch.tensor([1.0, second], dtype=torch.float64)
        volume = compound_gather(frames, poses, PIXEL_TO_IMAGE, grid, confidence=confidence)
        return set(np.unique(volume.voxels))

    assert gray(0.0) == {100}
    assert gray(0.5) == {130}  # 31 of 63 + 31 weights
    assert gray(1.0) == {145}
    with pytest.raises(ScanError, match="between 0 and 1"):
        gray(1.5)


def test_a_probe_on_hold_does_not_overflow():
    """20,000 frames in one place keep their mean; only taking them out ends."""
    poses = torch.eye(4, dtype=torch.float64)[None].expand(500, 4, 4)
    grid = grid_of_sweep(poses[:1], PIXEL_TO_IMAGE, 2, 2, 0.2)
    frames = np.full((500, 2, 2), 255, np.uint8)
    frames[::2] = 155
    compounder = GatherCompounder(grid, PIXEL_TO_IMAGE, (2, 2), threads=1)

    for _ in range(40):
        compounder.add(frames, poses)

    assert (compounder.volume().voxels == 205).all()
    with pytest.raises(ScanError, match="can no longer be taken out"):
        compounder.remove(frames[0], poses[0])


def test_frames_partly_or_wholly_outside():
    """A frame that leaves the grid contributes what is inside and harms nothing."""
    frames, poses, grid = sweep(10)
    far = poses.clone()
    far[3, 0, 3] += 1e6
    far[5, 1, 3] += 3.0

    volume = compound_gather(frames, far, PIXEL_TO_IMAGE, grid, radius_mm=0.6, prefilter=1)

    expected, weight = gather(frames, far, PIXEL_TO_IMAGE, grid, np.full(10, 0.6))
    sure = weight > 0.1
    assert np.abs(volume.voxels - expected)[sure].max() < LARGEST_ERROR


def test_the_gap_is_that_of_the_farthest_corner():
    """Planes 1 mm apart that open by 0.1 rad over 10 mm are 2 mm apart at the far end."""
    turn = rotation_from_euler(torch.tensor([[0, 0, 0], [0, -0.1, 0]], dtype=torch.float64), "XYZ")
    place = torch.tensor([[0.0, 0, 0], [0, 0, 1.0]], dtype=torch.float64)
    planes = planes_of_frames(pose_from_parts(turn, place), PIXEL_TO_IMAGE)

    gap = gaps_mm(planes, rows=11, columns=51)[0]

    assert gap == pytest.approx(1 + 10 * np.sin(0.1), abs=1e-12)


def test_bad_settings_are_refused():
    """Radius, prefilter, shapes and types that cannot be are named."""
    frames, poses, grid = sweep(3)
    call = frames, poses, PIXEL_TO_IMAGE, grid
    compounder = GatherCompounder(grid, PIXEL_TO_IMAGE, (ROWS, COLUMNS))

    with pytest.raises(ScanError, match="radius must be above 0"):
        compound_gather(*call, radius_mm=0.0)
    with pytest.raises(ScanError, match="1 pixel or more"):
        compound_gather(*call, prefilter=0)
    with pytest.raises(ScanError, match="type float32 in a volume"):
        compounder.add(frames.astype(np.float32), poses)
    with pytest.raises(ScanError, match="3 frames but 2 poses"):
        compounder.add(frames, poses[:2])
    with pytest.raises(ScanError, match="int64 cannot be compounded"):
        GatherCompounder(grid, PIXEL_TO_IMAGE, (ROWS, COLUMNS), np.int64)
