"""The last layer of a motion network."""

from jaxtyping import Float
from torch import Tensor, nn

LARGEST_LOG_VARIANCE = 10.0
"""Log variances stay within plus and minus this, or one bad batch makes a loss infinite."""


class MotionHead(nn.Module):
    """Turns features of a step into six scaled numbers, and how sure it is of each if asked to.

    Args:
        features: How many come in.
        log_variance: Whether the variance of each number is predicted as well.
    """

    def __init__(self, features: int, log_variance: bool = False) -> None:
        super().__init__()
        self._log_variance = log_variance
        self.linear = nn.Linear(features, 12 if log_variance else 6)

    def forward(
        self, features: Float[Tensor, "*steps features"]
    ) -> tuple[Float[Tensor, "*steps motion=6"], Float[Tensor, "*steps motion=6"] | None]:
        """Return motions in scaled units and their log variance, ``None`` unless asked for."""
        return _parts(self.linear(features), self._log_variance)


class WindowHead(nn.Module):
    """Turns features of a window into the motion of each of its steps.

    Args:
        features: How many come in.
        steps: In the window.
        mean: Whether one motion is predicted and given for every step. Trained against the
            steps, it becomes their mean or median, whichever the loss asks for.
        log_variance: Whether the variance of each number is predicted as well.
    """

    def __init__(self, features: int, steps: int, mean: bool, log_variance: bool) -> None:
        super().__init__()
        self._steps, self._log_variance = steps, log_variance
        self._told = 1 if mean else steps
        self.linear = nn.Linear(features, self._told * (12 if log_variance else 6))

    def forward(
        self, features: Float[Tensor, "batch features"]
    ) -> tuple[Float[Tensor, "batch steps motion=6"], Float[Tensor, "batch steps motion=6"] | None]:
        """Return motions in scaled units and their log variance, ``None`` unless asked for."""
        numbers = self.linear(features).unflatten(1, (self._told, -1))
        return _parts(numbers.expand(-1, self._steps, -1), self._log_variance)


def _parts(numbers: Tensor, log_variance: bool) -> tuple[Tensor, Tensor | None]:
    """Return motion and bounded log variance from the numbers of a last layer."""
    if not log_variance:
        return numbers, None
    limit = LARGEST_LOG_VARIANCE
    return numbers[..., :6], limit * (numbers[..., 6:] / limit).tanh()
