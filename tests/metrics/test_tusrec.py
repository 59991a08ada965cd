"""The errors and displacement fields of the TUS-REC challenges."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from sonosweep.errors import ScanError
from sonosweep.geometry import pose_from_parts, rotation_from_vector
from sonosweep.metrics import (
    displacement_fields,
    landmark_displacements,
    pixel_quadrature,
    tusrec_errors,
    tusrec_score,
)

from ..strategies import sweeps

# How far the Gauss rules may be from the mean over all pixels of a 480 x 640 frame.
GAUSS_RELATIVE = 2e-6
# The challenge's arrays are float32, on displacements of some 100 mm.
SINGLE_PRECISION_MM = 2e-5
SPACING = (0.229389190673828, 0.220979690551758)


def moved(*shifts_mm):
    """Poses that only move."""
    shift = torch.tensor(shifts_mm, dtype=torch.float64)
    return pose_from_parts(torch.eye(3, dtype=torch.float64).expand(len(shift), 3, 3), shift)


@given(st.integers(1, 700), st.integers(1, 9), st.integers(0, 17))
def test_gauss_rule_is_exact_for_polynomials(pixels, order, degree):
    """The rule gives the mean over pixels of every power up to twice its order less one."""
    nodes, weights = pixel_quadrature(pixels, order)

    if degree < 2 * order or order >= pixels:
        # About the middle and over the half width, so that all values are at most 1.
        half = max((pixels - 1) / 2, 1)
        middle = (pixels - 1) / 2
        expected = np.mean(((np.arange(pixels) - middle) / half) ** degree)
        assert weights @ ((nodes - middle) / half) ** degree == pytest.approx(expected, abs=1e-12)
    assert weights.sum() == pytest.approx(1)
    assert nodes.min() >= -1e-9
    assert nodes.max() <= pixels - 1 + 1e-9


def test_gauss_rule_of_two_points_by_hand():
    """Two nodes for the pixels 0, 1, 2: one and its mirror image, sqrt(2/3) from the middle."""
    nodes, weights = pixel_quadrature(3, 2)

    assert nodes.tolist() == pytest.approx([1 - (2 / 3) ** 0.5, 1 + (2 / 3) ** 0.5])
    assert weights.tolist() == pytest.approx([0.5, 0.5])


def test_no_pixels_no_mean():
    """A mean over nothing is refused."""
    with pytest.raises(ScanError, match="0 pixels"):
        pixel_quadrature(0)


@settings(max_examples=8)
@given(sweeps(3, 2.0, 0.3), sweeps(3, 2.0, 0.3))
def test_gauss_points_agree_with_every_pixel_of_a_full_frame(estimated, true):
    """GPE and LPE equal the means over all 307,200 pixels to 2e-6."""
    found = tusrec_errors(estimated, true, 480, 640, SPACING)

    u, v = np.meshgrid(np.arange(640), np.arange(480))
    pixels = np.stack((u * SPACING[0], v * SPACING[1], 0 * u, 1 + 0 * u)).reshape(4, -1)
    sums = {"global": [], "local": []}
    for i in range(1, 3):
        for scope, before in (("global", 0), ("local", i - 1)):
            difference = np.linalg.solve(
                estimated[before].numpy(), estimated[i].numpy()
            ) - np.linalg.solve(true[before].numpy(), true[i].numpy())
            sums[scope].append(np.linalg.norm((difference @ pixels)[:3], axis=0).mean())
    assert found.global_pixel_error_mm == pytest.approx(np.mean(sums["global"]), rel=GAUSS_RELATIVE)
    assert found.local_pixel_error_mm == pytest.approx(np.mean(sums["local"]), rel=GAUSS_RELATIVE)


@given(sweeps(6), sweeps(6), st.integers(1, 7))
def test_errors_are_the_distances_of_the_exported_fields(estimated, true, chunk):
    """What is exported for the challenge's own scorer has the errors we report."""
    rows, columns, spacing = 20, 30, (0.3, 0.2)
    landmarks = torch.tensor([[1, 0, 0], [5, 29, 19], [3, 6, 10]])

    found = tusrec_errors(estimated, true, rows, columns, spacing, landmarks)

    for scope in ("global", "local"):
        a, b = (
            np.concatenate(list(displacement_fields(p, rows, columns, spacing, scope, chunk)))
            for p in (estimated, true)
        )
        assert a.shape == (5, 3, 600)
        distance = np.linalg.norm(a - b, axis=1)
        assert getattr(found, f"{scope}_pixel_error_mm") == pytest.approx(
            distance.mean(), abs=SINGLE_PRECISION_MM
        )
        at_landmarks = [
            distance[f - 1, row * columns + column] for f, column, row in landmarks.tolist()
        ]
        assert getattr(found, f"{scope}_landmark_error_mm") == pytest.approx(
            np.mean(at_landmarks), abs=SINGLE_PRECISION_MM
        )
        points = landmark_displacements(estimated, landmarks, rows, columns, spacing, scope)
        expected = np.stack([a[f - 1, :, row * columns + col] for f, col, row in landmarks], -1)
        np.testing.assert_allclose(points, expected, atol=SINGLE_PRECISION_MM)


