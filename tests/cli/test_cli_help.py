"""The help of every command, and what shells complete."""

import os
import re
import shutil
import subprocess
from dataclasses import MISSING, fields

import pytest

from rbpf.cli import APP, main
from rbpf.cli.running import RUN
from rbpf.cli.simulating import SIMULATE

pytestmark = pytest.mark.slow


COMMANDS = {name: kind for name, kind in APP.kinds.items() if kind not in (RUN, SIMULATE)}
for group, name in ((RUN, "run"), (SIMULATE, "simulate")):
    COMMANDS |= {f"{name} {each}": kind for each, kind in group.kinds.items()}


def help_of(command, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    with pytest.raises(SystemExit) as ended:
        main([*command.split(), "--help"])
    assert ended.value.code == 0
    return capsys.readouterr().out


def test_every_command_is_named(capsys, monkeypatch):
    text = help_of("", capsys, monkeypatch)
    named = set(re.search(r"\{([\w,-]+)\}", text)[1].split(","))
    assert named == {command.split()[0] for command in COMMANDS}
    assert "0 success" in text and "130 stopped" in text


@pytest.mark.parametrize("command", COMMANDS)
def test_help_says_what_each_option_is(command, capsys, monkeypatch):
    text = " ".join(help_of(command, capsys, monkeypatch).replace("│", " ").split())
    for item in fields(COMMANDS[command]):
        if item.default is not MISSING:
            assert re.search(rf"--{item.name.replace('_', '-')}\b,? (\S+ ){{3}}", text), item.name


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
    program = shutil.which(shell)
    if program is None:
        pytest.skip(f"{shell} is not installed")
    ask = [program, *(["-f"] if shell == "zsh" else []), "-c", ASKS[shell].format(script)]
    found = subprocess.run(ask, capture_output=True, text=True, check=False, env=os.environ | {"HOME": str(tmp_path)})
    assert {"calibrate", "_tyro_rbpf"} & set(found.stdout.split()), found.stderr
