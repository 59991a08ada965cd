"""Mirrors and reversal are exact: images of a field in space tell."""

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from sonosweep.estimators.network_input import center_poses
from sonosweep.geometry import (
    motion_from_step,
    poses_from_steps,
    step_from_motion,
    steps_from_poses,
)
from sonosweep.training.augment import (
    AugmentSettings,
    change_looks,
    draw_looks,
    mirror_lateral,
    reverse_in_elevational_mirror,
)

ROUND_OFF = 1e-9  # float64: mm and rad of some steps, gray levels of 1
ROWS, COLUMNS, SPACING_MM = 12, 9, (0.4, 0.3)
CENTER_MM = ((COLUMNS - 1) / 2 * SPACING_MM[0], (ROWS - 1) / 2 * SPACING_MM[1])

Field = Callable[[Tensor], Tensor]


def speckle(points: Tensor) -> Tensor:
    """Return a field in space that has no symmetry: waves in random directions."""
    draw = torch.Generator().manual_seed(5)
    waves = torch.randn(20, 3, generator=draw, dtype=torch.float64)
    phases = 6 * torch.rand(20, generator=draw, dtype=torch.float64)
    return torch.cos(points @ waves.T + phases).sum(-1)


def frames(image_to_world: Tensor, field: Field) -> Tensor:
    """Return what a probe sees of a field at each pose of its image."""
    y, x = torch.meshgrid(
        torch.arange(ROWS).double(), torch.arange(COLUMNS).double(), indexing="ij"
    )
    pixels = torch.stack((x * SPACING_MM[0], y * SPACING_MM[1], 0 * x, 1 + 0 * x), dim=-1)
    points = pixels.reshape(-1, 4) @ image_to_world.mT
    return field(points[..., :3]).unflatten(-1, (ROWS, COLUMNS))


def sweep(seed: int) -> Tensor:
    """Return poses of the image with large turns and shifts."""
    draw = torch.Generator().manual_seed(seed)
    motion = torch.randn(5, 6, generator=draw, dtype=torch.float64) * 0.4
    return poses_from_steps(step_from_motion(motion), torch.eye(4, dtype=torch.float64))


def motion_of(image_to_world: Tensor) -> Tensor:
    """Return the motions of the frame's centre."""
    return motion_from_step(steps_from_poses(center_poses(image_to_world, CENTER_MM)))


def poses_of(center_motion: Tensor) -> Tensor:
    """Return poses of the image whose centre moves like this, the first centre at the origin."""
    center = poses_from_steps(step_from_motion(center_motion), torch.eye(4, dtype=torch.float64))
    return center_poses(center, (-CENTER_MM[0], -CENTER_MM[1]))


@pytest.mark.parametrize("seed", range(3))
def test_flipped_frames_are_those_of_a_mirrored_body(seed):
    """A mirrored body swept with the mirrored motion gives the flipped frames."""
    poses = poses_of(motion_of(sweep(seed)))
    mirror = torch.tensor([-1.0, 1, 1], dtype=torch.float64)

    seen = frames(poses_of(mirror_lateral(motion_of(poses))), lambda p: speckle(p * mirror))

    torch.testing.assert_close(seen, frames(poses, speckle).flip(-1), atol=ROUND_OFF, rtol=0)


@pytest.mark.parametrize("seed", range(3))
def test_reversed_frames_are_those_of_a_mirrored_body(seed):
    """A body mirrored across the last frame, swept on from there, gives the frames reversed."""
    poses = sweep(seed)
    last = center_poses(poses, CENTER_MM)[-1]
    mirror = torch.tensor([1.0, 1, -1, 1], dtype=torch.float64)

    def body(points: Tensor) -> Tensor:
        there = torch.cat((points, torch.ones_like(points[..., :1])), dim=-1) * mirror
        return speckle((there @ last.mT)[..., :3])

    seen = frames(poses_of(reverse_in_elevational_mirror(motion_of(poses))), body)

    torch.testing.assert_close(seen, frames(poses, speckle).flip(0), atol=ROUND_OFF, rtol=0)


@pytest.mark.parametrize("change", [mirror_lateral, reverse_in_elevational_mirror])
def test_a_mirror_undoes_itself(change):
    """Seen in a mirror twice, a sweep is itself."""
    motion = motion_of(sweep(7))

    torch.testing.assert_close(change(change(motion)), motion, atol=ROUND_OFF, rtol=0)


