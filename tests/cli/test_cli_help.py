"""What the help of every command says, and what shells complete."""

import os
import re
import shutil
import subprocess
from dataclasses import MISSING, fields

import pytest

from rbpf.cli import DemoOptions, main
from rbpf.cli.cameras import CalibrateOptions, RecalibrateOptions
from rbpf.cli.installed import DoctorOptions
from rbpf.cli.judging import CompareOptions, ExportOptions, ReportOptions, SweepOptions, ValidateOptions
from rbpf.cli.options import ImagesOptions, LabOptions, LogOptions, MonoOptions, RangeBearingOptions, StereoOptions
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.range_bearing.config import RangeBearingConfig
from rbpf.systems.stereo.config import StereoConfig

pytestmark = pytest.mark.slow

COMMANDS = {
    "demo": DemoOptions,
    "run range-bearing": RangeBearingOptions,
    "run mono": MonoOptions,
    "run stereo": StereoOptions,
    "simulate range-bearing": LogOptions,
    "simulate desk": ImagesOptions,
    "simulate room": ImagesOptions,
    "simulate lab": LabOptions,
    "calibrate": CalibrateOptions,
    "recalibrate": RecalibrateOptions,
    "validate": ValidateOptions,
    "report": ReportOptions,
    "export": ExportOptions,
    "sweep": SweepOptions,
    "compare": CompareOptions,
    "doctor": DoctorOptions,
}
UNIT = re.compile(r"\b(px|m|s|seconds|fraction|rich|particles|grey levels|Hz)\b")


def help_of(command, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    with pytest.raises(SystemExit) as ended:
        main([*command.split(), "--help"])
    assert ended.value.code == 0
    return capsys.readouterr().out


def test_every_command_is_in_this_file(capsys, monkeypatch):
    text = help_of("", capsys, monkeypatch)
    named = set(re.search(r"\{([\w,-]+)\}", text)[1].split(","))
    assert named == {command.split()[0] for command in COMMANDS} | {"completion"}
    assert "0 success" in text and "130 stopped" in text


@pytest.mark.parametrize("command", COMMANDS)
def test_help_says_what_each_option_is_its_default_and_its_unit(command, capsys, monkeypatch):
    text = " ".join(help_of(command, capsys, monkeypatch).replace("│", " ").split())
    options = text[text.index("show this help") :]
    for item in fields(COMMANDS[command]):
        shown = f"--{item.name.replace('_', '-')}"
        end = r"\((?:default: [^)]*|required|repeatable)\)|(?= --\w)|$"
        found = re.search(rf"{shown}[ ,](.+?)(?:{end})", options.rstrip("╯╰─ "))
        if found is None:
            assert item.default is MISSING, f"{command} {shown} is not in its help"
            assert "(required)" in text
            continue
        assert len(found[1].split()) >= 3, f"{command} {shown} does not say what it is"
        assert " --" not in found[1].replace(" --no-", ""), f"{command} {shown} has no default"
        if item.default is None:
            assert "by default" in found[1] or "for none" in found[1], f"{command} {shown}: by default?"
        elif item.default != ():
            hint = "(required)" if item.default is MISSING else f"(default: {shown_default(item.default)})"
            assert hint in found[0], f"{command} {shown}: no default"
        if isinstance(item.default, float):
            assert UNIT.search(found[1]), f"{command} {shown} has no unit: {found[1]}"


def shown_default(value):
    """As the help shows it: several numbers have a blank between them."""
    return " ".join(map(str, value)) if isinstance(value, tuple) else str(value)


@pytest.mark.parametrize(
    ("command", "config"),
    [("run mono", MonoConfig()), ("run stereo", StereoConfig()), ("run range-bearing", RangeBearingConfig())],
)
def test_help_tells_the_defaults_of_the_system(command, config, capsys, monkeypatch):
    text = " ".join(help_of(command, capsys, monkeypatch).replace("│", " ").split())
    assert f"number of particles; by default {config.particles}, or as in --config" in text
    assert f"of the random generators; by default {config.seed}, or as in --config" in text
    if isinstance(config, StereoConfig):
        assert f"by default {config.dof}, or as in --config" in text
    if isinstance(config, RangeBearingConfig):
        assert f"by default {config.association}, or as in --config" in text


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
