"""Windows: drawn at random, and always the same ones."""

from collections import Counter

import numpy as np
import pytest
import torch

from sonosweep.errors import ScanError
from sonosweep.estimators.network_input import InputSettings
from sonosweep.training.augment import AugmentSettings, mirror_lateral
from sonosweep.training.recipe import Stage
from sonosweep.training.scans import FixedScans, training_scan
from sonosweep.training.sequences import (
    Batch,
    TrainingBatches,
    motion_statistics,
    pairs_done,
    step_place,
)
from tests.training.tiny import SIDE_PX, tiny_scan

PLAIN = AugmentSettings(mirror=False, reverse=False, gain=0, contrast=0, gamma=0, noise=0, blur=0)
STAGES = (
    Stage(pairs=12, window=2, batch=4, learning_rate=1e-3),
    Stage(pairs=12, window=4, batch=2, learning_rate=1e-4, strides=(1, 2)),
)
SINGLE = 1e-6  # float32 of scaled motions of about 1


def pool(count: int = 4, frames: int = 12) -> FixedScans:
    """Return some scans."""
    settings = InputSettings(rows=SIDE_PX, columns=SIDE_PX)
    return FixedScans([training_scan(tiny_scan(k, frames), settings) for k in range(count)])


def batches(augment: AugmentSettings = PLAIN, stages=STAGES, **others) -> TrainingBatches:
    """Return the batches of a run."""
    scans = pool()
    return TrainingBatches(scans, stages, motion_statistics(scans), augment, seed=1, **others)


def assert_same(a: Batch, b: Batch) -> None:
    """Check that two batches are the same, bit by bit."""
    for one, other in zip(a, b, strict=True):
        assert torch.equal(one, other)


def test_a_batch_follows_from_seed_and_step_alone():
    """Any batch may be asked for first; another seed gives others."""
    in_order = list(batches(AugmentSettings()))

    for step in (4, 0, 3):
        assert_same(batches(AugmentSettings()).batch(step), in_order[step])
    other = TrainingBatches(pool(), STAGES, motion_statistics(pool()), AugmentSettings(), seed=2)
    assert not torch.equal(other.batch(0).motion, in_order[0].motion)


def test_a_run_goes_on_with_the_batch_that_was_to_come():
    """From step 2 on, the batches are those of a run that was not stopped."""
    whole = list(batches())
    rest = list(batches(first_step=lambda: 2))

    assert len(whole) == 5
    assert len(rest) == 3
    for a, b in zip(whole[2:], rest, strict=True):
        assert_same(a, b)


def test_processes_share_a_batch():
    """Two processes see the halves of what one would see."""
    whole = batches().batch(1)
    halves = [batches(rank=rank, processes=2).batch(1) for rank in range(2)]

    for k, part in enumerate(whole):
        assert torch.equal(part, torch.cat([half[k] for half in halves]))


def test_a_batch_that_cannot_be_shared_is_refused():
    """Three processes cannot share four windows."""
    with pytest.raises(ScanError, match="a batch of 4 cannot be shared by 3"):
        batches(processes=3)


def test_a_window_shows_neighboring_frames_and_their_motion():
    """Frames and scaled motions are those of one scan from some frame on."""
    scans, statistics = pool(), motion_statistics(pool())
    batch = batches().batch(4)

    for frames, motion in zip(batch.frames, batch.motion, strict=True):
        found = []
        for k in range(len(scans)):
            scan = scans.scan(0, k)
            for stride in (1, 2):
                for start in scan.starts(4, stride):
                    chosen = start + stride * np.arange(4)
                    if np.array_equal(scan.stack(chosen), frames.numpy()):
                        found.append((scan, chosen, stride))
        assert len(found) == 1
        scan, chosen, stride = found[0]
        if stride == 1:
            true = scan.motion()[chosen[:-1]] / statistics.scale
            torch.testing.assert_close(motion, true.float(), atol=SINGLE, rtol=0)


def test_every_scan_gives_one_window_in_a_round():
    """Four scans, batches of four: each batch has a window of each scan."""
    scans = pool()
    origin = {scans.scan(0, k).frames[f].tobytes(): k for k in range(len(scans)) for f in range(12)}

    for step in range(3):
        batch = batches().batch(step)
        seen = Counter(origin[window[0].numpy().tobytes()] for window in batch.frames)
        assert seen == Counter(range(4))


