"""The five networks that the paper compares with, against what is published of them."""

import pytest
from torch import nn

from sonosweep.errors import ScanError
from sonosweep.estimators.cnn import CNN, CNNOptions
from sonosweep.estimators.network import FrameShape


def _parameters(module: nn.Module) -> int:
    return sum(values.numel() for values in module.parameters())


def test_cnn_has_as_many_parameters_as_its_public_version() -> None:
    """Guo et al.'s version of Prevost's network has 182,790 without optical flow, at 224 px."""
    assert _parameters(CNN(FrameShape(1, 224, 224))) == 182_790


def test_cnn_refuses_frames_that_its_poolings_would_leave_nothing_of() -> None:
    """Six halvings need 64 pixels, after shrinking."""
    with pytest.raises(ScanError, match="128 x 128"):
        CNN(FrameShape(1, 64, 64), CNNOptions(shrink=2))
