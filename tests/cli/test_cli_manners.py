"""What every command owes to people and to programs: JSON, exit codes, the same run again, on any number of threads."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

from rbpf.cli import main
from rbpf.cli.compiling import cached, compile_kernels, kernel_modules
from rbpf.runs.provenance import instruction_set
from rbpf.sensors.camera import Pinhole, RectifiedStereo
from rbpf.validation.simulation.desk_and_room import TexturedDesk, TexturedRoom
from rbpf.validation.simulation.images import Imaging, simulate_images
from rbpf.validation.simulation.robot import RobotWorld, simulate_robot
from tests.cli.run_outputs import outputs

pytestmark = pytest.mark.slow


def quick(log, out, *arguments):
    """Arguments of a short run."""
    return ["run", "range-bearing", str(log), "--out", str(out), "--particles", "20", "--no-batch", *arguments]


def test_json_is_one_object_on_standard_output(log, tmp_path, capsys):
    assert main(quick(log, tmp_path / "run", "--json")) == 0
    out, _ = capsys.readouterr()
    entries = json.loads(out)
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary.items() <= entries.items()
    for command in (
        ["validate", str(tmp_path / "run")],
        ["report", str(tmp_path / "run")],
        ["export", str(tmp_path / "run"), "--format", "tum"],
        ["simulate", "range-bearing", "--out", str(tmp_path / "log"), "--steps", "3"],
        ["doctor", "--no-compile"],
    ):
        assert main([*command, "--json"]) == 0
        assert isinstance(json.loads(capsys.readouterr().out), dict), command


def test_without_json_nothing_is_on_standard_output(log, tmp_path, capsys):
    assert main(quick(log, tmp_path / "run")) == 0
    out, err = capsys.readouterr()
    assert out == "" and "report.html" in err
    assert "one Gaussian (map=joint)" in err and "rust its uncertainty: " in err


def test_bad_input_is_exit_code_2_and_a_fault_is_1(tmp_path):
    def code(*arguments, prelude=""):
        return subprocess.run([sys.executable, "-c", f"{prelude}\n{_MAIN}", *arguments], capture_output=True, text=True)

    refused = code("report", str(tmp_path / "nothing"))
    assert refused.returncode == 2 and refused.stderr.count("\n") == 1 and "Traceback" not in refused.stderr
    prelude = "import rbpf.validation.report.page as r; r.write_report = lambda folder: 1 / 0"
    broken = code("report", "x", prelude=prelude)
    assert broken.returncode == 1 and "ZeroDivisionError" in broken.stderr


_MAIN = "import sys; from rbpf.cli import main; sys.exit(main())"


def test_a_run_is_repeated_from_its_config(log, tmp_path, capsys):
    assert main(quick(log, tmp_path / "a", "--seed", "4", "--set", "resampling.scheme=residual")) == 0
    config = tmp_path / "a" / "config.yaml"
    entries = yaml.safe_load(config.read_text())
    assert entries["versions"]["numpy"] == np.__version__ and len(entries["input_sha256"]) == 64
    assert entries["versions"]["instructions"] == instruction_set() and instruction_set()
    assert entries["batch"] is False and entries["resampling"]["scheme"] == "residual"
    again = ["run", "--from", str(config)]
    assert main([*again, "--out", str(tmp_path / "b")]) == 0
    assert outputs(tmp_path / "a") == outputs(tmp_path / "b")
    assert main(again) == 0
    assert outputs(tmp_path / "a") == outputs(tmp_path / "a-again")
    assert not (tmp_path / "a-again" / "batch.tum").exists()
    assert main([*again, "--batch"]) == 0
    assert (tmp_path / "a-again-2" / "batch.tum").exists()
    capsys.readouterr()
    path = next(log.glob("observations.csv"))
    before = path.read_text()
    path.write_text(before.rstrip("\n") + "\n\n")
    try:
        assert main(again) == 2
        assert "has changed since the run" in " ".join(capsys.readouterr().err.split())
    finally:
        path.write_text(before)
    assert main(["run", "--from"]) == 2
    assert main(["run", "--from", str(tmp_path / "nothing" / "config.yaml")]) == 2


def test_the_doctor_finds_everything_here_and_what_is_missing(capsys, monkeypatch):
    assert main(["doctor", "--json"]) == 0
    entries = json.loads(capsys.readouterr().out)
    assert entries["works"] and not entries["kernels_missing"]
    assert entries["python"] == sys.version.split()[0] and entries["libraries"]["numpy"] == np.__version__
    assert all(cached(module) for module in kernel_modules())
    assert compile_kernels() == []
    assert main(["doctor", "--no-compile"]) == 0
    said = capsys.readouterr().err.splitlines()
    assert said[0].startswith("all that every run needs works") and said[-1] == "to begin: rbpf demo"
    monkeypatch.setitem(sys.modules, "gtsam", None)
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert main(["doctor", "--no-compile", "--json"]) == 2
    out, err = capsys.readouterr()
    parts = {part["name"]: part for part in json.loads(out)["parts"]}
    assert not parts["batch optimum"]["works"] and parts["images and video"]["works"]
    assert "rbpf[viewing]" in parts["Rerun recordings"]["says"]
    assert "batch optimum: needed, and broken here" in err


def test_the_first_compilation_is_announced_before_it_begins(log, tmp_path):
    """In an empty cache, by a process that ends with its first word."""
    cache = tmp_path / "cache"
    program = (
        f"import os, rbpf.cli.compiling as c; c.say = lambda words: (print(words, flush=True), os._exit(0))\n{_MAIN}"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, *quick(log, tmp_path / "run")],
        capture_output=True, text=True, check=True, env={**os.environ, "NUMBA_CACHE_DIR": str(cache)},
    )  # fmt: skip
    assert "compiling" in done.stdout and "done once" in done.stdout
    assert not list(cache.rglob("*.nb?"))


ROOT = Path(__file__).resolve().parents[2]
CAMERA = Pinhole(320, 240, 250.0, 250.0, 159.5, 119.5)


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    """Arguments by system; enough particles that the kernels do run on several threads."""
    folder = tmp_path_factory.mktemp("rendered")
    simulate_images(TexturedDesk(frames=4, texel_m=0.003), Imaging(noise_std=1.0), CAMERA, folder / "desk", seed=1)
    rig = RectifiedStereo(CAMERA, 0.12)
    simulate_images(TexturedRoom(frames=4, rate_hz=5.0), Imaging(known=0), rig, folder / "room", seed=1)
    simulate_robot(RobotWorld(20, 40), folder / "log", 0)
    desk = folder / "desk"
    known = ["--known-points", str(desk / "known_points.csv")]
    return {
        "mono": [str(desk), *known, "--particles", "900", "--no-video", "--no-batch"],
        "range-bearing": [str(folder / "log"), "--particles", "3000", "--no-batch"],
        "stereo": [str(folder / "room"), "--particles", "600", "--no-video", "--no-batch"],
    }


RUN_ALL = """
import json, sys
from rbpf.cli import main
import pytest
from tests.conftest import paint_plainly
paint_plainly(pytest.MonkeyPatch())
sys.exit(max(main(words) for words in json.loads(sys.argv[1])))
"""


@pytest.fixture(scope="module")
def threaded(recordings, tmp_path_factory):
    """What the systems left on one thread and on two, each in a process of its own."""
    folder = tmp_path_factory.mktemp("threaded")
    for threads in ("1", "2"):
        libraries = {f"{name}_NUM_THREADS": threads for name in ("OPENBLAS", "OMP", "MKL")}
        environment = {**os.environ, **libraries, "NUMBA_NUM_THREADS": "2", "RBPF_SHAPES": "0"}
        words = [
            ["run", system, *recording, "--threads", threads, "--out", str(folder / threads / system)]
            for system, recording in recordings.items()
        ]
        command = [sys.executable, "-c", RUN_ALL, json.dumps(words)]
        subprocess.run(command, check=True, env=environment, capture_output=True, cwd=ROOT)
    return folder


@pytest.mark.parametrize("system", ["mono", "range-bearing", "stereo"])
def test_threads_change_no_byte(threaded, system):
    one, two = outputs(threaded / "1" / system), outputs(threaded / "2" / system)
    assert one.keys() == two.keys()
    assert [name for name in one if one[name] != two[name]] == []


def test_a_run_over_pairs_is_repeated_from_its_config(recordings, tmp_path):
    """Of the other systems tests/cli/test_cli_manners.py and test_cli_localise.py tell it."""
    assert main(["run", "stereo", *recordings["stereo"], "--seed", "7", "--out", str(tmp_path / "a")]) == 0
    assert main(["run", "--from", str(tmp_path / "a" / "config.yaml"), "--out", str(tmp_path / "b")]) == 0
    assert not (tmp_path / "b" / "annotated.mp4").exists()
    assert outputs(tmp_path / "a") == outputs(tmp_path / "b")
