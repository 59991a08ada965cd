"""Forward compounding: what voxels make of the pixels that fall on them."""

import numpy as np
import pytest
import torch
from hypothesis import given

from sonosweep.errors import ScanError
from sonosweep.geometry import scale_pixels
from sonosweep.reconstruct.clip import Fan, pixel_mask, pixel_runs
from sonosweep.reconstruct.compound import compound_frames
from sonosweep.reconstruct.forward import compound_forward
from sonosweep.reconstruct.grid import grid_of_sweep
from sonosweep.scan import VolumeGrid

from ..strategies import sweeps
from .oracles import forward_nearest
from .sweeps import PIXEL_TO_IMAGE, winding_sweep

ROUNDING = 0.5  # gray levels, to the nearest integer
ONE_PIXEL = scale_pixels((1.0, 1.0))
STILL = torch.eye(4, dtype=torch.float64)


def random_frames(count=12, rows=24, columns=20, seed=0):
    """Return frames of noise."""
    return np.random.default_rng(seed).integers(0, 256, (count, rows, columns), dtype=np.uint8)


@given(image_to_reference=sweeps(frames=6))
def test_nearest_mean_is_the_mean_of_the_pixels(image_to_reference):
    """Every pixel counts once, in the voxel it lies in."""
    frames = random_frames(6, 12, 10)
    grid = grid_of_sweep(image_to_reference, PIXEL_TO_IMAGE, 12, 10, 0.5)
    total, count = forward_nearest(frames, image_to_reference, PIXEL_TO_IMAGE, grid)

    volume = compound_forward(frames, image_to_reference, PIXEL_TO_IMAGE, grid, threads=1)

    expected = np.floor(total / np.maximum(count, 1) + 0.5)
    assert np.array_equal(volume.voxels, expected)
    assert np.array_equal(volume.coverage, np.minimum(count, 255))


@pytest.mark.parametrize("frames", [600, 5000])
@pytest.mark.parametrize("interpolation", ["nearest", "linear"])
@pytest.mark.parametrize("method", ["forward", "gather"])
def test_a_probe_that_stands_still_gives_the_mean(method, interpolation, frames):
    """As many frames of 100 as of 200 make 150, in any number (PLUS: 100)."""
    pixels = np.full((frames, 3, 3), 100, np.uint8)
    pixels[1::2] = 200
    grid = VolumeGrid(size=(3, 3, 1), spacing_mm=(1.0, 1.0, 1.0))

    volume = compound_frames(
        pixels, STILL.expand(frames, 4, 4), ONE_PIXEL, grid, method=method,
        interpolation=interpolation, threads=1,
    )  # fmt: skip

    assert (volume.voxels == 150).all()


@pytest.mark.parametrize("interpolation", ["nearest", "linear"])
@pytest.mark.parametrize("compounding", ["mean", "latest", "maximum", "median"])
def test_threads_change_nothing(interpolation, compounding):
    """The volume is the same to the bit for 1, 2, 3 and 8 threads."""
    if (interpolation, compounding) == ("linear", "median"):
        pytest.skip("the median is over whole pixels")
    poses, frames = winding_sweep(12), random_frames()
    grid = grid_of_sweep(poses, PIXEL_TO_IMAGE, 24, 20, 0.3)

    def compound(threads):
        return compound_forward(
            frames, poses, PIXEL_TO_IMAGE, grid, interpolation=interpolation,
            compounding=compounding, threads=threads,
        )  # fmt: skip

    one = compound(1)
    for threads in (2, 3, 8):
        many = compound(threads)
        assert np.array_equal(many.voxels, one.voxels)
        assert np.array_equal(many.coverage, one.coverage)


def test_worked_example_of_each_compounding():
    """The pixels 10, 60 and 20 in one voxel: their mean, latest, maximum and median."""
    frames = np.array([10, 60, 20], np.uint8).reshape(3, 1, 1)
    grid = VolumeGrid(size=(1, 1, 1), spacing_mm=(1.0, 1.0, 1.0))

    def value(compounding):
        volume = compound_forward(
            frames, STILL.expand(3, 4, 4), ONE_PIXEL, grid, compounding=compounding
        )
        return volume.voxels.item()

    found = [value(name) for name in ("mean", "latest", "maximum", "median")]

    assert found == [30, 20, 60, 20]


def test_linear_shares_a_pixel_by_distance():
    """A pixel of 80 and one of 160 a quarter apart from two voxels each mix 3 to 1."""
    frames = np.array([[[80]], [[160]]], np.uint8)
    poses = STILL.repeat(2, 1, 1)
    poses[0, 0, 3], poses[1, 0, 3] = 0.25, 0.75
    grid = VolumeGrid(size=(2, 1, 1), spacing_mm=(1.0, 1.0, 1.0))

    volume = compound_forward(frames, poses, ONE_PIXEL, grid, interpolation="linear")

    assert volume.voxels.ravel().tolist() == [100, 140]


