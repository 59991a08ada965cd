"""What a network looked at, beside what the frames themselves say."""

import numpy as np
import torch

from sonosweep.estimators.correlation import CorrelationGeometry
from sonosweep.estimators.fit_scan import fit_scan
from sonosweep.estimators.learned import LearnedEstimator
from sonosweep.estimators.step_maps import frame_correlation, step_maps
from tests.estimators.test_learned import scan_of, speckle
from tests.estimators.tiny_weights import tiny_weights


def test_frames_that_shifted_correlate_best_at_the_shift():
    """Four pixels of the frame are one of the map."""
    frame = torch.rand(64, 64, generator=torch.Generator().manual_seed(0))
    coarse = (
        frame.reshape(16, 4, 16, 4).mean((1, 3)).repeat_interleave(4, 0).repeat_interleave(4, 1)
    )
    shifted = coarse.roll((4, -8), (0, 1))

    found = frame_correlation(coarse, shifted, CorrelationGeometry(radius=2), zero_mean=True)

    assert found.shape == (5, 5)
    assert divmod(int(found.argmax()), 5) == (3, 0)
    assert float(found[3, 0]) > 0.7  # what left the frame correlates with nothing


def test_without_zero_mean_everything_is_alike():
    """The cosine of positive numbers is near 1 whatever they show: why the mean is taken off."""
    first, second = torch.rand(2, 64, 64, generator=torch.Generator().manual_seed(1))

    plain = frame_correlation(first, second, CorrelationGeometry(radius=1), zero_mean=False)
    centered = frame_correlation(first, second, CorrelationGeometry(radius=1), zero_mean=True)

    assert float(plain[1, 1]) > 0.9
    assert float(centered.abs().max()) < 0.3


def test_a_step_comes_with_its_frame_and_maps(tmp_path):
    """The frame is the one that the step leads to."""
    seen = {}
    scan = scan_of(speckle(5))
    estimator = LearnedEstimator(
        tiny_weights(tmp_path, "moglo"), "fp32", "cpu", lambda first, maps: seen.update(maps)
    )
    estimator.estimate(scan)
    maps = {name: values[2] for name, values in seen.items()}

    shown = step_maps(fit_scan(scan, estimator.info), estimator.network, maps, 2, "the third")

    assert np.array_equal(shown.frame, scan.frames[3])
    assert shown.mm_per_pixel == (0.3, 0.3)
    assert shown.attention is not None
    assert shown.attention.shape == (4, 4)
    assert shown.features is not None
    assert shown.frames is not None
    assert shown.features.shape == shown.frames.shape
