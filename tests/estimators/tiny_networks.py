"""Each network, small enough for tests, by name."""

from collections.abc import Callable

from sonosweep.estimators.cnn import CNN, CNNOptions
from sonosweep.estimators.dc2 import DC2, DC2Options
from sonosweep.estimators.dcl import DCL, DCLOptions
from sonosweep.estimators.efficient import Efficient, EfficientOptions
from sonosweep.estimators.lstm import LSTM, LSTMOptions
from sonosweep.estimators.moglo import MoGLo, MoGLoOptions
from sonosweep.estimators.network import FrameShape, MotionNetwork
from sonosweep.estimators.resnext import ResNeXtSize

SHAPE = FrameShape(1, 64, 64)
TINY_RESNEXT = ResNeXtSize(width=4, blocks=(1, 1, 1, 1), cardinality=2)

TINY: dict[str, Callable[[], MotionNetwork]] = {
    "cnn": lambda: CNN(SHAPE, CNNOptions(width=8, hidden=8, normalize=True)),
    "dcl": lambda: DCL(SHAPE, DCLOptions(size=TINY_RESNEXT)),
    "dc2": lambda: DC2(SHAPE, DC2Options(size=TINY_RESNEXT)),
    "efficient": lambda: Efficient(SHAPE, EfficientOptions(width=0.25, depth=0.2, dropout=0.0)),
    "lstm": lambda: LSTM(SHAPE, LSTMOptions(width=4, blocks=(1, 1, 1, 1), hidden=8)),
    "moglo": lambda: MoGLo(SHAPE, MoGLoOptions(width=8, blocks=(1, 1, 2, 1), hidden=8)),
}
