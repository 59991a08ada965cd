"""Global-local attention: each equation of the paper, one number at a time in NumPy."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from sonosweep.estimators.attention import (
    PAPER_READING,
    AttentionReading,
    ChannelScores,
    GlobalLocalAttention,
    SpatialScores,
    cut_blocks,
)

ROUND_OFF = 1e-5  # float32 through a few sums of some hundred numbers about 1
LOCAL, GLOBAL, SIDE, SIZE = 16, 64, 16, 4
BLOCKS = (SIDE // SIZE) ** 2
CODE_READING = AttentionReading()

every_reading = pytest.mark.parametrize(
    "reading",
    [
        PAPER_READING,
        CODE_READING,
        replace(PAPER_READING, similarity="half_cosine"),
        replace(PAPER_READING, spatial_kernel=3),
        replace(PAPER_READING, pooling="mean_and_maximum"),
        replace(PAPER_READING, normalize=True),
        replace(CODE_READING, parallel=True),
    ],
)


def _features(seed: int = 0) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    local = torch.randn(2, LOCAL, SIDE, SIDE, generator=generator)
    return local, torch.randn(2, GLOBAL, SIZE, SIZE, generator=generator)


def _module(reading: AttentionReading) -> GlobalLocalAttention:
    torch.manual_seed(0)
    module = GlobalLocalAttention(LOCAL, GLOBAL, BLOCKS, SIZE, reading)
    module(*_features(1))  # running means that are not those of a new network
    return module.eval()


def _sigmoid(values: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-values))


def _silu(values: np.ndarray) -> np.ndarray:
    return values * _sigmoid(values)


def _weight(module: nn.Module) -> np.ndarray:
    weight = module.weight
    assert isinstance(weight, Tensor)
    return weight.detach().double().numpy()


def _normalized(values: np.ndarray, norm: nn.Module) -> np.ndarray:
    """Return what batch normalization in evaluation makes of (channels, ...) values."""
    if isinstance(norm, nn.Identity):
        return values
    assert isinstance(norm, nn.BatchNorm1d | nn.BatchNorm2d)
    assert norm.running_mean is not None
    assert norm.running_var is not None
    mean, variance = norm.running_mean.double().numpy(), norm.running_var.double().numpy()
    scale = _weight(norm) / np.sqrt(variance + norm.eps)
    column = (-1,) + (1,) * (values.ndim - 1)
    bias = norm.bias.detach().double().numpy()
    return (values - mean.reshape(column)) * scale.reshape(column) + bias.reshape(column)


def _channel_scores(values: np.ndarray, module: ChannelScores, maximum: bool) -> np.ndarray:
    """Return S_c = sigma(W_2 W_1 P_c) of (channels, rows, columns)."""
    one, two = _weight(module.perceptron[0]), _weight(module.perceptron[2])
    scores = _sigmoid(two @ _silu(one @ values.mean((1, 2))))
    if maximum:
        scores = scores + _sigmoid(two @ _silu(one @ values.max((1, 2))))
    return scores


def _spatial_scores(values: np.ndarray, module: SpatialScores) -> np.ndarray:
    """Return S_s = sigma(W_s * P_s), P_s the maximum and the mean over channels."""
    kernel = _weight(module.convolution)[0]
    half = kernel.shape[-1] // 2
    pooled = np.stack((values.max(0), values.mean(0)))
    padded = np.pad(pooled, ((0, 0), (half, half), (half, half)))
    scores = np.zeros(values.shape[1:])
    for row, column in np.ndindex(scores.shape):
        window = padded[:, row : row + 2 * half + 1, column : column + 2 * half + 1]
        scores[row, column] = (window * kernel).sum()
    return _sigmoid(_normalized(scores[None], module.norm)[0])


def _by_equations(
    local: np.ndarray, whole: np.ndarray, module: GlobalLocalAttention, reading: AttentionReading
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return L, G and the weights of one frame, equation after equation."""
    maximum = reading.pooling == "mean_and_maximum"
    channel = _channel_scores(whole, module.global_scores, maximum)[:, None, None]
    spatial = _spatial_scores(whole if reading.parallel else channel * whole, module.spatial_scores)
    refined = spatial[None] * channel * whole

    summary = np.einsum("lg,grc->lrc", _weight(module.to_local)[..., 0, 0], refined)
    if reading.normalize:
        assert isinstance(module.after_local, nn.Sequential)
        summary = _silu(_normalized(summary, module.after_local[0]))

    local_scores = _channel_scores(local, module.local_scores, maximum)[:, None, None]
    weights, weighted = [], []
    for row in range(0, SIDE, SIZE):
        for column in range(0, SIDE, SIZE):
            block = local_scores * local[:, row : row + SIZE, column : column + SIZE]
            cosine = (block * summary).sum() / np.linalg.norm(block) / np.linalg.norm(summary)
            weights.append((cosine + 1) / 2 if reading.similarity == "half_cosine" else cosine)
            weighted.append(weights[-1] * block)

    mixed = np.einsum("mk,kcyx->mcyx", _weight(module.mixing), np.stack(weighted))
    if reading.normalize:
        assert isinstance(module.after_mixing, nn.Sequential)
        mixed = _silu(_normalized(mixed, module.after_mixing[0]))
    return mixed.reshape(refined.shape), refined, np.array(weights)


