"""What a network looked at, beside what the frames themselves say."""

import numpy as np
import pytest
import torch

from sonosweep.estimators.correlation import CorrelationGeometry
from sonosweep.estimators.fit_scan import fit_scan
from sonosweep.estimators.learned import LearnedEstimator
from sonosweep.estimators.moglo import MoGLo, MoGLoOptions
from sonosweep.estimators.network import FrameShape
from sonosweep.estimators.step_maps import frame_correlation, step_maps
from tests.estimators.test_learned import scan_of, speckle
from tests.estimators.tiny_weights import tiny_weights


@pytest.mark.parametrize("cell", [4, 8])
def test_frames_that_shifted_correlate_best_at_the_shift(cell):
    """A cell of so many pixels of the frame is one of the map."""
    cells = torch.rand(16, 16, generator=torch.Generator().manual_seed(0))
    coarse = cells.repeat_interleave(cell, 0).repeat_interleave(cell, 1)
    shifted = coarse.roll((cell, -2 * cell), (0, 1))

    found = frame_correlation(coarse, shifted, CorrelationGeometry(radius=2), cell, zero_mean=True)

    assert found.shape == (5, 5)
    assert divmod(int(found.argmax()), 5) == (3, 0)
    assert float(found[3, 0]) > 0.7  # what left the frame correlates with nothing


def test_without_zero_mean_everything_is_alike():
    """The cosine of positive numbers is near 1 whatever they show: why the mean is taken off."""
    first, second = torch.rand(2, 64, 64, generator=torch.Generator().manual_seed(1))

    plain = frame_correlation(first, second, CorrelationGeometry(radius=1), 4, zero_mean=False)
    centered = frame_correlation(first, second, CorrelationGeometry(radius=1), 4, zero_mean=True)

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


@pytest.mark.parametrize("stride", [2, 4, 8])
def test_frames_are_as_coarse_as_the_features_beside_which_they_stand(stride):
    """Also where the first convolution makes them eight times smaller."""
    options = MoGLoOptions(width=4, blocks=(1, 1, 2, 1), stem_stride=stride)
    network = MoGLo(FrameShape(1, 128, 128), options)

    features = network.encode(torch.rand(1, 1, 128, 128))[0]

    assert 128 // features.shape[-1] == options.e1_reduction
