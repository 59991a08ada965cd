"""Single steps as ONNX models, run by ONNX Runtime."""

import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from sonosweep.errors import ScanError
from sonosweep.estimators.export_onnx import export_step
from sonosweep.estimators.moglo import COMPACT, MoGLo
from sonosweep.estimators.network import FrameShape, MotionNetwork, Stepper
from tests.estimators.tiny_networks import TINY

ROUND_OFF = 1e-5  # float32 through some twenty layers, of values about 1


def _check(network: MotionNetwork, path: Path, frames: int = 4) -> None:
    """Run a sweep with torch and with ONNX Runtime, and compare the motions."""
    runtime = pytest.importorskip("onnxruntime", reason="needs sonosweep[onnx]")
    pytest.importorskip("onnxscript", reason="needs sonosweep[onnx]")
    shape = network.frame_shape
    sweep = torch.rand(frames, shape.channels, shape.rows, shape.columns)

    names = export_step(network, path)

    session = runtime.InferenceSession(path, providers=["CPUExecutionProvider"])
    inputs = {part.name: part.shape for part in session.get_inputs()}
    assert tuple(inputs) == names
    kept = {name: np.zeros(inputs[name], np.float32) for name in names[1:]}
    stepper = Stepper(network)
    for k, frame in enumerate(sweep):
        motion, *after = session.run(None, {"frame": frame[None].numpy(), **kept})
        expected = stepper.push(frame)
        for name, values in zip(names[1:], after, strict=True):
            if k > 0 or name.startswith("features"):
                kept[name] = values
        if expected is not None:
            np.testing.assert_allclose(motion, expected.motion[:, 0], atol=ROUND_OFF, rtol=0)


@pytest.mark.parametrize("name", ["cnn", "moglo", "lstm"])
def test_onnx_gives_the_same_motion(name: str, tmp_path: Path) -> None:
    """A sweep of four frames moves the same without torch."""
    torch.manual_seed(0)

    _check(TINY[name]().eval(), tmp_path / "step.onnx")


@pytest.mark.slow
def test_onnx_gives_the_same_motion_as_compact_moglo(tmp_path: Path) -> None:
    """So does the compact network at the size of its frames."""
    torch.manual_seed(0)

    _check(MoGLo(FrameShape(), COMPACT).eval(), tmp_path / "step.onnx")


def test_windows_have_no_step(tmp_path: Path) -> None:
    """A network that looks at whole windows keeps nothing for the next frame."""
    with pytest.raises(ScanError, match="only networks that carry a state"):
        export_step(TINY["dcl"](), tmp_path / "step.onnx")


def test_missing_packages_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the extra, the message says how to get it."""
    monkeypatch.setitem(sys.modules, "onnx", None)

    with pytest.raises(ScanError, match=r"pip install 'sonosweep\[onnx\]'"):
        export_step(TINY["moglo"](), tmp_path / "step.onnx")
