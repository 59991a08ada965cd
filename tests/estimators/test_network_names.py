"""Names that recipes use for networks."""

import pytest
import torch

from sonosweep.errors import RecipeError
from sonosweep.estimators.cnn import CNN
from sonosweep.estimators.network import FrameShape
from sonosweep.estimators.network_names import NETWORKS, build_network

LARGEST_COMPACT = 4_800_000  # weights of 2 bytes that make a file below 10 MB


@pytest.mark.parametrize("name", NETWORKS)
def test_compact_preset_fits_a_file_of_ten_megabytes(name: str) -> None:
    """The weights of a compact network, its running means included, are below 10 MB."""
    network = build_network(name, shape=FrameShape())

    assert sum(values.numel() for values in network.state_dict().values()) <= LARGEST_COMPACT


@pytest.mark.parametrize("name", NETWORKS)
def test_every_network_has_both_presets(name: str) -> None:
    """Each network comes at the size of its paper and at one for a CPU."""
    assert {"paper", "compact"} <= set(NETWORKS[name].presets)


@pytest.mark.parametrize("name", NETWORKS)
def test_every_network_can_say_how_sure_it_is(name: str) -> None:
    """Asked to, each network gives a log variance for each number of each step."""
    network = build_network(name, {"log_variance": True}, FrameShape(1, 64, 64)).eval()

    output = network(torch.rand(1, 5, 1, 64, 64))

    assert output.log_variance is not None
    assert output.log_variance.shape == output.motion.shape == (1, 4, 6)


@pytest.mark.parametrize("name", NETWORKS)
def test_same_seed_gives_same_weights(name: str) -> None:
    """Weights come from torch's generator and from nowhere else."""
    made = []
    for _ in range(2):
        torch.manual_seed(3)
        made.append(build_network(name, shape=FrameShape(1, 64, 64)).state_dict())

    assert all(torch.equal(made[0][key], made[1][key]) for key in made[0])


def test_options_change_only_what_they_name() -> None:
    """What a recipe leaves out stays as the preset has it."""
    network = build_network("cnn", {"width": 8}, FrameShape(1, 64, 64))

    assert isinstance(network, CNN)
    assert (network.options.width, network.options.normalize) == (8, True)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"name": "rnn"}, "no network is called 'rnn'; networks are cnn"),
        ({"name": "cnn", "preset": "huge"}, "no preset 'huge'; presets are paper, compact"),
        ({"name": "cnn", "options": {"wdth": 8}}, "has no option 'wdth'; options are width, "),
        ({"name": "cnn", "options": {"width": "big"}}, "option width .* cannot be 'big'"),
        ({"name": "cnn", "options": {"width": 0}}, "option width .* cannot be 0"),
    ],
)
def test_unknown_names_are_refused_with_the_known_ones(arguments: dict, message: str) -> None:
    """A misspelled recipe is told what it could have said."""
    with pytest.raises(RecipeError, match=message):
        build_network(**arguments)
