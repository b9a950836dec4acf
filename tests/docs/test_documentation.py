"""Every command and every program that README and documentation show is run, with the stand-ins of `stand_ins`."""

import importlib
import inspect
import re
import shlex
import subprocess
import tomllib
from contextlib import redirect_stdout, suppress
from functools import cache, wraps
from io import StringIO
from pathlib import Path

import pytest
import tyro
import yaml

from benchmarks.__main__ import NAMES as BENCHMARKS
from rbpf.cli import main
from tests.docs.blocks import PAGES, ROOT, Block, blocks, commands, inline_commands
from tests.docs.stand_ins import PREAMBLE, Shelf, lay_out, shortened

LANGUAGES = {"sh", "python", "yaml"}
INSTALLED_ELSEWHERE = ("pip", "git", "cd", "python3", "dask")
"""Checked by tests/test_installation.py and, what Dask starts, by tests/validation/test_sweep.py."""


def name_of(page: Path) -> str:
    return str(page.relative_to(ROOT))


WITH_BLOCKS = [page for page in PAGES if blocks(page)]


@pytest.fixture(scope="session")
def shelf(tmp_path_factory):
    return Shelf(tmp_path_factory.mktemp("shelf"))


@pytest.mark.slow
@pytest.mark.parametrize("page", WITH_BLOCKS, ids=name_of)
def test_what_a_page_shows_works(page, shelf, tmp_path, monkeypatch, drawn_once):
    monkeypatch.syspath_prepend(ROOT)
    monkeypatch.syspath_prepend(ROOT / "examples")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("rbpf.validation.gtsam.self_calibration.ITERATIONS", 10)  # so few images determine little
    lay_out(name_of(page), shelf, tmp_path)
    names: dict[str, object] = {}
    exec(PREAMBLE.get(name_of(page), ""), names)
    for block in blocks(page):
        show(block, names)


def show(block: Block, names: dict[str, object]) -> None:
    """Runs, reads or writes a block."""
    if block.file:
        Path(block.file).write_text(block.text, encoding="utf-8")
    if block.language == "python":
        exec(compile("\n" * block.line + block.text, block.page, "exec"), names)
    elif block.language == "yaml":
        assert yaml.safe_load(block.text)
    else:
        for command in commands(block):
            run(command, block)


def run(command: list[str], block: Block) -> None:
    program = Path(command[0]).name
    where = f"{block.page}:{block.line}: {shlex.join(command)}"
    if program == "rbpf":
        assert main(shortened(command[1:], block.page)) == 0, where
    elif program == "make":
        run_make(command, where)
    elif program == "python":
        check_program(command[1:], where)
    else:
        assert program in INSTALLED_ELSEWHERE, where
        check_extras(command, where)


def run_make(command: list[str], where: str) -> None:
    """What make would do is asked for; what `make demo` would do is done, shorter."""
    done = subprocess.run(["make", "-n", *command[1:]], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{where}: {done.stderr}"
    if command[1] == "demo":
        (recipe,) = [line for line in done.stdout.splitlines() if "rbpf demo" in line]
        assert main(shortened(shlex.split(recipe)[1:])) == 0, where


def check_program(words: list[str], where: str) -> None:
    """A program of the project takes these arguments; tests/examples runs every example."""
    if words[0] == "-m" and words[1] == "benchmarks":
        assert {word for word in words[2:] if word[0] != "-"} <= set(BENCHMARKS), where
    elif words[0] == "-m" and words[1].startswith("examples."):
        takes(ROOT / f"{words[1].replace('.', '/')}.py", words[2:], where)
    elif words[0] == "-m":
        assert importlib.util.find_spec(words[1]) is not None, where
    elif words[0] != "-c":
        takes(ROOT / words[0], words[1:], where)


def takes(path: Path, arguments: list[str], where: str) -> None:
    """Its command line is parsed, and its `main` not called."""
    assert path.is_file(), where
    folder = ".".join(path.parent.relative_to(ROOT).parts)
    function = importlib.import_module(f"{folder}.{path.stem}").main
    if inspect.signature(function).parameters:
        parsed = wraps(function)(lambda *args, **kwargs: None)
        tyro.cli(parsed, args=arguments)
    else:
        assert not arguments, where


def check_extras(command: list[str], where: str) -> None:
    """`rbpf[extra]` names extras that the project has."""
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    for word in command:
        if "[" in word:
            assert set(word.split("[")[1].rstrip("]").split(",")) <= set(extras), where


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_a_page_has_no_block_of_an_unknown_kind(page):
    assert {block.language for block in blocks(page)} <= LANGUAGES
    indented = [line for line in page.read_text(encoding="utf-8").splitlines() if line.startswith("    rbpf ")]
    assert not indented, "a command that is not between fences is not run"


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_commands_in_a_sentence_exist(page):
    for command in inline_commands(page):
        where = f"{name_of(page)}: {shlex.join(command)}"
        if command[0] == "rbpf":
            rest = [word for word in command[1:] if word != "…"]
            options = [word.split("=")[0] for word in rest if word.startswith("--")]
            helped = help_text(tuple(path_of(rest)))
            assert helped, where
            assert all(option in helped for option in options if option != "--help"), where
        elif command[0] == "make":
            run_make(["make", command[1]], where) if command[1] != "demo" else None
        elif command[1:2] == ["-m"] and command[2].startswith(("benchmarks", "examples")):
            check_program([word for word in command[1:] if word != "…"], where)
        elif command[1].endswith(".py"):
            assert (ROOT / command[1]).is_file(), where


def test_every_command_is_on_the_page_of_commands():
    """`rbpf simulate` has no options of its own, and `room` those of `desk`."""
    page = (ROOT / "docs" / "command_line.md").read_text(encoding="utf-8")
    shown = {tuple(words.split()) for words in re.findall(r"\{command-help\} ?(.*)", page)}
    below = [
        (*above, name)
        for above in ((), ("run",), ("simulate",))
        for name in re.search(r"\{([\w,-]+)\}", help_text(above))[1].split(",")
    ]
    assert set(below) - {("simulate",), ("simulate", "room")} == shown - {()}


def path_of(words: list[str]) -> list[str]:
    """The command that the words begin with: as many as have a help of their own."""
    found: list[str] = []
    for word in words:
        if not word.replace("-", "").isalpha() or not word.islower() or not help_text((*found, word)):
            break
        found.append(word)
    return found


@cache
def help_text(command: tuple[str, ...]) -> str:
    """What `--help` prints; empty if there is no such command, for which the help of what is above it is shown."""
    text = StringIO()
    with redirect_stdout(text), suppress(SystemExit):
        main([*command, "--help"])
    return text.getvalue() if f"usage: {' '.join(['rbpf', *command])} [" in text.getvalue() else ""
