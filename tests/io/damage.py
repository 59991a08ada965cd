"""Ways in which files arrive broken, and what every reader owes its user then."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import strategies as st

from sonosweep.errors import SonosweepError
from sonosweep.scan import Scan

LARGEST_RESIDENT_MB = 500  # what opening a 4 GB scan may cost, Python and torch included


@st.composite
def damaged(draw, whole: bytes) -> bytes:
    """A file cut short, or with a few bytes replaced, or not that file at all."""
    kind = draw(st.sampled_from(["cut", "flipped", "header flipped", "random"]))
    if kind == "random":
        return draw(st.binary(max_size=300))
    if kind == "cut":
        return whole[: draw(st.integers(0, len(whole) - 1))]
    reach = len(whole) if kind == "flipped" else min(len(whole), 512)
    broken = bytearray(whole)
    for _ in range(draw(st.integers(1, 8))):
        broken[draw(st.integers(0, reach - 1))] = draw(st.integers(0, 255))
    return bytes(broken)


def assert_reads_or_explains(read: Callable[[], object]) -> None:
    """Run a reader and read frames: either works, or one clear sentence comes out."""
    try:
        result = read()
        if isinstance(result, Scan):
            assert result.frames[0].shape == result.frames.shape[1:]
            assert result.frames[len(result.frames) - 1].shape == result.frames.shape[1:]
    except SonosweepError as error:
        assert_one_sentence(error)


def assert_one_sentence(error: BaseException) -> None:
    """Check that a message is one readable line of a sensible length."""
    text = str(error)
    assert 10 < len(text) < 600
    assert "\n" not in text
    assert "Traceback" not in text


def resident_mb_after(statements: str, path: Path) -> float:
    """Return the most memory (MB) that a new Python ever held while running statements.

    Args:
        statements: They see the file as ``path``.
        path: The file.
    """
    if not Path("/proc/self/status").exists():
        pytest.skip("reads the peak of its memory from /proc")
    # Not ru_maxrss: a child starts with its parent's.
    program = (
        "import sys\nfrom pathlib import Path\npath = Path(sys.argv[1])\n"
        f"{statements}\n"
        "status = Path('/proc/self/status').read_text()\n"
        "print(int(status.split('VmHWM:')[1].split()[0]) / 1024)"
    )
    run = subprocess.run(
        [sys.executable, "-c", program, str(path)], capture_output=True, text=True, check=True
    )
    return float(run.stdout)
