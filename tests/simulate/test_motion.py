"""Sweeps as hands make them: exact, smooth, within the limits of the paper's data sets."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sonosweep.errors import ScanError
from sonosweep.simulate.motion import MotionSettings, draw_motion, sweep_poses
from sonosweep.simulate.seeds import generator
from sonosweep.simulate.sweep_path import sweep_path
from tests.simulate.motion_bodies import arm

ARM = arm()
SHAPES = ("straight", "C", "L", "S")
# A robot's arm over the same path.
STEADY = {"hand_unsteadiness": 0.0, "tremor_mm": 0.0, "speed_variation": 0.0, "pauses": 0}
# How far a hand that pauses, but turns on, moves the middle and the ends of the array back.
BACKWARD_MM = {0.0: 0.06, -19.0: 0.25, 19.0: 0.25}


def steps_of(poses: np.ndarray) -> np.ndarray:
    """Return the pose of each next frame seen from this one."""
    return np.linalg.inv(poses[:-1]) @ poses[1:]


def draw(settings: MotionSettings, seed: int = 900_000) -> tuple[np.ndarray, np.ndarray]:
    """Return the poses and times of a sweep over the arm."""
    return sweep_poses(settings, ARM, generator(seed, 0, "motion"))


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("orientation", ["perpendicular", "parallel"])
def test_poses_are_rigid_and_frames_come_at_20_hz(shape, orientation):
    """A probe is a rigid body and a scanner has a steady clock."""
    poses, times = draw(MotionSettings(shape=shape, orientation=orientation, frames=500))

    turns = poses[:, :3, :3]
    assert np.abs(turns @ turns.transpose(0, 2, 1) - np.eye(3)).max() < 1e-12
    assert (np.linalg.det(turns) > 0).all()
    assert np.array_equal(poses[:, 3], np.tile([0.0, 0.0, 0.0, 1.0], (500, 1)))
    assert np.allclose(np.diff(times), 0.05, rtol=0, atol=1e-12)


@pytest.mark.parametrize("seed", range(900_000, 900_012))
def test_an_s_sweep_moves_as_the_papers_hands_do(seed):
    """At 20 Hz: 0 to 1 mm forward per frame at the middle and at both ends of the array."""
    settings = MotionSettings(shape="S", length_mm=200.0, frames=950)
    poses, _ = draw(settings, seed)

    for lateral_mm, backward_mm in BACKWARD_MM.items():
        image = np.eye(4)
        image[0, 3] = lateral_mm
        elevational = steps_of(poses @ image)[:, 2, 3]
        assert elevational.min() > -backward_mm
        assert elevational.max() <= 1
    assert 0.15 < elevational.mean() < 0.25
    assert elevational.min() < 0.02  # it pauses


def test_steps_scatter_as_measured_hands_do():
    """Standard deviations per frame at 20 Hz, within 35 % of those of real forearm sweeps."""
    drawn = [steps_of(draw(MotionSettings(), seed)[0]) for seed in range(900_000, 900_008)]
    steps = np.concatenate(drawn)
    turns = np.rad2deg(Rotation.from_matrix(steps[:, :3, :3]).as_rotvec())

    found = np.concatenate([steps[:, :3, 3].std(axis=0), turns.std(axis=0)])

    wanted = [0.10, 0.047, 0.20, 0.155, 0.16, 0.12]  # lateral, axial, elevational mm; degrees
    assert np.allclose(found, wanted, rtol=0.35, atol=0)


def test_a_backward_sweep_is_the_forward_one_reversed():
    """The same places in reversed order, so that only the order tells them apart."""
    settings = MotionSettings(frames=200, length_mm=60.0)
    forward, times = draw(settings)
    backward, again = draw(replace(settings, backward=True))

    # Times are reversed by a subtraction, which rounds.
    assert np.abs(backward - forward[::-1]).max() < 1e-9
    assert np.array_equal(times, again)


def test_poses_do_not_depend_on_the_clock_that_asks():
    """A tracker at 60 Hz sees every third pose where the scanner sees its frames."""
    motion = draw_motion(
        MotionSettings(frames=60, length_mm=20.0, excursion_mm=2.0), ARM, generator(900_001, 0, "m")
    )
    frames = motion.poses_at(motion.frame_times_s())
    samples = motion.poses_at(np.arange(178) / 60)

    assert np.abs(samples[::3] - frames).max() < 1e-9


def test_motion_is_smooth():
    """Without tremor the speed of the face changes by little from frame to frame."""
    poses, _ = draw(MotionSettings(tremor_mm=0.0))
    velocity = np.diff(poses[:, :3, 3], axis=0)
    # Half a second of slowing down from 0.8 mm per frame takes 0.12 mm per frame and frame.
    assert np.abs(np.diff(velocity, axis=0)).max() < 0.15


@given(
    st.sampled_from(SHAPES),
    st.floats(40, 200),
    st.floats(-8, 8).filter(lambda value: abs(value) > 1e-3),
)
def test_a_path_has_the_length_and_excursion_asked_for(shape, length_mm, excursion_mm):
    """The line on the skin is as long as said, whatever its bends."""
    path = sweep_path(shape, length_mm, excursion_mm)

    assert path.lengths_mm[-1] == pytest.approx(length_mm, abs=5e-3)  # chords of bends
    if shape != "straight":
        farthest = path.across_mm[np.abs(path.across_mm).argmax()]
        assert abs(farthest) == pytest.approx(abs(excursion_mm), rel=1e-4)
    if shape in ("C", "L"):
        assert np.sign(farthest) == np.sign(excursion_mm)


def test_the_probe_lies_on_the_skin():
    """The face's middle keeps its gel gap over the highest skin below the face."""
    poses, _ = draw(MotionSettings(**STEADY, gel_mm=0.7, excursion_mm=1e-6, shape="S"))
    # On this arm that is the crest, 4 mm deep and falling by 2 % along it.
    crest = 4 + 0.02 * poses[:, 2, 3]
    gap = crest - poses[:, 1, 3]

    assert np.all((gap > 0.2) & (gap < 0.9))  # the crest is rounded by the face's softness


