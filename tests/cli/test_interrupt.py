"""Ctrl-C at any moment: one sentence, 130, and nothing left."""

import os
import signal
import subprocess
import sys
import time

import pytest

# Imports take one to two seconds of a run: NumPy's, PyTorch's and our own.
MOMENTS_S = (0.0, 0.1, 0.25, 0.5)


@pytest.mark.skipif(sys.platform == "win32", reason="Windows sends Ctrl-C to whole groups")
@pytest.mark.parametrize("moment_s", MOMENTS_S)
def test_interrupted_while_modules_are_imported(sweep, tmp_path, moment_s):
    """Libraries that do not survive an interrupted import are not interrupted in it."""
    reading, writing = os.pipe()
    program = (
        "import os, sys; import sonosweep.cli.main as main;"
        "sys.argv = ['sonosweep', 'reconstruct', 'speckle.h5', '-o', 'out',"
        "'--voxel-mm', '0.02'];"
        f"os.write({writing}, b'!'); main.main()"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", program],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        pass_fds=[writing],
    )
    os.read(reading, 1)
    time.sleep(moment_s + 0.02)  # the handler is set in the first lines of main

    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=60)
    os.close(reading)
    os.close(writing)

    assert process.returncode == 130, error
    assert error.splitlines()[-1] == "sonosweep: interrupted; no output was left half-written"
    assert "Traceback" not in error
    assert {path.name for path in tmp_path.iterdir()} == {"speckle.h5"}


@pytest.mark.skipif(sys.platform == "win32", reason="Windows sends Ctrl-C to whole groups")
def test_interrupted_in_a_destructor(tmp_path):
    """Python drops what a destructor raises; the interrupt is asked for again."""
    program = """
import signal, sys, time
import sonosweep.cli.app as app, sonosweep.cli.main as main

class Dying:
    def __del__(self):
        signal.raise_signal(signal.SIGINT)

def work(arguments):
    Dying()
    time.sleep(30)

app.run = work
main.main()
"""
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, timeout=20
    )

    assert done.returncode == 130, done.stderr
    assert done.stderr == "sonosweep: interrupted; no output was left half-written\n"
