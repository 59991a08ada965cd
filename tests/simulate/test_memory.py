"""How much memory it takes to make data sets."""

import subprocess
import sys

import pytest

pytest.importorskip("resource")

LARGEST_MB = 500.0
MAKE_ONE = """
import resource, sys
from dataclasses import replace
from pathlib import Path
from sonosweep.simulate import DatasetRecipe, dataset_recipe, make_dataset

if __name__ == "__main__":
    name, folder = sys.argv[1:]
    plan = dataset_recipe(name).scans[3]
    motion = replace(plan.motion, frames=30, largest_step_mm=25.0, pauses=0)
    one = DatasetRecipe(name, "full", 0, (replace(plan, motion=motion),))
    make_dataset(one, Path(folder))
    print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="other systems count other units")
@pytest.mark.parametrize("name", ["dataset1", "dataset2", "dataset3"])
def test_a_worker_needs_less_than_500_mb(name, tmp_path):
    """Files in memory are counted, too; compiling, which the first run does, is not."""
    script = tmp_path / "make_one.py"
    script.write_text(MAKE_ONE)
    for run in ("compile", "measure"):
        command = [sys.executable, str(script), name, str(tmp_path / run)]
        done = subprocess.run(command, check=True, capture_output=True, text=True)

    assert int(done.stdout) / 1024 < LARGEST_MB
