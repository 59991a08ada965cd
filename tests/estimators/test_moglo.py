"""MoGLo-Net: sizes of the paper and the released code, and what its options change."""

from dataclasses import replace
from typing import Literal

import pytest
import torch
from torch import Tensor, nn

from sonosweep.errors import RecipeError, ScanError
from sonosweep.estimators.correlation import CorrelationGeometry
from sonosweep.estimators.moglo import (
    COMPACT,
    PAPER,
    RELEASED_CODE,
    MoGLo,
    MoGLoOptions,
)
from sonosweep.estimators.network import FrameShape, NetworkOutput
from sonosweep.estimators.network_names import build_network

ROUND_OFF = 1e-5  # float32 through some twenty layers, of values about 1
BFLOAT16 = 0.05  # of the norm of a gradient, through some twenty layers of 8 bits each
TINY = MoGLoOptions(width=8, blocks=(1, 1, 2, 1), hidden=8, geometry=CorrelationGeometry(radius=2))


def _frames(shape: FrameShape | None = None, count: int = 3, seed: int = 0) -> Tensor:
    shape = shape or FrameShape(1, 64, 64)
    generator = torch.Generator().manual_seed(seed)
    sizes = (2, count, shape.channels, shape.rows, shape.columns)
    return torch.rand(sizes, generator=generator)


def _network(options: MoGLoOptions = TINY, shape: FrameShape | None = None) -> MoGLo:
    torch.manual_seed(0)
    return MoGLo(shape or FrameShape(1, 64, 64), options)


def _output(network: nn.Module, frames: Tensor) -> NetworkOutput:
    output = network(frames)
    assert isinstance(output, NetworkOutput)
    return output


def _shapes_of(network: MoGLo) -> dict[str, tuple[int, ...]]:
    """Return the shapes of E1 to E4, C as it joins E3, and L and G of one pair of frames."""
    shapes: dict[str, tuple[int, ...]] = {}

    def note(name: str, part: nn.Module) -> None:
        part.register_forward_hook(
            lambda module, given, result: shapes.update({name: tuple(result.shape[1:])})
        )

    for k in (1, 2, 3, 4):
        note(f"E{k}", getattr(network, f"encoder_{k}"))
    note("C", network.volume_norm)
    with torch.device("meta"):
        features = network.encode(torch.empty(1, 1, 256, 256))
        local, whole, _, weights = network.compare(features, features)
    return {
        **shapes,
        "L": tuple(local.shape[1:]),
        "G": tuple(whole.shape[1:]),
        "weights": tuple(weights.shape[1:]),
    }


@pytest.mark.parametrize(
    ("options", "volume"), [(PAPER, (225, 16, 16)), (RELEASED_CODE, (256, 16, 16))]
)
def test_sizes_are_the_papers(options: MoGLoOptions, volume: tuple[int, int, int]) -> None:
    """E2 is 128 x 64 x 64, E4, G and L are 512 x 4 x 4, from 256 blocks and 256 regions."""
    with torch.device("meta"):
        network = MoGLo(options=options)

    assert _shapes_of(network) == {
        "E1": (64, 64, 64),
        "E2": (128, 64, 64),
        "E3": (256, 16, 16),
        "C": volume,
        "E4": (512, 4, 4),
        "L": (512, 4, 4),
        "G": (512, 4, 4),
        "weights": (16, 16),
    }


def test_released_code_has_as_many_parameters() -> None:
    """27,905,952 of the code, less the shortcuts of blocks that keep their width, unused there."""
    with torch.device("meta"):
        network = MoGLo(options=RELEASED_CODE)
    unused = 3 * 64**2 + 4 * 128**2 + 5 * 256**2 + 3 * 512**2

    parameters = sum(part.numel() for part in network.parameters())

    assert abs(parameters - (27_905_952 - unused)) < 0.0005 * parameters


@pytest.mark.parametrize(
    ("options", "shape"),
    [(COMPACT, FrameShape()), (replace(COMPACT, stem_stride=4), FrameShape(1, 128, 128))],
)
def test_compact_networks_see_8_by_8_regions(options: MoGLoOptions, shape: FrameShape) -> None:
    """Both weigh 64 blocks of a frame."""
    network = _network(options, shape).eval()

    with torch.inference_mode():
        assert _output(network, _frames(shape, 2)).maps["attention"].shape == (2, 1, 8, 8)


