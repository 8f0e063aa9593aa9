"""Fixtures of the whole suite."""

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real recordings, which are not part of the repository."""
    default = Path(__file__).resolve().parents[1] / ".." / "shared" / "data"
    folder = Path(os.environ.get("STREAMFEAT_DATA", default))
    if not folder.is_dir():
        pytest.skip("no real recordings: set STREAMFEAT_DATA to their folder")
    return folder.resolve()