def test_starts_are_spread_over_the_scan():
    """Of 400 windows of 2 frames, each of the 11 starts is drawn."""
    stages = (Stage(pairs=400, window=2, batch=400, learning_rate=1e-3),)
    scans = pool()
    number = {scans.scan(0, k).frames[f].tobytes(): f for k in range(len(scans)) for f in range(12)}

    batch = batches(stages=stages).batch(0)

    assert {number[window[0].numpy().tobytes()] for window in batch.frames} == set(range(11))


def test_mirrored_windows_have_flipped_frames_and_motions():
    """About half of the windows are mirrored; those are flipped, and the others are not."""
    stages = (Stage(pairs=64, window=2, batch=64, learning_rate=1e-3),)
    plain = batches(stages=stages).batch(0)
    mirrored = batches(PLAIN.model_copy(update={"mirror": True}), stages=stages).batch(0)
    flipped = [not torch.equal(a, b) for a, b in zip(plain.frames, mirrored.frames, strict=True)]

    assert 16 < sum(flipped) < 48  # 64 throws of a coin: 4 standard deviations
    for k, is_flipped in enumerate(flipped):
        frames, motion = plain.frames[k], plain.motion[k]
        if is_flipped:
            frames, motion = frames.flip(-1), mirror_lateral(motion)
        assert torch.equal(mirrored.frames[k], frames)
        torch.testing.assert_close(mirrored.motion[k], motion, atol=SINGLE, rtol=0)


def test_reversed_windows_have_the_same_frames_in_reverse():
    """About half of the windows run backwards, and still go forward in the mirror."""
    stages = (Stage(pairs=128, window=3, batch=64, learning_rate=1e-3),)
    plain = batches(stages=stages).batch(0)
    backward = batches(PLAIN.model_copy(update={"reverse": True}), stages=stages).batch(0)
    turned = [not torch.equal(a, b) for a, b in zip(plain.frames, backward.frames, strict=True)]

    assert 16 < sum(turned) < 48
    for k, is_turned in enumerate(turned):
        frames = plain.frames[k].flip(0) if is_turned else plain.frames[k]
        assert torch.equal(backward.frames[k], frames)
    assert bool((backward.motion[:, :, 2].mean(1) > 0).all())


def test_a_window_longer_than_a_scan_is_refused():
    """The sentence names the scan, and what to shorten."""
    stages = (Stage(pairs=12, window=13, batch=1, learning_rate=1e-3),)

    with pytest.raises(ScanError, match=r"'scan.' has no 13 tracked frames in a row: shorten"):
        batches(stages=stages).batch(0)


def test_strides_that_do_not_fit_are_left_out():
    """Seven frames at a distance of 2 do not fit in 12; at a distance of 1 they do."""
    stages = (Stage(pairs=48, window=7, batch=8, learning_rate=1e-3, strides=(1, 2)),)

    assert batches(stages=stages).batch(0).frames.shape[:2] == (8, 7)


def test_the_scale_is_a_percentile_of_the_size():
    """98 % of the scaled motions are within 1, for each of the six numbers."""
    scans = pool(count=30, frames=40)

    scale = motion_statistics(scans).scale

    motion = torch.cat([scans.scan(0, k).motion() for k in range(30)])
    within = ((motion / scale).abs() <= 1).double().mean(0)
    # A percentile lies between two of 1170 steps.
    torch.testing.assert_close(within, torch.full_like(within, 0.98), atol=1 / 1170, rtol=0)


def test_the_scale_may_be_the_deviation():
    """As told: the standard deviation of the steps."""
    scans = pool()

    found = motion_statistics(scans, "deviation")

    motion = torch.cat([scans.scan(0, k).motion() for k in range(4)])
    torch.testing.assert_close(found.scale, motion.std(0))
    torch.testing.assert_close(found.mean, motion.mean(0))


def test_steps_know_their_stage_and_windows():
    """Three steps of four windows, then two of two windows with three pairs each."""
    places = [step_place(STAGES, step) for step in range(5)]

    assert [place.stage for place in places] == [0, 0, 0, 1, 1]
    assert [place.first_window for place in places] == [0, 4, 8, 12, 14]
    assert [pairs_done(STAGES, step) for step in range(6)] == [0, 4, 8, 12, 18, 24]
    with pytest.raises(ScanError, match="no step 5"):
        step_place(STAGES, 5)