@pytest.mark.parametrize(
    "shape", [FrameShape(3, 64, 128), FrameShape(1, 192, 64), FrameShape(2, 320, 320)]
)
def test_other_frames_can_be_read(shape: FrameShape) -> None:
    """Sides are any multiples of 64 pixels; channels are what there is."""
    network = _network(TINY, shape).eval()

    with torch.inference_mode():
        output = _output(network, _frames(shape, 2))

    assert output.motion.shape == (2, 1, 6)
    assert output.maps["attention"].shape == (2, 1, shape.rows // 16, shape.columns // 16)


@pytest.mark.parametrize("combination", ["mean", "learned"])
def test_motion_combines_what_local_and_global_features_say(
    combination: Literal["mean", "learned"],
) -> None:
    """Two heads are trained and combined, at first as a mean; L and G are contrasted."""
    output = _output(_network(replace(TINY, combination=combination)).eval(), _frames())

    assert len(output.heads) == (2 if combination == "mean" else 3)
    mean = (output.heads[0] + output.heads[1]) / 2
    torch.testing.assert_close(output.motion, mean, atol=ROUND_OFF, rtol=0)
    assert output.embedding is not None
    assert output.embedding.shape == (2, 2 * 64 * 4 * 4)


def test_without_attention_one_head_reads_e4() -> None:
    """The ablation of G leaves no local features and no attention to look at."""
    output = _output(_network(replace(TINY, attention=False)).eval(), _frames())

    assert len(output.heads) == 1
    assert torch.equal(output.motion, output.heads[0])
    assert set(output.maps) == {"correlation"}


def test_without_correlation_nothing_is_correlated() -> None:
    """The ablation of C leaves E3 alone, and only E1 to carry from frame to frame."""
    network = _network(replace(TINY, correlation=False)).eval()

    assert len(network.encode(_frames()[:, 0])) == 1
    assert set(_output(network, _frames()).maps) == {"attention"}


def test_the_map_of_correlation_peaks_in_the_middle_without_motion() -> None:
    """A frame beside itself correlates fully where it is."""
    frames = _frames(count=1).expand(-1, 2, -1, -1, -1)

    correlation = _output(_network().eval(), frames).maps["correlation"]

    assert correlation.shape == (2, 1, 5, 5)
    middle = correlation[..., 2, 2]
    torch.testing.assert_close(middle, torch.ones_like(middle), atol=1e-3, rtol=0)
    assert torch.equal(correlation.amax((-1, -2)), middle)


@pytest.mark.parametrize("differentiable", [True, False])
def test_gradients_flow_through_the_correlation_unless_stopped(differentiable: bool) -> None:
    """As in the released code, C can be kept from teaching encoder block 1."""
    options = replace(TINY, differentiable=differentiable, image_correlation=False)
    network = _network(options)
    features = network.encode(_frames()[:, 0])
    correlated = features[1].detach().requires_grad_()

    parts = network.compare(
        (features[0].detach(), correlated), (features[0].detach(), features[1].detach())
    )
    parts[0].square().sum().backward()

    assert (correlated.grad is not None) == differentiable


def test_layouts_put_the_same_numbers_in_other_places() -> None:
    """Regions as channels need as many of them as there are; displacements do not."""
    counts = {
        layout: _network(replace(TINY, layout=layout)).volume_norm.num_features
        for layout in ("displacements", "regions")
    }

    assert counts == {"displacements": 5 * 5 + 7 * 11, "regions": 4 * 4 + 7 * 11}


def test_memory_goes_from_step_to_step() -> None:
    """The same pair moves differently after other frames."""
    network = _network().eval()
    frames = _frames(count=4)
    other = torch.cat((_frames(count=2, seed=1), frames[:, 2:]), 1)

    difference = _output(network, frames).motion - _output(network, other).motion

    assert difference[:, -1].abs().max() > 10 * ROUND_OFF


def _motion_from(network: MoGLo, features: Tensor) -> Tensor:
    """Return the motion that follows from L and G; maps to look at do not matter."""
    maps = torch.zeros(1, 2, 5, 5)
    return network.regress((features, features, maps, maps), None)[0].motion


def test_projection_sees_where_features_are() -> None:
    """The mean over places does not change when L and G are turned, the projection does."""
    for units, changes in ((0, False), (8, True)):
        network = _network(replace(TINY, projection=units)).eval()
        features = torch.rand(1, 2, 64, 4, 4, generator=torch.Generator().manual_seed(0))
        with torch.inference_mode():
            one = _motion_from(network, features)
            turned = _motion_from(network, features.flip(-1))

        assert bool((one - turned).abs().max() > ROUND_OFF) == changes


def test_bfloat16_gives_nearly_the_same_gradient() -> None:
    """Training in bfloat16 goes the way training in float32 does."""
    network = _network().eval()
    gradients = []
    for low in (False, True):
        with torch.autocast("cpu", torch.bfloat16, enabled=low):
            motion = _output(network, _frames()).motion
        gradient = torch.autograd.grad(motion.square().sum(), list(network.parameters()))
        gradients.append(torch.cat([part.flatten() for part in gradient]))

    assert (gradients[0] - gradients[1]).norm() < BFLOAT16 * gradients[0].norm()


def test_weights_keep_channels_last() -> None:
    """Convolutions are fast from the start, whoever makes the network."""
    weights = [part for part in _network().parameters() if part.ndim == 4]

    assert len(weights) > 10
    assert all(part.is_contiguous(memory_format=torch.channels_last) for part in weights)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"geometry": {"stride": 2}}, "their stride is 4, not 2"),
        ({"blocks": (1, 1, 1, 1)}, "it needs 2 blocks"),
        ({"geometry": {"patch": 4}}, "odd side, got 4"),
        ({"reading": {"spatial_kernel": 5}}, "cannot be 5"),
        ({"correlaton": True}, "no option 'correlaton'"),
    ],
)
def test_impossible_options_are_refused(options: dict[str, object], message: str) -> None:
    """A recipe hears what is wrong in one sentence."""
    with pytest.raises(RecipeError, match=message):
        build_network("moglo", options, FrameShape(1, 64, 64))


