"""What the command line writes on the terminal, its help, and what it says of words that it does not know."""

import os
import re
import shutil
import subprocess
import sys
from dataclasses import MISSING, fields, is_dataclass
from unittest.mock import Mock

import pytest

from rbpf import __version__
from rbpf.cli import APP, main
from rbpf.cli.running import RUN
from rbpf.cli.showing import progress
from rbpf.cli.simulating import SIMULATE


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("run mono --particle-count", "`rbpf run mono` has no option --particle-count: did you mean --particles?"),
        ("run mono x --known_pints=a", "has no option --known-pints: did you mean --known-points?"),
        ("run stereo x --no-vdeo", "did you mean --no-video?"),
        ("export x --xyz", "`rbpf export` has no option --xyz: there are --help, --json, --format, --out"),
        ("simulate dsek --out x", "no command `rbpf simulate dsek`: did you mean desk?"),
        ("plot x --format", "rbpf: --format is named without a value"),
        ("run laser x --seed 1e3", "rbpf: --seed takes a whole number, got '1e3'; `rbpf run laser --help` says more"),
        ("run range-bearing x --association foo", "'foo' for argument '--association', expected one of ("),
        ("run mono x --out", ", expected 1 values; `rbpf run mono --help` says more"),
        ("run stereo", "rbpf: Missing from rbpf run stereo: PAIRS image pairs, rectified or"),
        ("plot x --format bmp", "invalid choice 'bmp' for argument '--format', expected one of ("),
        ("run --from=nothing/config.yaml", "rbpf: nothing holds no config.yaml"),
        ("run --out x --from nothing/config.yaml", "rbpf: nothing holds no config.yaml"),
        *((words, "nonsense`: there are ") for words in ("nonsense", "nonsense --help", "run nonsense --help")),
    ],
)
def test_an_option_or_a_command_that_there_is_not_is_named(words, said, capsys):
    """Even where help is asked for."""
    assert main(words.split()) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("rbpf: ") and said in err and err.count("\n") == 1


@pytest.mark.parametrize("name", ["no[/a]where", "no[red]where", "no\nwhere", "no\udcffwhere", "no:cat:where"])
def test_names_are_shown_as_they_are_on_one_line(name, capsys):
    """What a terminal, or UTF-8, cannot show is an escape; a bracket is no markup; nothing refused begins a bar."""
    assert main(["report", name]) == 2
    err = capsys.readouterr().err
    shown = name.replace("\n", "\\n").replace("\udcff", "\\udcff")
    assert err.startswith(f"rbpf: {shown}") and err.count("\n") == 1


def test_a_bar_begins_with_what_is_told(capsys):
    with progress() as bar:
        tell = bar("filtering")
    assert capsys.readouterr().err == ""
    with progress() as bar:
        bar("waiting"), bar("filtering")(1, 2)
    said = capsys.readouterr().err
    assert "filtering" in said and "1/2" in said and "waiting" not in said and tell is not None


def test_ctrl_c_before_anything_is_done_is_said(monkeypatch, capsys):
    monkeypatch.setattr("rbpf.cli.repeated", Mock(side_effect=KeyboardInterrupt))
    assert main(["report", "x"]) == 130
    assert capsys.readouterr().err == "rbpf: stopped\n"


def test_only_a_run_that_fails_is_told_of_resume(monkeypatch, capsys):
    monkeypatch.setattr("rbpf.cli.repeated", Mock(side_effect=OSError(28, "No space left on device")))
    assert main(["simulate", "desk", "--out", "x"]) == 2
    assert capsys.readouterr().err == "rbpf: [Errno 28] No space left on device\n"
    assert main(["run", "mono", "x"]) == 2
    assert "--resume goes on" in capsys.readouterr().err


