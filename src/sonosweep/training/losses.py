"""What is wrong with predicted motions, as one number to make small.

Motions are in scaled units: divided by a scale for each of the six numbers. All heads of a
network are compared with the truth, and their losses averaged.

References:
    Lee et al., "Enhancing Free-hand 3D Photoacoustic and Ultrasound Reconstruction using
    Deep Learning", section "Loss Functions", whose symbols the docstrings name.
"""

from collections.abc import Callable
from typing import Literal

import torch
from jaxtyping import Float
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor
from torch.nn import functional

from sonosweep.errors import TrainingError
from sonosweep.estimators.diagonals import full_precision
from sonosweep.estimators.network import NetworkOutput

Motion = Float[Tensor, "batch steps motion=6"]
Scalar = Float[Tensor, ""]

SMALLEST_LENGTH = 1e-6  # of a vector whose direction is compared; motions are about 1


class LossSettings(BaseModel):
    """How much each loss counts; the sum is what is made small.

    Attributes:
        l1: Mean absolute error.
        huber: Squared below ``huber_width``, absolute above it.
        mmae: Error weighted by motion; 1 in the paper's sum.
        correlation: One less the cosine; 1 in the paper's sum.
        triplet: Margin triplet of embeddings; .005 in the released code. A network that
            has no embedding is not affected.
        gaussian: Negative log-likelihood, for networks that predict a variance.
        huber_width: In scaled units.
        smoothing: The paper's epsilon in the weight of ``mmae``; 2 in the released code.
        correlate: ``"sequence"``: each of the six numbers over the steps of a window, as
            the paper has it; ``"batch"``: all numbers of a batch at once, as the released
            code does.
        margin: Of the triplet loss; .1 in the released code, none in the paper.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    l1: float = Field(default=0.0, ge=0)
    huber: float = Field(default=0.0, ge=0)
    mmae: float = Field(default=0.0, ge=0)
    correlation: float = Field(default=0.0, ge=0)
    triplet: float = Field(default=0.0, ge=0)
    gaussian: float = Field(default=0.0, ge=0)
    huber_width: float = Field(default=0.1, gt=0)
    smoothing: float = Field(default=2.0, ge=0)
    correlate: Literal["sequence", "batch"] = "sequence"
    margin: float = Field(default=0.1, ge=0)


def total_loss(
    settings: LossSettings, output: NetworkOutput, true: Motion
) -> tuple[Scalar, dict[str, Scalar]]:
    """Return the weighted sum of the losses (L_Final), and each loss by name.

    Raises:
        TrainingError: If no loss counts, or the network gives no variance and one is asked.
    """
    parts: dict[str, Scalar] = {}
    for name, loss in _motion_losses(settings).items():
        if getattr(settings, name) > 0:
            parts[name] = torch.stack([loss(head, true) for head in output.heads]).mean()
    if settings.gaussian > 0:
        if output.log_variance is None:
            raise TrainingError("loss.gaussian needs a network that predicts a variance")
        parts["gaussian"] = gaussian_loss(output.motion, output.log_variance, true)
    if settings.triplet > 0 and output.embedding is not None:
        parts["triplet"] = triplet_loss(output.embedding, true[:, -1], settings.margin)
    if not parts:
        raise TrainingError("no loss counts: give loss.l1, loss.mmae or another above 0")
    weighted = [getattr(settings, name) * value for name, value in parts.items()]
    return torch.stack(weighted).sum(), parts


def _motion_losses(settings: LossSettings) -> dict[str, Callable[[Motion, Motion], Scalar]]:
    """Return the losses that compare one head with the truth."""
    correlate = correlation_loss if settings.correlate == "sequence" else batch_correlation_loss
    return {
        "l1": l1_loss,
        "huber": lambda motion, true: huber_loss(motion, true, settings.huber_width),
        "mmae": lambda motion, true: mmae_loss(motion, true, settings.smoothing),
        "correlation": correlate,
    }


def l1_loss(motion: Motion, true: Motion) -> Scalar:
    """Return the mean absolute error."""
    return (motion - true).abs().mean()


def huber_loss(motion: Motion, true: Motion, width: float = 0.1) -> Scalar:
    """Return the mean of errors, squared where small: with slope 1 from ``width`` on."""
    return functional.huber_loss(motion, true, delta=width) / width


def mmae_loss(motion: Motion, true: Motion, smoothing: float = 2.0) -> Scalar:
    """Return the mean absolute error weighted by |true| + smoothing (L_MMAE).

    Differs:
        The released code passes no weight, so that its loss is the plain mean absolute
        error. Here the weight is used; it is a number of the truth and has no gradient.
    """
    weight = true.detach().abs() + smoothing
    return (weight * (motion - true).abs()).mean()


def correlation_loss(motion: Motion, true: Motion) -> Scalar:
    """Return 1 less the cosine over the steps of a window, mean over the six (L_Corr).

    Over a number that is 0 in all steps, the cosine is taken as 0.
    """
    return 1 - functional.cosine_similarity(motion, true, dim=1, eps=SMALLEST_LENGTH).mean()


def batch_correlation_loss(motion: Motion, true: Motion) -> Scalar:
    """Return 1 less the cosine over all numbers of a batch, as the released code has it."""
    cosine = functional.cosine_similarity(
        motion.flatten(), true.flatten(), dim=0, eps=SMALLEST_LENGTH
    )
    return 1 - cosine


def triplet_loss(
    embedding: Float[Tensor, "batch features"],
    true: Float[Tensor, "batch motion=6"],
    margin: float = 0.1,
) -> Scalar:
    """Return by how much embeddings of like motions lie farther apart than of unlike ones.

    Every sample is an anchor once with every two others of the batch; of these, the one
    whose motion has the larger cosine with the anchor's is the positive (L_Triplet). Pairs
    of equal cosine say nothing and are left out; 0 if no triplet is left.

    Differs:
        The margin, which the released code adds and the equation lacks: without it, equal
        embeddings of everything would be best.
    """
    unit = functional.normalize(true.float(), dim=1, eps=SMALLEST_LENGTH)
    with full_precision(embedding.device):  # in 16 bits different motions become alike
        apart = torch.cdist(embedding.float(), embedding.float())
        likeness = unit @ unit.T
    # Axes: anchor, positive, negative.
    valid = likeness[:, :, None] > likeness[:, None, :]
    itself = torch.eye(len(true), dtype=torch.bool, device=true.device)
    valid = valid & ~itself[:, :, None] & ~itself[:, None, :]
    excess = (apart[:, :, None] - apart[:, None, :] + margin).relu()
    return torch.where(valid, excess, 0).sum() / valid.sum().clamp(min=1)


def gaussian_loss(motion: Motion, log_variance: Motion, true: Motion) -> Scalar:
    """Return the negative log-likelihood of independent normal errors, up to a constant."""
    return 0.5 * (log_variance + (motion - true).square() * torch.exp(-log_variance)).mean()
