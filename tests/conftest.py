"""What every test may use."""

from pathlib import Path

import pytest
from hypothesis import settings

settings.register_profile("repeatable", deadline=None, derandomize=True, max_examples=50)
settings.load_profile("repeatable")

RECORDINGS = Path(__file__).parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def recordings() -> Path:
    """Return the folder of real recordings beside the project, or skip."""
    if not RECORDINGS.is_dir():
        pytest.skip(f"needs the real recordings in {RECORDINGS}")
    return RECORDINGS
