"""Sequences that the tests of the command line fraction, and cheap pictures."""

from pathlib import Path

import pytest

from rbpf.cli import main
from tests.cli.run_outputs import STEPS
from tests.cli.sequences import as_folder, render_desk, render_room


@pytest.fixture(scope="module", autouse=True)
def cheap(plain_pictures: None) -> None:
    """Pictures as they are meant to be looked at are painted in tests/cli/test_painting.py."""


@pytest.fixture(scope="session")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A few images of a desk with known points; not to be written to."""
    return render_desk(tmp_path_factory.mktemp("rendered") / "desk")


@pytest.fixture(scope="session")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A robot's; not to be written to."""
    folder = tmp_path_factory.mktemp("simulated") / "log"
    assert main(["simulate", "range-bearing", "--out", str(folder), "--steps", str(STEPS), "--landmarks", "30"]) == 0
    return folder


@pytest.fixture
def folder(desk: Path, tmp_path: Path) -> Path:
    """The desk's images as a folder of the test's own."""
    return as_folder(desk, tmp_path / "folder")


@pytest.fixture(scope="session")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A few pairs of images of a room; not to be written to."""
    return render_room(tmp_path_factory.mktemp("rendered") / "room")
