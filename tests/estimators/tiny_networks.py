"""Each network, small enough for tests, by name."""

from collections.abc import Callable

from sonosweep.estimators.cnn import CNN, CNNOptions
from sonosweep.estimators.network import FrameShape, MotionNetwork

SHAPE = FrameShape(1, 64, 64)

TINY: dict[str, Callable[[], MotionNetwork]] = {
    "cnn": lambda: CNN(SHAPE, CNNOptions(width=8, hidden=8, normalize=True)),
}