def test_error_that_vanishes_inside_the_frame():
    """A turn about the middle of the frame leaves a kink there, and the mean is still right."""
    middle = torch.tensor([[0.0, 0, 0], [70, 50, 0]], dtype=torch.float64)
    turned = pose_from_parts(
        rotation_from_vector(torch.tensor([[0.0, 0, 0], [0, 0, 0.01]], dtype=torch.float64)),
        middle,
    )
    away = pose_from_parts(torch.eye(3, dtype=torch.float64), -middle[1])
    estimated = torch.stack((turned[0], turned[1] @ away))

    found = tusrec_errors(estimated, turned[[0, 0]], 480, 640, SPACING)

    u, v = np.meshgrid(np.arange(640) * SPACING[0] - 70, np.arange(480) * SPACING[1] - 50)
    expected = np.mean(2 * np.sin(0.005) * np.hypot(u, v))
    assert found.global_pixel_error_mm == pytest.approx(expected, rel=GAUSS_RELATIVE)


def test_worked_example():
    """A probe that moves 1 mm and then 2 mm, estimated at rest: local 1.5, global 2 mm."""
    found = tusrec_errors(
        moved([0, 0, 0], [0, 0, 0], [0, 0, 0]),
        moved([5, 0, 0], [5, 0, 1], [5, 0, 3]),
        480,
        640,
        SPACING,
        torch.tensor([[2, 639, 479]]),
    )

    assert found.local_pixel_error_mm == pytest.approx(1.5)
    assert found.global_pixel_error_mm == pytest.approx(2)
    assert found.local_landmark_error_mm == pytest.approx(2)
    assert found.global_landmark_error_mm == pytest.approx(3)


def test_fields_of_a_shift_are_the_shift():
    """Every pixel of a frame that only moves is displaced by that movement."""
    (field,) = displacement_fields(moved([0, 0, 0], [1, 2, 3]), 2, 2, (0.1, 0.1), "global")

    assert field.dtype == np.float32
    assert field[0].T.tolist() == [[1, 2, 3]] * 4


def test_score_is_one_for_the_truth_and_zero_at_rest():
    """The 2025 score measures against an estimate that never moves."""
    true = moved([0, 0, 0], [0, 0, 1], [0, 0, 3])
    landmarks = torch.tensor([[1, 3, 4]])
    exact = tusrec_errors(true, true, 20, 30, (1.0, 1.0), landmarks)
    rest = tusrec_errors(true[[0, 0, 0]], true, 20, 30, (1.0, 1.0), landmarks)

    assert tusrec_score(exact, rest) == 1
    assert tusrec_score(rest, rest) == 0
    with pytest.raises(ScanError, match="does not move"):
        tusrec_score(exact, exact)
    with pytest.raises(ScanError, match="landmarks"):
        tusrec_score(tusrec_errors(true, true, 20, 30, (1.0, 1.0)), rest)


@pytest.mark.parametrize("landmark", [[0, 5, 5], [3, 5, 5], [1, -1, 5], [1, 30, 5], [1, 5, 20]])
def test_landmarks_outside_the_scan(landmark):
    """Frame 0 does not move, and pixels are counted from 0: anything else is refused."""
    true = moved([0, 0, 0], [0, 0, 1], [0, 0, 3])

    with pytest.raises(ScanError, match=r"landmark 0 .* frame from 1 to 2, a column from 0 to 29"):
        tusrec_errors(true, true, 20, 30, (1.0, 1.0), torch.tensor([landmark]))


def test_counts():
    """Errors need as many estimated as true poses, and two of them."""
    true = moved([0, 0, 0], [0, 0, 1])

    with pytest.raises(ScanError, match="1 estimated poses but 2"):
        tusrec_errors(true[:1], true, 20, 30, (1.0, 1.0))
    with pytest.raises(ScanError, match="two frames or more, got 1"):
        tusrec_errors(true[:1], true[:1], 20, 30, (1.0, 1.0))
