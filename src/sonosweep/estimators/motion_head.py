"""The last layer of a motion network."""

from jaxtyping import Float
from torch import Tensor, nn

LARGEST_LOG_VARIANCE = 10.0
"""Log variances stay within plus and minus this, or one bad batch makes a loss infinite."""


class MotionHead(nn.Module):
    """Turns features into six scaled numbers a step, and how sure it is of each if asked to.

    Args:
        features: How many come in.
        steps: That the same features tell of; ``None`` if every step has its own.
        log_variance: Whether the variance of each number is predicted as well.
    """

    def __init__(self, features: int, steps: int | None = None, log_variance: bool = False) -> None:
        super().__init__()
        self._log_variance = log_variance
        self._steps = steps
        self.linear = nn.Linear(features, (steps or 1) * (12 if log_variance else 6))

    def forward(
        self, features: Float[Tensor, "*batch features"]
    ) -> tuple[Float[Tensor, "*steps motion=6"], Float[Tensor, "*steps motion=6"] | None]:
        """Return motions in scaled units and their log variance, ``None`` unless asked for."""
        numbers = self.linear(features)
        if self._steps is not None:
            numbers = numbers.unflatten(-1, (self._steps, -1))
        if not self._log_variance:
            return numbers, None
        limit = LARGEST_LOG_VARIANCE
        return numbers[..., :6], limit * (numbers[..., 6:] / limit).tanh()
