"""The layers of ARCHITECTURE.md."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_imports_point_down():
    """No module imports from a layer above its own."""
    script = Path(sys.executable).with_name("lint-imports")

    run = subprocess.run([script, "--no-cache"], cwd=ROOT, capture_output=True, text=True)

    assert run.returncode == 0, run.stdout


def test_help_loads_nothing_heavy():
    """The list of verbs comes without loading torch, numba or a format's library."""
    code = (
        "import sys; from sonosweep.cli.main import main; main(['--help']);"
        " print(sorted({'torch', 'numba', 'h5py', 'av', 'scipy'} & set(sys.modules)))"
    )

    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)

    assert run.stdout.splitlines()[-1] == "[]"
