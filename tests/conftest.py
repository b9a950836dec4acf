"""Fixtures and markers shared by all tests."""

import os
from pathlib import Path

import pytest

DEFAULT_DATA = Path(__file__).resolve().parent.parent.parent / "shared" / "data"


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of recordings: `RBPF_DATA`, by default `../shared/data` from the project's root."""
    folder = Path(os.environ.get("RBPF_DATA", DEFAULT_DATA))
    if not folder.is_dir():
        pytest.skip(f"no recordings at {folder}: set RBPF_DATA to the folder that holds them")
    return folder
