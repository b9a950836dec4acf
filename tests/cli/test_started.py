"""The ways in which the program is started, and read."""

import subprocess
import sys

from rbpf import __version__
from rbpf.cli import main


def test_its_version(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"rbpf {__version__}\n"


def test_python_m():
    done = subprocess.run([sys.executable, "-m", "rbpf", "--version"], capture_output=True, text=True, check=True)
    assert done.stdout == f"rbpf {__version__}\n"


def test_a_broken_pipe_ends_quietly():
    command = [sys.executable, "-m", "rbpf", "completion", "bash"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdout.close()
        error = process.stderr.read().decode()
    assert process.returncode == 0 and error == ""