def test_a_sweep_that_goes_forward_still_does():
    """Played backwards in the mirror, a straight forward sweep has the same motion."""
    motion = torch.zeros(4, 6, dtype=torch.float64)
    motion[:, 2] = torch.tensor([0.1, 0.2, 0.3, 0.4])

    back = reverse_in_elevational_mirror(motion)

    torch.testing.assert_close(back, motion.flip(0), atol=ROUND_OFF, rtol=0)


def looks(**chosen: float) -> Tensor:
    """Return changes of one window's image, none but the chosen."""
    numbers = {"gain": 0.0, "contrast": 1.0, "gamma": 1.0, "noise": 0.0, "blur": 0.0} | chosen
    return torch.tensor([list(numbers.values())])


def window(channels: int = 1) -> Tensor:
    """Return one window of two frames from 0 to 1."""
    return torch.rand(1, 2, channels, 8, 8, generator=torch.Generator().manual_seed(2))


def test_no_change_leaves_a_frame_as_it_is():
    """Gain 0, contrast 1, exponent 1, no noise and no blur is the frame itself."""
    same = change_looks(window(3), looks(), (None, 0.5, 0.0))

    torch.testing.assert_close(same, window(3), atol=1e-6, rtol=0)  # float32 of numbers to 1


@pytest.mark.parametrize(
    ("chosen", "level"),
    [({"gain": 0.1}, 0.4), ({"contrast": 0.5}, 0.4), ({"gamma": 2.0}, 0.09), ({"blur": 1.0}, 0.3)],
)
def test_a_gray_of_three_tenths_becomes(chosen, level):
    """0.3 + 0.1, half as far from 0.5, squared, and the mean of equals."""
    gray = torch.full((1, 2, 1, 8, 8), 0.3)

    changed = change_looks(gray, looks(**chosen), (None,))

    torch.testing.assert_close(changed, torch.full_like(gray, level), atol=1e-6, rtol=0)


def test_echoes_change_about_what_stands_for_none():
    """A tenth more gain moves an IQ value of 0.7 to 0.72, and leaves 0.5 where it is."""
    echoes = torch.full((1, 2, 1, 8, 8), 0.7)
    echoes[..., 0] = 0.5

    changed = change_looks(echoes, looks(gain=0.1), (0.5,))

    assert changed[0, 0, 0, 0, 0] == pytest.approx(0.5)
    assert changed[0, 0, 0, 0, 1] == pytest.approx(0.72)


def test_noise_is_as_strong_as_said_and_new_in_each_frame():
    """Noise of 0.02 on middle gray has that standard deviation; frames do not share it."""
    gray = torch.full((1, 2, 1, 64, 64), 0.5)
    torch.manual_seed(0)

    noise = change_looks(gray, looks(noise=0.02), (None,)) - gray

    # 4096 pixels: the standard deviation is known to 1.1 %, 4 sigma are 5 %.
    assert float(noise[0, 0].std()) == pytest.approx(0.02, rel=0.05)
    both = torch.corrcoef(noise[0, :, 0].flatten(1))[0, 1]
    assert abs(float(both)) < 4 / math.sqrt(4096)


def test_looks_stay_within_what_was_asked():
    """A hundred draws are within their limits and reach beyond half of them."""
    settings = AugmentSettings(gain=0.1, contrast=0.2, gamma=0.3, noise=0.04, blur=0.5)
    draw = np.random.default_rng(0)

    drawn = np.array([draw_looks(settings, draw) for _ in range(100)])

    drawn = np.abs(drawn - [0, 1, 0, 0, 0])
    drawn[:, 2] = np.abs(np.log(drawn[:, 2]))
    limits = np.array([0.1, 0.2, 0.3, 0.04, 0.5])
    assert (drawn.max(0) <= limits * (1 + 1e-6)).all()
    assert (drawn.max(0) > limits / 2).all()


def test_whatever_is_drawn_frames_stay_from_0_to_1():
    """The strongest changes at once leave no value outside."""
    strong = looks(gain=0.5, contrast=1.9, gamma=2.7, noise=0.5, blur=1.0)

    changed = change_looks(window(3), strong, (None, 0.0, 0.5))

    assert 0 <= float(changed.min()) <= float(changed.max()) <= 1
