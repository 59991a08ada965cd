"""The sensorless estimator on speckle whose motion is exactly known."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from sonosweep.errors import ScanError
from sonosweep.estimators.decorrelation import TURN_STD_RAD, DecorrelationEstimator
from sonosweep.estimators.decorrelation_curve import DecorrelationCurve, curve_from_speckle
from sonosweep.estimators.matching import SAMPLED_FRAMES
from sonosweep.geometry import step_from_motion, transform_points
from sonosweep.scan import Calibration, Region, Scan
from tests.estimators.speckle import AMPLITUDE_WIDTH_MM, SPACING_MM, sweep

THEORY = DecorrelationCurve(width_mm=(AMPLITUDE_WIDTH_MM,))
PIXELS = 128
ROWS_LIT = 80
MIDDLE_MM = (PIXELS - 1) / 2 * SPACING_MM

SHIFT_MM = 0.02  # an eighth of a pixel; the axial speckle is only 1.6 pixels wide
TURN_RAD = math.radians(0.15)  # 19 mm field of view at 0.2 mm of elevational distance
ROUND_OFF = 1e-4  # float32 textures
SLIDE_PX = 0.03  # the widest slide leaves the fewest patches
FOLLOWED = 0.99
REVERSED_MM = 0.01  # searched around other frames, weighted by other fits
CALIBRATED = DecorrelationCurve(width_mm=(0.42,), exponent=1.91, source="tracked")
PURE_FINENESS = 27.0  # of this speckle without structure, at two columns
SCALE = 0.1  # a curve from theory: amplitude is not exactly rho^2, which counts for short steps


def about_the_middle(motion: torch.Tensor) -> np.ndarray:
    """Return motions of the middle of the image, to first order."""
    result = motion.numpy().copy()
    pitch, yaw, roll = result[:, 3:].T
    result[:, 0] -= roll * MIDDLE_MM
    result[:, 1] += roll * MIDDLE_MM
    result[:, 2] += (pitch - yaw) * MIDDLE_MM
    return result


def turning_about_the_middle(motion: np.ndarray) -> np.ndarray:
    """Return motions about the image's origin that are ``motion`` of its middle."""
    step = step_from_motion(torch.as_tensor(motion, dtype=torch.float64))
    middle = torch.tensor([[MIDDLE_MM, MIDDLE_MM, 0.0]], dtype=torch.float64)
    wanted = middle + torch.as_tensor(motion[:, None, :3])
    turned = transform_points(step, middle) - torch.as_tensor(motion[:, None, :3])
    result = motion.copy()
    result[:, :3] = (wanted - turned)[:, 0].numpy()
    return result


def straight(seed: int, steps: int = 20, slowest=0.06, fastest=0.28) -> np.ndarray:
    """Return the motion of a straight sweep of uneven speed with a little in-plane motion."""
    rng = np.random.default_rng(seed)
    motion = np.zeros((steps, 6))
    motion[:, 0] = rng.normal(0, 0.08, steps)
    motion[:, 1] = rng.normal(0, 0.04, steps)
    motion[:, 2] = rng.uniform(slowest, fastest, steps)
    return motion


def test_steps_of_pure_speckle_are_recovered():
    """The distances between frames of fully developed speckle follow from theory alone."""
    motion = straight(5)

    estimate = DecorrelationEstimator(THEORY).estimate(sweep(motion))

    found = about_the_middle(estimate.motion)
    assert abs(found[:, 2].sum() / motion[:, 2].sum() - 1) < SCALE
    assert np.corrcoef(found[:, 2], motion[:, 2])[0, 1] > FOLLOWED
    assert np.sqrt(((found - motion)[:, :2] ** 2).mean()) < SHIFT_MM


def test_shifts_in_plane_are_found_to_a_hundredth_of_a_pixel():
    """Frames of one plane that only slid are put back onto each other."""
    shift_px = np.array([[0.25, 0], [0, 0.25], [0.5, 0.1], [-0.3, 0.4], [3.2, -2.7]])
    motion = np.zeros((5, 6))
    motion[:, :2] = shift_px * SPACING_MM

    found = about_the_middle(DecorrelationEstimator(THEORY).estimate(sweep(motion)).motion)

    error_px = (found[:, :2] - motion[:, :2]) / SPACING_MM
    assert np.abs(error_px).max() < SLIDE_PX