def test_the_probe_tilts_with_the_skin():
    """Beside the crest the lateral axis goes down with the skin."""
    settings = MotionSettings(shape="straight", **STEADY, frames=50, length_mm=20.0)
    right, _ = draw(replace(settings, offset_mm=(15.0, 0.0)))
    left, _ = draw(replace(settings, offset_mm=(-15.0, 0.0)))

    slope = 2 * 15 / 144  # of (x / 12)^2
    assert right[25, 1, 0] == pytest.approx(slope, abs=0.05)
    assert left[25, 1, 0] == pytest.approx(-slope, abs=0.05)
    assert right[25, 1, 2] == pytest.approx(0.02, abs=0.005)  # the arm's taper


def test_orientation_turns_the_image_plane():
    """Perpendicular frames lie across the arm, parallel ones along it."""
    straight = MotionSettings(shape="straight", **STEADY, frames=50, length_mm=40.0)
    across, _ = draw(straight)
    along, _ = draw(replace(straight, orientation="parallel"))

    assert np.allclose(steps_of(across)[:, :3, 3].mean(axis=0), [0, 0, 40 / 49], atol=0.03)
    assert np.allclose(steps_of(along)[:, :3, 3].mean(axis=0), [40 / 49, 0, 0], atol=0.03)


def test_the_same_seed_gives_the_same_bytes():
    """And another seed another sweep."""
    first, second, other = (
        draw(MotionSettings(frames=90, length_mm=40.0, pauses=0), s)[0] for s in (1, 1, 2)
    )

    assert first.tobytes() == second.tobytes()
    assert not np.allclose(first, other)


def test_one_frame_is_a_sweep_too():
    """A single image has a place."""
    poses, times = draw(MotionSettings(frames=1, length_mm=10.0, shape="straight"))

    assert poses.shape == (1, 4, 4)
    assert times.tolist() == [0.0]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"length_mm": 0.0}, "length_mm of a sweep must be above 0, got 0"),
        ({"length_mm": float("nan")}, "length_mm of a sweep must be above 0, got nan"),
        ({"frames": 0}, "from 1 to 100000 frames, got 0"),
        ({"frames": 10**9}, "from 1 to 100000 frames"),
        ({"tremor_mm": -1.0}, "tremor_mm of a sweep must be 0 or more, got -1"),
        ({"pauses": 5000}, "from 0 to 1000 pauses, got 5000"),
        ({"excursion_mm": float("inf")}, "must be finite"),
        ({"length_mm": 300.0, "frames": 2000}, "leaves phantom 'arm': the probe reaches z ="),
        ({"excursion_mm": 35.0}, "leaves phantom 'arm': the probe reaches x ="),
        ({"offset_mm": (0.0, 60.0)}, "another offset_mm"),
        ({"frames": 100}, "100 frames are too few for a sweep of 200 mm"),
        ({"excursion_mm": 300.0}, "too wide for a sweep of 200 mm in the shape of S"),
        ({"excursion_mm": 170.0, "shape": "L"}, "too wide for a sweep of 200 mm in the shape of L"),
        ({"hand_unsteadiness": 30.0}, "the probe turns so fast that its edge"),
    ],
)
def test_a_sweep_that_cannot_be_made_is_refused_in_one_sentence(changes, words):
    """The sentence names the value and what to do."""
    with pytest.raises(ScanError) as caught:
        draw(MotionSettings(**changes))

    assert words in str(caught.value)
