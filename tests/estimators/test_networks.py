"""What holds for every motion network, each at a size for tests."""

from collections.abc import Mapping
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

from sonosweep.errors import ScanError
from sonosweep.estimators.network import FrameShape, RecurrentNetwork, Stepper, WindowNetwork
from tests.estimators.tiny_networks import SHAPE, TINY

ROUND_OFF = 1e-5  # float32 through some twenty layers, of values about 1
TENSOR_FLOAT = 1e-2  # a GPU's convolutions round to 10 bits
RECURRENT = ("cnn", "lstm", "moglo")
FRAMES = 5  # the window of the networks that have one

every_network = pytest.mark.parametrize("name", TINY)
every_recurrent_network = pytest.mark.parametrize("name", RECURRENT)


def _frames(batch: int = 2, count: int = FRAMES, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(batch, count, 1, SHAPE.rows, SHAPE.columns, generator=generator)


@every_network
def test_every_step_gets_six_numbers(name: str) -> None:
    """Five frames have four steps; every head says something of each."""
    torch.manual_seed(0)

    output = TINY[name]()(_frames())

    assert output.motion.shape == (2, FRAMES - 1, 6)
    assert all(head.shape == output.motion.shape for head in output.heads)
    assert output.embedding is None or output.embedding.shape[0] == 2
    assert all(part.shape[0] == 2 for part in output.maps.values())


@every_network
def test_windows_of_a_batch_do_not_know_each_other(name: str) -> None:
    """In evaluation, a window gives the same alone and beside any other."""
    torch.manual_seed(0)
    network = TINY[name]().eval()
    frames = _frames()

    with torch.inference_mode():
        alone = network(frames[:1]).motion
        beside = network(frames).motion[:1]

    torch.testing.assert_close(alone, beside, atol=ROUND_OFF, rtol=0)


@every_network
def test_evaluation_leaves_the_network_as_it_is(name: str) -> None:
    """No running mean moves when a trained network looks at frames."""
    network = TINY[name]().eval()
    before = {key: part.clone() for key, part in network.state_dict().items()}

    with torch.inference_mode():
        network(_frames())

    assert _same(before, network.state_dict())


@every_network
def test_every_parameter_gets_a_gradient(name: str) -> None:
    """Nothing is carried along that training cannot change."""
    torch.manual_seed(0)
    network = TINY[name]()

    output = network(_frames())
    sum(head.square().sum() for head in output.heads).backward()

    without = [key for key, part in network.named_parameters() if _is_zero(part.grad)]
    assert without == []


@every_network
def test_saved_weights_give_the_same_motion(name: str, tmp_path: Path) -> None:
    """A state saved as safetensors makes another network the same one."""
    torch.manual_seed(0)
    saved = TINY[name]()
    saved(_frames(seed=1))  # so that running means are not those of a new network
    state = {key: part.contiguous() for key, part in saved.state_dict().items()}
    save_file(state, tmp_path / "weights.safetensors")
    loaded = TINY[name]()
    loaded.load_state_dict(load_file(tmp_path / "weights.safetensors"))

    with torch.inference_mode():
        motions = [network.eval()(_frames()).motion for network in (saved, loaded)]

    assert torch.equal(*motions)


@every_network
def test_the_seed_makes_the_network(name: str) -> None:
    """The same seed gives the same weights, another seed others."""
    states = []
    for seed in (0, 0, 1):
        torch.manual_seed(seed)
        states.append(TINY[name]().state_dict())

    assert _same(states[0], states[1])
    assert not _same(states[0], states[2])


@every_network
@pytest.mark.parametrize("shape", [(2, 64, 64), (1, 64, 128)])
def test_other_frames_are_refused(name: str, shape: tuple[int, int, int]) -> None:
    """A network says what it reads when it gets something else."""
    network = TINY[name]().eval()

    with pytest.raises(ScanError, match="reads 1 channels of 64 x 64 pixels, got"):
        Stepper(network).push(torch.rand(shape))


@every_network
def test_the_battery_knows_which_networks_remember(name: str) -> None:
    """Every network is one of the two kinds, and listed as what it is."""
    network = TINY[name]()

    assert isinstance(network, RecurrentNetwork | WindowNetwork)
    assert isinstance(network, RecurrentNetwork) == (name in RECURRENT)


@every_recurrent_network
def test_later_frames_change_nothing(name: str) -> None:
    """A step's motion is known when its second frame is."""
    torch.manual_seed(0)
    network = TINY[name]().eval()
    frames = _frames(count=6)
    other = torch.cat((frames[:, :4], _frames(count=2, seed=1)), 1)

    with torch.inference_mode():
        difference = (network(frames).motion - network(other).motion).abs().amax((0, 2))

    assert difference[:3].max() < ROUND_OFF
    assert difference[3] > 10 * ROUND_OFF


@every_recurrent_network
@pytest.mark.parametrize("at_once", [1, 4])
def test_frame_by_frame_is_the_whole_scan(name: str, at_once: int) -> None:
    """Frames that come singly or in parts give the motions of the whole window."""
    torch.manual_seed(0)
    network = TINY[name]().eval()
    frames = _frames(batch=1, count=10)
    stepper = Stepper(network)

    outputs = [stepper.push_many(part) for part in frames[0].split(at_once)]

    with torch.inference_mode():
        whole = network(frames)
    pushed = [output for output in outputs if output is not None]
    motion = torch.cat([output.motion for output in pushed], 1)
    torch.testing.assert_close(motion, whole.motion, atol=ROUND_OFF, rtol=0)
    for key, maps in whole.maps.items():
        parts = torch.cat([output.maps[key] for output in pushed], 1)
        torch.testing.assert_close(parts, maps, atol=ROUND_OFF, rtol=0)


@pytest.mark.gpu
@every_network
def test_a_gpu_gives_the_same_motion(name: str) -> None:
    """What a network says does not depend on where it runs."""
    if not torch.cuda.is_available():
        pytest.skip("needs a CUDA device")
    torch.manual_seed(0)
    network = TINY[name]().eval()

    with torch.inference_mode():
        here = network(_frames()).motion
        there = network.to("cuda")(_frames().to("cuda")).motion.cpu()

    torch.testing.assert_close(there, here, atol=TENSOR_FLOAT, rtol=0)


def test_frames_need_pixels() -> None:
    """A few pixels are not a frame."""
    with pytest.raises(ScanError, match="at least 1 channel of 32 x 32 pixels"):
        FrameShape(1, 16, 64)


def _same(first: Mapping[str, Tensor], second: Mapping[str, Tensor]) -> bool:
    return all(torch.equal(first[key], second[key]) for key in first)


def _is_zero(gradient: Tensor | None) -> bool:
    return gradient is None or not bool(gradient.abs().max() > 0)