def test_frames_that_cannot_be_halved_are_refused() -> None:
    """Blocks and regions tile the frame only in multiples of 64 pixels."""
    with pytest.raises(ScanError, match="multiples of 64 pixels, got 100 x 128"):
        MoGLo(FrameShape(1, 100, 128))


def test_angles_of_the_correlation_tell_small_steps_apart() -> None:
    """The angle is arccos of the correlation: 0 between equal frames, and finite in training."""
    frames = _frames(FrameShape(1, 64, 64), 2)
    same = frames[:, :1].expand_as(frames).contiguous()
    volumes = {}
    for measure in ("correlation", "angle"):
        network = _network(replace(TINY, measure=measure), FrameShape(1, 64, 64))
        encoded = [network.encode(part)[1:] for part in same.unbind(1)[:2]]
        volumes[measure] = network._volumes(encoded[0], encoded[1])[0]

    cosine = volumes["angle"].cos()
    torch.testing.assert_close(cosine, volumes["correlation"], atol=2e-4, rtol=0)  # its clamp
    assert float(volumes["angle"].detach().min()) < 0.015
    volumes["angle"].sum().backward()
    gradients = [p.grad for p in network.encoder_1.parameters() if p.grad is not None]
    assert gradients
    assert all(bool(gradient.isfinite().all()) for gradient in gradients)


def test_what_knows_more_can_count_more() -> None:
    """Learned weights differ between the six numbers, and sum to 1."""
    network = _network().eval()
    assert network.shares is not None
    with torch.no_grad():
        network.shares[1, 2] = 50.0

    output = _output(network, _frames())

    mean = (output.heads[0] + output.heads[1]) / 2
    expected = mean.clone()
    expected[..., 2] = output.heads[1][..., 2]
    torch.testing.assert_close(output.motion, expected, atol=ROUND_OFF, rtol=0)
    assert output.heads[2] is output.motion