@pytest.mark.parametrize("method", ["forward", "gather"])
@pytest.mark.parametrize("interpolation", ["nearest", "linear"])
def test_other_pixel_types_give_the_same_means(method, interpolation):
    """8-bit frames as 16-bit, floats or colour differ by rounding alone."""
    poses, frames = winding_sweep(12), random_frames()
    grid = grid_of_sweep(poses, PIXEL_TO_IMAGE, 24, 20, 0.4)

    def compound(pixels):
        return compound_frames(
            pixels, poses, PIXEL_TO_IMAGE, grid, method=method, interpolation=interpolation,
            prefilter=1, threads=1,
        )  # fmt: skip

    gray = compound(frames).voxels.astype(float)
    exact = compound(frames.astype(np.float32)).voxels
    wide = compound(frames.astype(np.uint16) * 100).voxels
    colour = compound(np.stack((frames, frames // 2), axis=-1)).voxels

    assert np.abs(exact - gray).max() <= ROUNDING + 1 / 16  # samples of bytes are 16ths
    assert np.abs(wide / 100 - exact).max() <= ROUNDING / 100 + 1e-4
    assert np.abs(colour[..., 0] - gray).max() <= 1


def test_pixels_that_are_not_numbers_do_not_count():
    """A hole in a float frame leaves the voxel to the other frames."""
    frames = np.ones((2, 2, 2), np.float32)
    frames[1] = np.nan
    grid = VolumeGrid(size=(2, 2, 1), spacing_mm=(1.0, 1.0, 1.0))

    volume = compound_forward(frames, STILL.expand(2, 4, 4), ONE_PIXEL, grid)

    assert (volume.voxels == 1).all()
    assert (volume.coverage == 1).all()


@pytest.mark.parametrize("method", ["forward", "gather"])
def test_dark_pixels_can_be_left_out(method):
    """With a threshold, shadow does not darken what another frame saw."""
    frames = np.array([2, 90], np.uint8)[:, None, None] * np.ones((1, 4, 4), np.uint8)
    grid = VolumeGrid(size=(4, 4, 1), spacing_mm=(1.0, 1.0, 1.0))

    volume = compound_frames(
        frames, STILL.expand(2, 4, 4), ONE_PIXEL, grid, method=method, reject_below=3.0
    )

    assert (volume.voxels == 90).all()


@pytest.mark.parametrize("method", ["forward", "gather"])
def test_clipped_pixels_never_show(method):
    """Text outside the rectangle and the fan leaves no trace in the volume."""
    frames = np.full((3, 40, 40), 255, np.uint8)
    fan = Fan(angles_deg=(-40.0, 40.0), origin_px=(20.0, -5.0), start_px=10.0, stop_px=35.0)
    inside = pixel_mask(40, 40, rectangle_px=(2, 2, 30, 30), fan=fan)
    frames[:, inside] = 50
    poses = winding_sweep(3, length_mm=1.0)
    grid = grid_of_sweep(poses, PIXEL_TO_IMAGE, 40, 40, 0.4)

    volume = compound_frames(
        frames, poses, PIXEL_TO_IMAGE, grid, method=method, rectangle_px=(2, 2, 30, 30), fan=fan
    )

    assert set(np.unique(volume.voxels)) == {0, 50}


def test_the_fan_is_measured_from_straight_down():
    """A fan to the right of its origin keeps pixels to the right and below."""
    mask = pixel_mask(9, 9, fan=Fan((0.0, 90.0), (4.0, 4.0), 0.0, 3.0))

    assert mask[4, 7]
    assert mask[7, 4]
    assert not mask[4, 1]
    assert not mask[1, 4]
    assert not mask[7, 7]


def test_runs_are_the_mask():
    """Writing ones along the runs of a mask gives the mask."""
    mask = np.random.default_rng(3).random((20, 30)) < 0.6
    first, runs = pixel_runs(mask)

    again = np.zeros_like(mask)
    for row in range(20):
        for start, stop in runs[first[row] : first[row + 1]]:
            again[row, start:stop] = True

    assert np.array_equal(again, mask)


def test_every_second_frame():
    """Skipping frames is compounding the others."""
    poses, frames = winding_sweep(12), random_frames()
    grid = grid_of_sweep(poses, PIXEL_TO_IMAGE, 24, 20, 0.4)

    skipped = compound_frames(frames, poses, PIXEL_TO_IMAGE, grid, method="forward", skip=2)
    chosen = compound_frames(frames[::2], poses[::2], PIXEL_TO_IMAGE, grid, method="forward")

    assert np.array_equal(skipped.voxels, chosen.voxels)


@pytest.mark.parametrize("method", ["forward", "gather"])
def test_what_cannot_be_compounded_is_refused(method):
    """Counts, types, poses and settings that do not fit are named in one sentence."""
    poses, frames = winding_sweep(12), random_frames()
    grid = grid_of_sweep(poses, PIXEL_TO_IMAGE, 24, 20, 0.4)
    elsewhere = VolumeGrid(size=(4, 4, 4), spacing_mm=(1.0,) * 3, origin_mm=(900.0, 0.0, 0.0))
    missing = poses.clone()
    missing[7] = torch.nan

    def refuses(pattern, pixels=frames, at=poses, on=grid, **options):
        with pytest.raises(ScanError, match=pattern):
            compound_frames(pixels, at, PIXEL_TO_IMAGE, on, method=method, **options)

    refuses("12 frames but 11 poses", at=poses[:11])
    refuses("no frames", pixels=frames[:0], at=poses[:0])
    refuses("complex64 cannot be compounded.*uint8", pixels=frames.astype(np.complex64))
    refuses("frame 7 ", at=missing)
    refuses("grid: check its origin", on=elsewhere)
    refuses(r"mask of shape \(3, 3\)", mask=np.ones((3, 3), bool))
    refuses("leave no pixel", mask=np.zeros((24, 20), bool))
    refuses("skip must be", skip=0)
    refuses("at least one thread", threads=0)
