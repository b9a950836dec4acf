"""Fixtures and markers shared by all tests."""

import os
from pathlib import Path

import pytest

from tests.shapes import switch, watch

if os.environ.get("RBPF_SHAPES") != "0":
    watch()

DEFAULT_DATA = Path(__file__).resolve().parent.parent.parent / "shared" / "data"


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of recordings: `RBPF_DATA`, by default `../shared/data` from the project's root."""
    folder = Path(os.environ.get("RBPF_DATA", DEFAULT_DATA))
    if not folder.is_dir():
        pytest.skip(f"no recordings at {folder}: set RBPF_DATA to the folder that holds them")
    return folder


@pytest.fixture
def unchecked_shapes(monkeypatch: pytest.MonkeyPatch) -> None:
    """For tests that hand over arrays of a wrong shape, and want to hear of it from the program."""
    monkeypatch.setattr(switch, "on", False)
