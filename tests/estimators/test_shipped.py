"""The weights that come with the package: all there, described, and of use."""

from dataclasses import replace

import pytest
import torch

from sonosweep.estimators import LearnedEstimator
from sonosweep.estimators.network_input import center_mm, image_steps
from sonosweep.estimators.network_names import NETWORKS
from sonosweep.estimators.shipped import shipped_weights
from sonosweep.estimators.weights import read_weights_info
from sonosweep.geometry import motion_from_step, step_from_motion, steps_from_poses
from sonosweep.simulate import MotionSettings, draw_sweep, simulate_sweep
from sonosweep.training.validate import correlation

FRAMES = 80
LARGEST_SHARE = 0.8  # of the error of mean motion; over whole test sweeps all are below 0.6
LEAST_CORRELATION = 0.8  # elevationally; over whole test sweeps all are above 0.9
MOTION = MotionSettings("straight", length_mm=0.25 * FRAMES, frames=FRAMES, pauses=1)


@pytest.fixture(scope="module")
def sweep():
    """Return a sweep of a subject that nothing was trained on, in memory."""
    scan = simulate_sweep(draw_sweep(900_050, 0, MOTION, scanner="research"))
    return replace(scan, frames=scan.frames[:])


def test_every_network_is_shipped_with_a_card():
    """The card tells what the file says of itself."""
    assert set(shipped_weights()) == set(NETWORKS)
    for name, path in shipped_weights().items():
        info, card = read_weights_info(path), path.with_suffix(".md").read_text()
        assert info.network == name
        assert info.recipe.strip() in card
        assert info.data in card
        assert "test_rae" in info.metrics
        assert path.stat().st_size < 10e6


@pytest.mark.parametrize("name", NETWORKS)
def test_shipped_networks_read_an_unseen_sweep(sweep, name):
    """Each step is nearer to the truth than the mean motion of the training sweeps is."""
    estimator = LearnedEstimator(name, device="cpu")
    x, y = center_mm(sweep)
    true = motion_from_step(image_steps(steps_from_poses(sweep.image_to_reference), (-x, -y)))

    found = estimator.estimate(replace(sweep, image_to_reference=None, tracked=None)).motion

    motion = motion_from_step(image_steps(step_from_motion(found), (-x, -y)))
    error = (motion - true)[:, :3].abs().mean()
    mean = torch.tensor(estimator.info.mean_motion, dtype=torch.float64)
    assert error < LARGEST_SHARE * (mean - true)[:, :3].abs().mean()
    assert correlation(motion[:, 2], true[:, 2]) > LEAST_CORRELATION
