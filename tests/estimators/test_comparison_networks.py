"""The five networks that the paper compares with, against what is published of them."""

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from sonosweep.errors import ScanError
from sonosweep.estimators.cnn import CNN, CNNOptions
from sonosweep.estimators.dc2 import DC2
from sonosweep.estimators.dcl import DCL, DCLOptions
from sonosweep.estimators.efficient import Efficient, EfficientOptions
from sonosweep.estimators.lstm import LSTM, LSTMOptions
from sonosweep.estimators.network import FrameShape, Stepper, WindowNetwork
from sonosweep.estimators.network_names import build_network
from sonosweep.estimators.resnext import ResNeXt3d, ResNeXtSize
from sonosweep.estimators.shrink import shrink_frames
from tests.estimators.tiny_networks import SHAPE, TINY, TINY_RESNEXT

ROUND_OFF = 2e-5  # float32 through some ten layers, of values about 1
BFLOAT16 = 0.03  # of the norm of a gradient, through some ten layers of 8 bits each
COMPARED = ("cnn", "dcl", "dc2", "efficient", "lstm")
WINDOWS = ("dcl", "dc2", "efficient")


def _parameters(module: nn.Module) -> int:
    return sum(values.numel() for values in module.parameters())


def _frames(count: int, side: int = 64, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(2, count, 1, side, side, generator=generator)


def test_cnn_has_as_many_parameters_as_its_public_version() -> None:
    """Guo et al.'s version of Prevost's network has 182,790 without optical flow, at 224 px."""
    assert _parameters(CNN(FrameShape(1, 224, 224))) == 182_790


def test_dcl_has_as_many_parameters_as_its_public_version() -> None:
    """DCL-Net's ResNeXt-50, attention and last layer have 27.9 million."""
    with torch.device("meta"):
        network = DCL(options=DCLOptions(mean_of_window=True))

    assert round(_parameters(network) / 1e6, 1) == 27.9


@pytest.mark.parametrize(
    ("width", "depth", "last", "published"),
    [
        (1.0, 1.0, 1280, 5_288_548),
        (1.0, 1.1, 1280, 7_794_184),
        (1.1, 1.2, 1408, 9_109_994),
        (1.2, 1.4, 1536, 12_233_232),
        (1.4, 1.8, 1792, 19_341_616),
    ],
)
def test_efficient_has_as_many_parameters_as_published(
    width: float, depth: float, last: int, published: int
) -> None:
    """Reading three channels, EfficientNet-b0 to b4 have what torchvision's have, less classes."""
    with torch.device("meta"):
        network = Efficient(options=EfficientOptions(window=3, width=width, depth=depth))

    assert _parameters(network.features) == published - 1000 * (last + 1)


@pytest.mark.parametrize(
    ("blocks", "published"), [((2, 2, 2, 2), 11_689_512), ((3, 4, 6, 3), 21_797_672)]
)
def test_lstm_reads_pairs_by_a_resnet_as_published(
    blocks: tuple[int, int, int, int], published: int
) -> None:
    """ResNet-18 and -34 have what torchvision's have, less classes, plus three channels."""
    with torch.device("meta"):
        network = LSTM(FrameShape(3), LSTMOptions(blocks=blocks))

    assert _parameters(network.residual) == published - 1000 * 513 + 3 * 64 * 49
    assert round(_parameters(network.gates) / 1e6, 1) == 18.9


def test_cnn_refuses_frames_that_its_poolings_would_leave_nothing_of() -> None:
    """Six halvings need 64 pixels, after shrinking."""
    with pytest.raises(ScanError, match="128 x 128"):
        CNN(FrameShape(1, 64, 64), CNNOptions(shrink=2))


@pytest.mark.parametrize("name", WINDOWS)
def test_window_networks_refuse_other_windows(name: str) -> None:
    """Four frames are no window of five."""
    with pytest.raises(ScanError, match="reads 5 frames at once, got 4"):
        TINY[name]()(_frames(4))


@pytest.mark.parametrize("name", WINDOWS)
def test_stepper_gives_the_last_step_of_every_window(name: str) -> None:
    """Frame by frame, a window network says what it says of the five latest frames."""
    network = TINY[name]().eval()
    assert isinstance(network, WindowNetwork)
    frames = _frames(7)[:1]
    stepper = Stepper(network)

    pushed = [stepper.push(frame) for frame in frames[0]]

    assert pushed[0] is None
    for last in (4, 5, 6):
        output = pushed[last]
        assert output is not None
        with torch.inference_mode():
            whole = network(frames[:, last - 4 : last + 1]).motion[:, -1:]
        torch.testing.assert_close(output.motion, whole, atol=ROUND_OFF, rtol=0)


def test_cnn_knows_nothing_of_earlier_frames() -> None:
    """A pair is all that the plain CNN looks at."""
    network = TINY["cnn"]().eval()
    frames = _frames(4)
    other = torch.cat((_frames(2, seed=1), frames[:, 2:]), 1)

    difference = network(frames).motion - network(other).motion

    assert difference[:, -1].abs().max() < ROUND_OFF < difference[:, 0].abs().max()


def test_lstm_remembers_earlier_frames() -> None:
    """The same pair moves differently after other frames."""
    network = TINY["lstm"]().eval()
    frames = _frames(4)
    other = torch.cat((_frames(2, seed=1), frames[:, 2:]), 1)

    difference = network(frames).motion - network(other).motion

    assert difference[:, -1].abs().max() > 10 * ROUND_OFF


def test_lstm_does_not_mind_gain() -> None:
    """Standardized frames are the same whatever gain and offset the display had."""
    network = TINY["lstm"]().eval()
    frames = _frames(3)

    difference = network(frames).motion - network(0.5 * frames + 0.3).motion

    assert difference.abs().max() < ROUND_OFF


def test_lstm_is_torchs_where_there_is_but_one_place() -> None:
    """Over a map of one pixel, a convolutional LSTM is an ordinary one."""
    network = LSTM(FrameShape(1, 32, 32), LSTMOptions(width=2, hidden=5))
    oracle = nn.LSTM(16, 5, batch_first=True)
    assert network.gates.bias is not None
    weight = network.gates.weight.detach()[:, :, 1, 1].unflatten(0, (4, 5))[[0, 1, 3, 2]]
    bias = network.gates.bias.detach().unflatten(0, (4, 5))[[0, 1, 3, 2]].flatten()
    oracle.load_state_dict(
        {
            "weight_ih_l0": weight.flatten(0, 1)[:, :16],
            "weight_hh_l0": weight.flatten(0, 1)[:, 16:],
            "bias_ih_l0": bias,
            "bias_hh_l0": torch.zeros_like(bias),
        }
    )
    features = torch.randn(2, 6, 16, generator=torch.Generator().manual_seed(0))

    with torch.inference_mode():
        output, state = network.regress((features[..., None, None],), None)
        hidden, (_, cell) = oracle(features)
        expected = network.to_motion.linear(hidden)

    torch.testing.assert_close(output.motion, expected, atol=ROUND_OFF, rtol=0)
    torch.testing.assert_close(state[1][..., 0, 0], cell[0], atol=ROUND_OFF, rtol=0)


def test_resnext_begins_with_a_3d_convolution() -> None:
    """Frames with their neighbors as channels, filtered in 2D, are filtered in 3D."""
    network = ResNeXt3d(2, ResNeXtSize(width=4, blocks=(1, 1, 1, 1), cardinality=2)).eval()
    frames = torch.rand(1, 5, 2, 32, 32, generator=torch.Generator().manual_seed(0))
    seen: list[Tensor] = []
    first = network.stem[0]
    assert isinstance(first, nn.Conv2d)
    first.register_forward_hook(lambda module, given, result: seen.append(result))
    weight = first.weight.detach().unflatten(1, (3, 2)).transpose(1, 2)

    network(frames)

    expected = F.conv3d(frames.transpose(1, 2), weight, None, (1, 2, 2), (1, 3, 3))
    torch.testing.assert_close(seen[0], expected[0].transpose(0, 1), atol=ROUND_OFF, rtol=0)


def test_dcl_may_predict_the_mean_of_its_window() -> None:
    """As in the paper, one motion then stands for all four steps."""
    network = DCL(SHAPE, DCLOptions(size=TINY_RESNEXT, mean_of_window=True)).eval()

    motion = network(_frames(5)).motion

    assert motion.shape == (2, 4, 6)
    assert torch.equal(motion, motion[:, :1].expand(-1, 4, -1))


def test_dc2_contrasts_what_its_last_layer_reads() -> None:
    """Windows with the same embedding have the same motion."""
    network = TINY["dc2"]().eval()
    assert isinstance(network, DC2)

    output = network(_frames(5))

    assert output.embedding is not None
    assert output.embedding.shape == (2, 32 * TINY_RESNEXT.width)
    told = network.to_motion.linear(output.embedding).unflatten(1, (4, 6))
    torch.testing.assert_close(told, output.motion, atol=ROUND_OFF, rtol=0)


@pytest.mark.parametrize("name", ["dcl", "dc2"])
def test_attention_says_how_much_each_place_counts(name: str) -> None:
    """One weight from 0 to 1 for each 32 x 32 pixels."""
    attention = TINY[name]().eval()(_frames(5, 128)).maps["attention"]

    assert attention.shape == (2, 4, 4)
    assert 0 <= attention.min() <= attention.max() <= 1


@pytest.mark.parametrize("name", COMPARED)
def test_bfloat16_gives_nearly_the_same_gradient(name: str) -> None:
    """Training in bfloat16 goes the way training in float32 does, and breaks nothing."""
    torch.manual_seed(0)
    network = TINY[name]().eval()
    gradients = []
    for low in (False, True):
        with torch.autocast("cpu", torch.bfloat16, enabled=low):
            motion = network(_frames(5)).motion
        gradient = torch.autograd.grad(motion.float().square().sum(), list(network.parameters()))
        gradients.append(torch.cat([part.flatten() for part in gradient]))

    assert (gradients[0] - gradients[1]).norm() < BFLOAT16 * gradients[0].norm()


def test_shrinking_is_the_mean_of_squares_of_pixels() -> None:
    """Four pixels become their mean, whatever axes stand before them."""
    frames = torch.tensor([[0.0, 1.0], [0.5, 0.5]]).expand(3, 5, 1, 2, 2)

    assert torch.equal(shrink_frames(frames, 2), torch.full((3, 5, 1, 1, 1), 0.5))


@pytest.mark.parametrize("name", COMPARED)
def test_networks_can_read_shrunk_frames(name: str) -> None:
    """A network that shrinks is one without that is given shrunk frames."""
    small = build_network(name, {"shrink": 1}, FrameShape(1, 64, 64)).eval()
    large = build_network(name, {"shrink": 2}, FrameShape(1, 128, 128)).eval()
    large.load_state_dict(small.state_dict())
    frames = _frames(5, 128)

    with torch.inference_mode():
        same = small(shrink_frames(frames, 2)).motion
        torch.testing.assert_close(large(frames).motion, same, atol=ROUND_OFF, rtol=0)