@every_reading
def test_it_computes_the_equations(reading: AttentionReading) -> None:
    """L, G and the weights are those of the paper, or of the code where it is asked for."""
    module = _module(reading)
    local, whole = _features()

    with torch.inference_mode():
        got = module(local, whole)

    for frame in range(2):
        expected = _by_equations(
            local[frame].double().numpy(), whole[frame].double().numpy(), module, reading
        )
        for ours, oracle in zip(got, expected, strict=True):
            np.testing.assert_allclose(ours[frame].numpy(), oracle, atol=ROUND_OFF, rtol=0)


def test_sizes_are_the_papers() -> None:
    """128 x 64 x 64 and 512 x 4 x 4 give W of 8 and 32 rows, 256 blocks, and 512 x 4 x 4."""
    module = GlobalLocalAttention(128, 512, 256, 4, PAPER_READING).eval()

    with torch.inference_mode():
        local, whole, weights = module(torch.rand(1, 128, 64, 64), torch.rand(1, 512, 4, 4))

    assert (local.shape, whole.shape, weights.shape) == ((1, 512, 4, 4), (1, 512, 4, 4), (1, 256))
    assert _weight(module.local_scores.perceptron[0]).shape == (8, 128)
    assert _weight(module.global_scores.perceptron[0]).shape == (32, 512)
    assert _weight(module.spatial_scores.convolution).shape == (1, 2, 1, 1)
    assert _weight(module.to_local).shape == (128, 512, 1, 1)


def test_blocks_like_the_global_features_weigh_most() -> None:
    """A block that is the summary itself has weight 1, its opposite -1 (paper) or 0 (code)."""
    for reading, opposite in ((PAPER_READING, -1.0), (CODE_READING, 0.0)):
        module = _module(reading)
        _, whole = _features()
        summaries: list[Tensor] = []
        module.after_local.register_forward_hook(
            lambda module, given, result, kept=summaries: kept.append(result)
        )
        with torch.inference_mode():
            module(_features()[0], whole)
            local = summaries[0].repeat(1, 1, SIDE // SIZE, SIDE // SIZE)
            local[..., :SIZE, SIZE : 2 * SIZE] *= -1
            # Without channel scores, which would turn blocks away from the summary.
            module.local_scores = _Ones()  # type: ignore[assignment]  # a stand-in
            weights = module(local, whole)[2]

        expected = torch.ones(2, BLOCKS)
        expected[:, 1] = opposite
        torch.testing.assert_close(weights, expected, atol=ROUND_OFF, rtol=0)


class _Ones(nn.Module):
    def forward(self, pixels: Tensor) -> Tensor:
        return pixels.new_ones(1)


def test_blocks_are_cut_row_by_row() -> None:
    """Block 1 lies right of block 0; a block's numbers go over rows, columns, channels."""
    pixels = torch.arange(2 * 8 * 12 * 3.0).reshape(2, 8, 12, 3)

    blocks = cut_blocks(pixels, 4)

    assert blocks.shape == (2, 6, 48)
    assert torch.equal(blocks[1, 1], pixels[1, :4, 4:8].flatten())
    assert torch.equal(blocks[1, 3], pixels[1, 4:, :4].flatten())


def test_features_without_content_have_no_weight_and_a_gradient() -> None:
    """Dark frames give finite numbers, in training too."""
    module = GlobalLocalAttention(LOCAL, GLOBAL, BLOCKS, SIZE, PAPER_READING)
    local, whole = (torch.zeros_like(part).requires_grad_() for part in _features())

    mixed, refined, weights = module(local, whole)
    (mixed.sum() + refined.sum() + weights.sum()).backward()

    assert float(weights.detach().abs().max()) == 0
    for part in (local, whole):
        assert part.grad is not None
        assert bool(part.grad.isfinite().all())
