"""Running the command line as a person does."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy import ndimage

from sonosweep.cli.main import main
from sonosweep.geometry import poses_from_steps, step_from_motion
from sonosweep.io.hdf5 import write_scan
from sonosweep.scan import Calibration, Companion, Scan


@dataclass(frozen=True)
class Ran:
    """How a command ended."""

    code: int
    out: str
    error: str

    @property
    def sentence(self) -> str:
        """The last line on standard error."""
        return self.error.strip().splitlines()[-1] if self.error.strip() else ""


@pytest.fixture
def run(tmp_path, monkeypatch, capfd) -> Callable[..., Ran]:
    """Return a function that runs ``sonosweep`` in a folder of its own."""
    monkeypatch.chdir(tmp_path)

    def call(*words: object) -> Ran:
        capfd.readouterr()
        try:
            main([str(word) for word in words])
            code = 0
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 1
        return Ran(code, *capfd.readouterr())

    return call


def speckle_scan(frames: int = 12, rows: int = 96, columns: int = 80) -> Scan:
    """A tracked sweep of 0.2 mm steps through random speckle, with a companion."""
    generator = np.random.default_rng(5)
    shape = (3 * frames + 8, rows, columns)
    noise = generator.standard_normal((2, *shape))
    field = np.stack([ndimage.gaussian_filter(part, (3, 1.2, 1.5)) for part in noise])
    envelope = np.hypot(*field)[4 : 4 + 3 * frames : 3]
    decibel = 20 * np.log10(envelope / envelope.max() + 1e-6)
    pixels = np.clip(255 * (1 + decibel / 50), 0, 255).astype(np.uint8)
    motion = torch.zeros(frames - 1, 6, dtype=torch.float64)
    motion[:, 2] = 0.2
    poses = poses_from_steps(step_from_motion(motion), torch.eye(4, dtype=torch.float64))
    return Scan(
        name="speckle",
        frames=pixels,
        calibration=Calibration(spacing_mm=(0.2, 0.2)),
        timestamps_s=torch.arange(frames, dtype=torch.float64) / 20,
        image_to_reference=poses,
        companions={"photoacoustic": Companion(pixels[:, ::2, ::2].copy(), (0.4, 0.4))},
    )


@pytest.fixture
def sweep(tmp_path) -> Path:
    """Return the file of a small tracked sweep."""
    path = tmp_path / "speckle.h5"
    write_scan(speckle_scan(), path)
    return path
