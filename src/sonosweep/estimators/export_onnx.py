"""A network's single step as an ONNX model, for programs without torch.

The model takes a frame, the features of the frame before and the recurrent state, and gives
the motion from that frame to this one, the features of this frame and the new state. Whoever
runs it hands features and state back with the next frame. Before the first frame all of them
are zeros; of what comes out of the first frame only the features count.
"""

import warnings
from importlib.util import find_spec
from os import PathLike
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sonosweep.errors import ScanError
from sonosweep.estimators.network import MotionNetwork, RecurrentNetwork

OPSET = 18


def export_step(network: MotionNetwork, path: str | PathLike[str]) -> tuple[str, ...]:
    """Return the names of the model's inputs, after writing it.

    Inputs are ``frame`` (1, channels, rows, columns), ``features_0``, ... and ``state_0``,
    ...; outputs are ``motion`` (1, 6) in scaled units, then ``next_features_0``, ... and
    ``next_state_0``, ... in the same order. Float32 throughout.

    Args:
        network: In evaluation mode, on the CPU.
        path: File to write, with all weights in it.

    Raises:
        ScanError: If the network looks at windows, or the packages for ONNX are missing.
    """
    if not isinstance(network, RecurrentNetwork):
        raise ScanError("only networks that carry a state from frame to frame run step by step")
    if any(find_spec(name) is None for name in ("onnx", "onnxscript")):
        raise ScanError("ONNX models need: pip install 'sonosweep[onnx]'")
    step = _Step(network)
    inputs = step.example()
    given = ["frame", *step.names("")]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of torch's own exporter about itself
        torch.onnx.export(
            step,
            inputs,
            Path(path),
            input_names=given,
            output_names=["motion", *step.names("next_")],
            opset_version=OPSET,
            dynamo=True,
            external_data=False,
            verbose=False,
        )
    return tuple(given)


class _Step(nn.Module):
    """A network for a frame at a time.

    Args:
        network: In evaluation mode.
    """

    def __init__(self, network: RecurrentNetwork) -> None:
        super().__init__()
        self.network = network
        frame = self._frame()
        with torch.inference_mode():
            self._features = network.encode(frame)
            pairs = network.compare(self._features, self._features)
            _, self._state = network.regress(tuple(part[:, None] for part in pairs), None)

    def forward(
        self, frame: Float[Tensor, "1 channels rows columns"], *kept: Tensor
    ) -> tuple[Tensor, ...]:
        """Return the motion, then what is to be kept for the next frame."""
        before, state = kept[: len(self._features)], kept[len(self._features) :]
        features = self.network.encode(frame)
        pairs = tuple(part[:, None] for part in self.network.compare(before, features))
        output, after = self.network.regress(pairs, state)
        return (output.motion[:, 0], *features, *after)

    def example(self) -> tuple[Tensor, ...]:
        """Return inputs of the right shapes."""
        kept = (*self._features, *self._state)
        return (self._frame(), *(torch.zeros(part.shape) for part in kept))

    def names(self, prefix: str) -> list[str]:
        """Return the names of what is kept."""
        return [
            *(f"{prefix}features_{k}" for k in range(len(self._features))),
            *(f"{prefix}state_{k}" for k in range(len(self._state))),
        ]

    def _frame(self) -> Float[Tensor, "1 channels rows columns"]:
        shape = self.network.frame_shape
        return torch.zeros(1, shape.channels, shape.rows, shape.columns)
