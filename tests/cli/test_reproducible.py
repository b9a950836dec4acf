"""The same seed gives the same bytes, whatever the number of threads, and again from a run's own config.yaml."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from rbpf.cli import main
from rbpf.sensors.camera import Pinhole, RectifiedStereo
from rbpf.validation.simulation.desk_and_room import TexturedDesk, TexturedRoom
from rbpf.validation.simulation.images import Imaging, simulate_images
from rbpf.validation.simulation.robot import RobotWorld, simulate_robot
from tests.cli.run_outputs import outputs

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
CAMERA = Pinhole(320, 240, 250.0, 250.0, 159.5, 119.5)


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    """Arguments by system; enough particles that the kernels do run on several threads."""
    folder = tmp_path_factory.mktemp("rendered")
    imaging = Imaging(noise_std=1.0)
    simulate_images(TexturedDesk(frames=5, texel_m=0.003), imaging, CAMERA, folder / "desk", seed=1)
    rig = RectifiedStereo(CAMERA, 0.12)
    simulate_images(TexturedRoom(frames=5, rate_hz=5.0), Imaging(known=0), rig, folder / "room", seed=1)
    simulate_robot(RobotWorld(20, 40), folder / "log", 0)
    desk = folder / "desk"
    known = ["--known-points", str(desk / "known_points.csv")]
    return {
        "mono": [str(desk), *known, "--particles", "900", "--no-batch"],
        "range-bearing": [str(folder / "log"), "--particles", "3000", "--no-batch"],
        "stereo": [str(folder / "room"), "--particles", "600", "--no-video", "--no-batch"],
    }


RUN_ALL = """
import json, sys
import pytest
from tests.conftest import paint_plainly
from rbpf.cli import main
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