def test_the_standard_deviations_are_those_of_the_errors():
    """Errors divided by their stated deviation scatter by about one, on every axis."""
    rng = np.random.default_rng(3)
    ratios = []
    for seed in range(3):
        middle = straight(seed)
        middle[:, 3:] = np.radians(rng.normal(0, 0.15, (len(middle), 3)))
        motion = turning_about_the_middle(middle)
        estimate = DecorrelationEstimator(CALIBRATED).estimate(sweep(motion, seed))
        assert estimate.std is not None
        ratios.append((estimate.motion - torch.from_numpy(motion)) / estimate.std)

    spread = torch.cat(ratios).std(dim=0)
    assert bool(((spread > 0.5) & (spread < 2)).all()), spread


def test_small_turns_are_expected_before_large_ones():
    """Of a sweep without turns, noise makes fewer the less of them are expected."""
    scan = sweep(straight(4))

    def turns(std_rad):
        found = DecorrelationEstimator(CALIBRATED, turn_std_rad=std_rad).estimate(scan).motion
        return float(found[:, 3:5].square().mean().sqrt())

    strict, default, free = turns(1e-5), turns(TURN_STD_RAD), turns(1.0)

    assert strict < 1e-4
    assert strict < default < 0.9 * free


def test_a_sweep_backward_is_as_long_as_forward():
    """Playing a sweep in reverse changes the sign of its motion and not its length."""
    scan = sweep(straight(2))
    backward = Scan("back", scan.frames[::-1], scan.calibration)

    there = about_the_middle(DecorrelationEstimator(THEORY).estimate(scan).motion)[:, 2]
    back = about_the_middle(DecorrelationEstimator(THEORY).estimate(backward).motion)[:, 2]

    assert np.abs(there - back[::-1]).max() < REVERSED_MM