def test_no_threads_and_no_workers_at_all_are_refused(capsys):
    """Threads in a process of its own: Numba cannot even be imported with none."""
    assert main(["compare", "x", "y", "--workers", "0"]) == 2 and "--workers must be" in capsys.readouterr().err
    words = [sys.executable, "-m", "rbpf", "report", "x"]
    done = subprocess.run(words, env={**os.environ, "NUMBA_NUM_THREADS": "0"}, capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr == "rbpf: the environment's NUMBA_NUM_THREADS must be a whole number from 1 up, got '0'\n"


@pytest.mark.slow
def test_a_closed_standard_output_is_refused_where_a_result_is_wanted_there(tmp_path):
    words = f"'{sys.executable}' -m rbpf report '{tmp_path}'"
    found = subprocess.run(f"{words} --json >&-", shell=True, stderr=subprocess.PIPE, text=True)
    assert (found.returncode, found.stderr) == (2, "rbpf: standard output is closed: --json has nowhere to write to\n")


def test_a_broken_pipe_ends_quietly():
    command = [sys.executable, "-m", "rbpf", "completion", "bash"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdout.close()
        error = process.stderr.read().decode()
    assert process.returncode == 0 and error == ""


COMMANDS = {name: kind for name, kind in APP.kinds.items() if kind not in (RUN, SIMULATE)}
for group, name in ((RUN, "run"), (SIMULATE, "simulate")):
    COMMANDS |= {f"{name} {each}": kind for each, kind in group.kinds.items()}


def help_of(command, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    with pytest.raises(SystemExit) as ended:
        main([*command.split(), "--help"])
    assert ended.value.code == 0
    return capsys.readouterr().out


def test_its_version_and_every_command_are_named(capsys, monkeypatch):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"rbpf {__version__}\n"
    text = help_of("", capsys, monkeypatch)
    named = set(re.search(r"\{([\w,-]+)\}", text)[1].split(","))
    assert named == {command.split()[0] for command in COMMANDS}
    assert "0 success" in text and "130 stopped" in text


def test_the_examples_of_the_help_are_commands(capsys, monkeypatch):
    lines = (help_of("", capsys, monkeypatch) + help_of("run", capsys, monkeypatch)).replace("│", " ").splitlines()
    shown = [re.sub(r"^ *\w+( it)?: +", "", line) for line in lines if re.match(r" +(\w+( it)?: +)?rbpf [a-z]", line)]
    examples = [words.split() for line in shown for words in line.split(";") if words.split()[0] == "rbpf"]
    assert len(examples) >= 16
    called = list[object]()
    for kind in COMMANDS.values():
        monkeypatch.setattr(kind, "__call__", lambda self: called.append(self))
    for _, *words in examples:
        APP.call(words, "rbpf")
    assert len(called) == len(examples)


@pytest.mark.parametrize("command", COMMANDS)
def test_help_says_what_each_option_is(command, capsys, monkeypatch):
    text = " ".join(help_of(command, capsys, monkeypatch).replace("│", " ").split())
    for item in fields(COMMANDS[command]):
        group = is_dataclass(item.default)
        assert not group or f"{item.name} options" in text
        for option in fields(item.default) if group else [item] if item.default is not MISSING else []:
            assert re.search(rf"--{option.name.replace('_', '-')}\b,? (\S+ ){{3}}", text), option.name


ASKS = {
    "bash": 'source {0}; COMP_WORDS=(rbpf cali); COMP_CWORD=1; F=$(complete -p rbpf | sed "s/.*-F //; s/ .*//"); '
    '$F; printf "%s\\n" "${{COMPREPLY[@]}}"',
    "zsh": "autoload -U compinit; compinit -u -D; source {0}; print ${{_comps[rbpf]}}",
    "fish": 'source {0}; complete -C "rbpf cali"',
}
"""What completes `rbpf cali`; zsh only tells that something does, its completion wants a terminal."""


@pytest.mark.parametrize("shell", ASKS)
def test_shells_complete_commands(tmp_path, capsys, shell):
    assert main(["completion", shell]) == 0
    script = tmp_path / "completion"
    script.write_text(capsys.readouterr().out)
    assert "calibrate" in script.read_text()
    if (program := shutil.which(shell)) is None:
        pytest.skip(f"{shell} is not installed")
    ask = [program, *(["-f"] if shell == "zsh" else []), "-c", ASKS[shell].format(script)]
    found = subprocess.run(ask, capture_output=True, text=True, check=False, env=os.environ | {"HOME": str(tmp_path)})
    assert {"calibrate", "_tyro_rbpf"} & set(found.stdout.split()), found.stderr
