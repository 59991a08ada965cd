"""The one LightningModule: a batch in, loss and metrics out."""

import math
from collections.abc import Sequence
from typing import Any

import lightning.pytorch as lightning
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from sonosweep.errors import TrainingError
from sonosweep.estimators.network import MotionNetwork
from sonosweep.estimators.network_input import ZEROS, unit_frames
from sonosweep.training.augment import change_looks
from sonosweep.training.losses import total_loss
from sonosweep.training.recipe import Recipe, Stage
from sonosweep.training.scans import TrainingScan
from sonosweep.training.sequences import Batch, MotionStatistics, step_place
from sonosweep.training.validate import predict_motion, scan_metrics

SMALLEST_RATE = 1e-3  # share of the learning rate with which a warm-up begins


class MotionModule(lightning.LightningModule):
    """Trains a network as a recipe says.

    Args:
        network: To train.
        recipe: How.
        statistics: Of the motions that it learns.
    """

    def __init__(
        self, network: MotionNetwork, recipe: Recipe, statistics: MotionStatistics
    ) -> None:
        super().__init__()
        self.network = with_channels_last(network)
        self.recipe = recipe
        self.statistics = statistics

    def training_step(self, batch: Batch, _: int) -> Float[Tensor, ""]:
        """Return the loss of a batch.

        Raises:
            TrainingError: If it is not a number.
        """
        self._seed_step()
        zeros = ZEROS[self.recipe.input.channels]
        frames = change_looks(unit_frames(batch.frames), batch.looks, zeros)
        loss, parts = total_loss(self.recipe.loss, self.network(frames), batch.motion)
        self.latest = {name: float(value.detach()) for name, value in parts.items()}
        self.latest["loss"] = float(loss.detach())
        broken = [name for name, value in self.latest.items() if not math.isfinite(value)]
        if broken:
            self._stop(f"the loss ({', '.join(broken)})")
        return loss

    def configure_gradient_clipping(
        self,
        optimizer: torch.optim.Optimizer,
        gradient_clip_val: float | None = None,
        gradient_clip_algorithm: str | None = None,
    ) -> None:
        """Shorten a long gradient.

        Raises:
            TrainingError: If it is not finite, before it reaches the weights.
        """
        norm = nn.utils.clip_grad_norm_(self.network.parameters(), self.recipe.optimizer.clip)
        if not math.isfinite(float(norm)):
            self._stop("the gradient")

    def validate_scans(self, scans: Sequence[TrainingScan]) -> list[dict[str, float]]:
        """Return how well whole scans are read."""
        training = self.network.training
        self.network.eval()
        scale = self.statistics.scale
        with torch.autocast(self.device.type, torch.bfloat16, self.recipe.precision == "bf16"):
            motions = [predict_motion(self.network, scan, self.device) for scan in scans]
        self.network.train(training)
        return [scan_metrics(m * scale, s) for m, s in zip(motions, scans, strict=True)]

    def configure_optimizers(self) -> Any:  # Any: one of the many forms that Lightning takes
        """Return AdamW, and the learning rate of each step."""
        settings = self.recipe.optimizer
        highest = max(stage.learning_rate for stage in self.recipe.stages)
        optimizer = torch.optim.AdamW(
            self.network.parameters(),
            highest,
            betas=settings.betas,
            weight_decay=settings.weight_decay,
        )
        schedule = torch.optim.lr_scheduler.LambdaLR(
            optimizer, lambda step: learning_rate(self.recipe.stages, step) / highest
        )
        return {
            "optimizer": optimizer,
            "lr_scheduler": {"scheduler": schedule, "interval": "step"},
        }

    def _seed_step(self) -> None:
        """Let whatever is random in a step follow from its number, before and after a kill."""
        words = (self.recipe.seed, 2, self.global_step, self.global_rank)
        seed = int(np.random.SeedSequence(words).generate_state(1)[0])
        # Not torch.manual_seed: without a GPU that takes 1 ms.
        torch.default_generator.manual_seed(seed)
        if self.device.type == "cuda":
            torch.cuda.manual_seed(seed)

    def _stop(self, what: str) -> None:
        step = self.global_step
        stage = step_place(self.recipe.stages, step).stage
        raise TrainingError(
            f"{what} is not a number at step {step} (stage {stage}, learning rate"
            f" {learning_rate(self.recipe.stages, step):.2g}): the last checkpoint is from"
            " before; lower learning_rate, or set precision to 'fp32', and --resume"
        )


def learning_rate(stages: tuple[Stage, ...], step: int) -> float:
    """Return the learning rate of a step: rising linearly, then falling as half a cosine."""
    if step >= sum(stage.steps for stage in stages):
        return stages[-1].learning_rate * stages[-1].last
    place = step_place(stages, step)
    stage = stages[place.stage]
    if place.share < stage.warm_up:
        return stage.learning_rate * max(place.share / stage.warm_up, SMALLEST_RATE)
    share = (place.share - stage.warm_up) / (1 - stage.warm_up)
    cosine = 0.5 * (1 + math.cos(math.pi * share))
    return stage.learning_rate * (stage.last + (1 - stage.last) * cosine)


def with_channels_last(network: MotionNetwork) -> MotionNetwork:
    """Return the network with the weights of 2-D convolutions as bf16 kernels like them."""
    for parameter in network.parameters():
        if parameter.ndim == 4:
            parameter.data = parameter.data.contiguous(memory_format=torch.channels_last)
    return network