def test_structured_tissue_is_measured_better_with_its_coherence():
    """Tissue that stays alike for longer seems nearer than it is, unless that is seen."""
    motion = straight(4)
    scan = sweep(motion, 4, structure=1.2, structure_mm=1.0)
    plain = DecorrelationCurve(width_mm=(AMPLITUDE_WIDTH_MM,), coherence=0.0)
    # The same scan with structure in the lower half only, so that both kinds are in view.
    frames = scan.frames[:].copy()
    frames[:, : PIXELS // 2] = sweep(motion, 4).frames[:, : PIXELS // 2]
    half = Scan("half", frames, scan.calibration)

    def error(curve: DecorrelationCurve) -> float:
        found = about_the_middle(DecorrelationEstimator(curve).estimate(half).motion)
        return float(np.sqrt(((found - motion)[:, 2] ** 2).mean()))

    assert error(replace(plain, fineness_per_mm2=(PURE_FINENESS,), coherence=0.5)) < error(plain)


def test_the_same_scan_gives_the_same_motion():
    """Nothing is random, and nothing is kept from one scan to the next."""
    scan, estimator = sweep(straight(1, 6)), DecorrelationEstimator(THEORY)

    first, second = estimator.estimate(scan), estimator.estimate(scan)

    assert torch.equal(first.motion, second.motion)


def test_a_black_frame_is_bridged():
    """A frame that was lost leaves the sum of its two steps to the frames around it."""
    motion = np.tile([0.0, 0, 0.12, 0, 0, 0], (8, 1))
    scan = sweep(motion)
    frames = scan.frames[:].copy()
    frames[4] = 0
    lost = Scan("lost", frames, scan.calibration)

    found = about_the_middle(DecorrelationEstimator(THEORY).estimate(lost).motion)

    assert abs(found[:, 2].sum() / motion[:, 2].sum() - 1) < SCALE


def shadowed(scan: Scan, lit: slice = slice(0)) -> Scan:
    """Return a scan of which the lower part is black, but for some frames."""
    frames = np.array(scan.frames)
    frames[:, ROWS_LIT:] = 0
    frames[lit] = scan.frames[lit]
    return replace(scan, frames=frames)


def test_a_shadow_does_not_hold_the_probe_back():
    """Its edge stays where it is and black resembles black; neither says anything of motion."""
    motion = straight(3)

    found = DecorrelationEstimator(THEORY).estimate(shadowed(sweep(motion, 3, rows=160))).motion

    depth_mm = ROWS_LIT / 2 * SPACING_MM  # of the middle of what is lit
    elevational, pitch, yaw = found.numpy()[:, 2:5].T
    moved_mm = elevational + pitch * depth_mm - yaw * MIDDLE_MM
    assert abs(moved_mm.sum() / motion[:, 2].sum() - 1) < SCALE


def test_tissue_that_appears_for_a_moment_is_no_trouble():
    """Patches that are black in all frames that are sampled have no usual fineness."""
    scan = sweep(straight(4, 29), 4, rows=160)
    sampled = np.linspace(0, len(scan.frames) - 1, SAMPLED_FRAMES).astype(int)
    moment = slice(int(sampled[-2]) + 1, int(sampled[-1]))

    found = DecorrelationEstimator().estimate(shadowed(scan, moment))

    assert bool(found.motion.isfinite().all())


def test_frames_are_read_as_they_are_needed():
    """A sweep on disk is read frame by frame, never as a whole."""
    scan = sweep(straight(1, 6))

    class OnDisk:
        shape, dtype = scan.frames.shape, scan.frames.dtype

        def __len__(self) -> int:
            return len(scan.frames)

        def __getitem__(self, index: int | slice) -> np.ndarray:
            assert isinstance(index, int), "more than one frame at a time"
            return scan.frames[index]

    lazy = Scan("lazy", OnDisk(), scan.calibration)

    assert torch.equal(
        DecorrelationEstimator(THEORY).estimate(lazy).motion,
        DecorrelationEstimator(THEORY).estimate(scan).motion,
    )


# Backward looks like forward: the sign of the third is the caller's to know.
AXES = [(axis, sign) for axis in range(6) for sign in (-1, 1) if (axis, sign) != (2, -1)]


@pytest.mark.parametrize(("axis", "sign"), AXES)
def test_every_axis_has_the_sign_of_the_geometry(axis, sign):
    """A motion made by the pose conventions comes back with its own sign, on every axis."""
    size = [0.15, 0.12, 0.25, math.radians(0.6), math.radians(0.6), math.radians(1)][axis]
    middle = np.array([0, 0, 0.2, 0, 0, 0.0])
    middle[axis] = sign * size
    motion = turning_about_the_middle(np.tile(middle, (8, 1)))

    found = about_the_middle(
        DecorrelationEstimator(THEORY, turn_std_rad=math.radians(1))
        .estimate(sweep(motion, seed=axis))
        .motion
    ).mean(axis=0)

    tolerance = [SHIFT_MM, SHIFT_MM, 0.25 * 0.2, TURN_RAD, TURN_RAD, TURN_RAD]
    assert np.all(np.abs(found - middle) < tolerance)


def test_frames_without_speckle_are_refused():
    """Black frames tell nothing, and the message names the first step they leave open."""
    scan = Scan("dark", np.zeros((4, 64, 64), np.uint8), Calibration(spacing_mm=(0.2, 0.2)))

    with pytest.raises(ScanError, match="frames 0 and 1 of 'dark' have no speckle"):
        DecorrelationEstimator().estimate(scan)


def test_one_frame_is_refused():
    """Motion needs two frames."""
    scan = Scan("one", np.ones((1, 64, 64), np.uint8), Calibration(spacing_mm=(0.2, 0.2)))

    with pytest.raises(ScanError, match="'one' has 1"):
        DecorrelationEstimator().estimate(scan)


def test_frames_without_spacing_are_refused():
    """Pixels of unknown size give no millimeters."""
    scan = Scan("bare", np.ones((3, 64, 64), np.uint8))

    with pytest.raises(ScanError, match="'bare' has no pixel spacing"):
        DecorrelationEstimator().estimate(scan)


@pytest.mark.parametrize(("frame", "value"), [(1, np.nan), (2, np.inf), (0, -np.inf)])
def test_pixels_that_are_not_numbers_are_refused(frame, value):
    """One NaN would spread over the whole patch."""
    frames = np.random.default_rng(0).random((3, 64, 64))
    frames[frame, 5, 5] = value
    scan = Scan("holes", frames, Calibration(spacing_mm=(0.2, 0.2)))

    with pytest.raises(ScanError, match=f"frame {frame} .*holds pixels that are not numbers"):
        DecorrelationEstimator().estimate(scan)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_frames_of_one_gray_level_are_refused(dtype):
    """Flat frames match everywhere, which is no match."""
    scan = Scan("flat", np.full((4, 64, 64), 90, dtype), Calibration(spacing_mm=(0.2, 0.2)))

    with pytest.raises(ScanError, match=r"speckle in common|same gray level"):
        DecorrelationEstimator().estimate(scan)


@pytest.mark.parametrize(("scale", "offset"), [(256, 0), (-0.0, -60), (16, -2000)])
def test_gray_levels_may_be_counted_in_any_way(scale, offset):
    """Twelve bits, decibels below zero and signed levels show the same speckle as bytes."""
    scan = sweep(straight(1, 6))
    levels = scan.frames[:].astype(np.float64)
    span = levels.max() - levels.min()
    other = levels * (scale or 60 / span) + offset
    bytes_span = DecorrelationCurve(dynamic_range_db=60 * 255 / span)

    found = (
        DecorrelationEstimator(DecorrelationCurve()).estimate(replace(scan, frames=other)).motion
    )
    same = DecorrelationEstimator(bytes_span).estimate(scan).motion

    np.testing.assert_allclose(found, same, atol=ROUND_OFF)


def test_without_a_curve_the_speckle_is_the_ruler():
    """The same frames with pixels twice as large show twice the distance: nothing else is known."""
    scan = sweep(straight(1, 9))
    x_mm, y_mm = scan.calibration.spacing_mm
    twice = replace(scan, calibration=Calibration(spacing_mm=(2 * x_mm, 2 * y_mm)))

    small = DecorrelationEstimator().estimate(scan).motion[:, 2].sum()
    large = DecorrelationEstimator().estimate(twice).motion[:, 2].sum()

    # The prior on turns is in degrees and stays, so this is no exact law.
    assert float(large / small) == pytest.approx(2, rel=0.05)


def test_the_guess_is_that_of_a_linear_array():
    """Speckle as fine as an L11-5v's gives the width that its beam has."""
    lateral_mm = 0.29 / np.sqrt(2)  # 1/e of the amplitude: that of the echo squared
    depth_mm, fineness = np.array([5.0, 10.0, 10.0]), np.full(3, 2 / lateral_mm**2)

    curve = curve_from_speckle(depth_mm, fineness)

    assert curve.depth_mm == (5.0, 10.0)
    assert curve.width_mm == pytest.approx((0.42, 0.42), abs=0.005)  # two printed digits
    assert curve.source == "guess"


def test_baselines_without_neighbors_are_refused():
    """Steps between neighbors cannot come from longer pairs alone."""
    with pytest.raises(ScanError, match="baselines must be 1 and larger"):
        DecorrelationEstimator(baselines=(2, 4))


def test_what_lies_outside_the_region_does_not_count():
    """A clock that runs in the corner of the screen moves nothing."""
    motion = np.tile([0.05, 0, 0.15, 0, 0, 0.0], (6, 1))
    scan = sweep(motion)
    wide = np.random.default_rng(1).integers(0, 256, (7, 140, 200), dtype=np.uint8)
    wide[:, 6 : 6 + PIXELS, 50 : 50 + PIXELS] = scan.frames[:]
    framed = Scan("framed", wide, scan.calibration, region=Region((50, 6, PIXELS, PIXELS)))

    plain = about_the_middle(DecorrelationEstimator(THEORY).estimate(scan).motion)
    found = DecorrelationEstimator(THEORY).estimate(framed).motion.numpy()

    # The origin of turns has moved to the corner of the larger frame: compare turns.
    np.testing.assert_allclose(found[:, 3:], plain[:, 3:], atol=1e-12)


def test_a_guessed_scale_is_called_a_guess():
    """Without a calibration nobody may take the elevational millimeters for measured."""
    scan = sweep(np.tile([0, 0, 0.2, 0, 0, 0.0], (3, 1)))

    assumptions = " ".join(DecorrelationEstimator().estimate(scan).assumptions)

    assert "scale is a guess" in assumptions
    assert "never went backward" in assumptions


def test_a_sweep_that_is_too_fast_is_told():
    """Beyond the beam's width all distances look the same, and the result says so."""
    scan = sweep(np.tile([0, 0, 1.5, 0, 0, 0.0], (4, 1)))

    assumptions = DecorrelationEstimator(THEORY).estimate(scan).assumptions

    assert assumptions[-1].startswith("In 4 of 4 steps the frames were too far apart")
