"""What the command line writes on the terminal, and what it says of words that it does not know."""

import os
import subprocess
import sys

import pytest

from rbpf import __version__
from rbpf.cli import main
from rbpf.cli.showing import progress


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("run mono --particle-count", "`rbpf run mono` has no option --particle-count: did you mean --particles?"),
        ("run mono x --known_pints=a", "has no option --known-pints: did you mean --known-points?"),
        ("run stereo x --no-vdeo", "did you mean --no-video?"),
        ("export x --xyz", "`rbpf export` has no option --xyz: there are --help, --json, --format, --out"),
    ],
)
def test_an_option_that_there_is_not_is_named(words, said, capsys):
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
    assert "filtering" in said and "1/2" in said and "waiting" not in said
    assert tell is not None


def test_ctrl_c_before_anything_is_done_is_said(monkeypatch, capsys):
    def stopped(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("rbpf.cli.repeated", stopped)
    assert main(["report", "x"]) == 130
    assert capsys.readouterr().err == "rbpf: stopped\n"


def test_only_a_run_that_fails_is_told_of_resume(monkeypatch, capsys):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("rbpf.cli.repeated", full)
    assert main(["simulate", "desk", "--out", "x"]) == 2
    assert capsys.readouterr().err == "rbpf: [Errno 28] No space left on device\n"
    assert main(["run", "mono", "x"]) == 2
    assert "--resume goes on" in capsys.readouterr().err


def test_no_threads_at_all_are_refused():
    """In a process of its own: Numba cannot even be imported with them."""
    environment = {**os.environ, "NUMBA_NUM_THREADS": "0"}
    words = [sys.executable, "-m", "rbpf", "report", "x"]
    done = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr == "rbpf: the environment's NUMBA_NUM_THREADS must be a whole number from 1 up, got '0'\n"


@pytest.mark.slow
def test_a_closed_standard_output_is_refused_where_a_result_is_wanted_there(tmp_path):
    words = f"'{sys.executable}' -m rbpf report '{tmp_path}'"
    found = subprocess.run(f"{words} --json >&-", shell=True, stderr=subprocess.PIPE, text=True)
    assert (found.returncode, found.stderr) == (2, "rbpf: standard output is closed: --json has nowhere to write to\n")


def test_its_version(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"rbpf {__version__}\n"


def test_a_broken_pipe_ends_quietly():
    command = [sys.executable, "-m", "rbpf", "completion", "bash"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdout.close()
        error = process.stderr.read().decode()
    assert process.returncode == 0 and error == ""
