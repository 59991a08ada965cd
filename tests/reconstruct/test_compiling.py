"""Telling the user that a first run compiles."""

import os
import subprocess
import sys

SCRIPT = """
import numpy as np, torch
from sonosweep.reconstruct.compiling import must_compile
from sonosweep.reconstruct.compound import compound_frames
from sonosweep.scan import VolumeGrid
print(must_compile("forward"))
pose = torch.eye(4, dtype=torch.float64)
grid = VolumeGrid((2, 2, 1), (1.0, 1.0, 1.0))
compound_frames(np.ones((1, 2, 2), np.uint8), pose[None], pose, grid, method="forward", threads=1)
print(must_compile("forward"))
"""


def test_only_the_first_run_compiles(tmp_path):
    """With an empty cache the first process says so, and the second does not."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}

    runs = [
        subprocess.run(
            [sys.executable, "-c", SCRIPT], env=environment, capture_output=True, text=True
        )
        for _ in range(2)
    ]

    assert [run.stdout.split() for run in runs] == [["True", "False"], ["False", "False"]]
