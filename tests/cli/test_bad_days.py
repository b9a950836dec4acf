"""Full disks, killed runs, damaged files: one sentence, no traceback, and nothing finished is lost."""

import json

import numpy as np
import pytest

from examples.studies.file_faults import FILE_FAULTS, damaged_copy
from rbpf.cli import main
from rbpf.runs.recordings import RobotRecording, filter_opened, filter_recording, open_mono, open_pairs
from rbpf.sensors.camera import RectifiedStereo
from rbpf.sensors.readers import open_images, open_stereo
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.range_bearing.config import RangeBearingConfig
from rbpf.systems.stereo.config import StereoConfig
from rbpf.validation.simulation.desk_and_room import TexturedDesk
from rbpf.validation.simulation.images import Imaging, simulate_images
from rbpf.validation.simulation.robot import RobotWorld, simulate_robot
from tests.cli.sequences import CAMERA, FRAMES, full_disk, sentence

pytestmark = pytest.mark.slow

ONE_IMAGE = {"an image truncated"}
"""The damage that a run survives."""


@pytest.fixture(scope="module")
def desk(tmp_path_factory):
    """Pairs of images; the monocular system takes the left ones."""
    folder = tmp_path_factory.mktemp("rendered") / "desk"
    world = TexturedDesk(frames=FRAMES, texel_m=0.003)
    simulate_images(world, Imaging(noise_std=1.0), RectifiedStereo(CAMERA, 0.12), folder, seed=1)
    return folder


def command(desk, out, *more):
    known = ["--known-points", str(desk / "known_points.csv"), "--particles", "8", "--no-video", "--no-batch"]
    return ["run", "mono", str(desk), *known, "--out", str(out), *more]


@pytest.mark.parametrize("name", sorted(FILE_FAULTS))
def test_damaged_files(desk, tmp_path, capsys, name):
    copy = damaged_copy(desk, FILE_FAULTS[name], tmp_path / "copy")
    code = main(command(copy, tmp_path / "run"))
    if name in ONE_IMAGE:
        entries = json.loads((tmp_path / "run" / "summary.json").read_text())
        assert code == 0 and entries["frames_tracked"] == FRAMES and "frame 8" in entries["problems"][0]
    else:
        assert code == 2 and str(copy) in sentence(capsys)
        assert not (tmp_path / "run" / "summary.json").exists()


@pytest.mark.parametrize("most_bytes", [500, 20_000, 60_000])
def test_results_on_a_full_disk(desk, tmp_path, capsys, most_bytes):
    """What is there afterwards is whole; with room again the run goes on from what there was."""
    out = tmp_path / "run"
    with full_disk(most_bytes):
        assert main(command(desk, out)) == 2
    assert "cannot be written: File too large" in sentence(capsys)
    assert not list(out.glob("*.partial*"))
    for path in out.glob("*.npz"):
        np.load(path).close()
    assert main(command(desk, out, "--resume")) == 0
    assert json.loads((out / "summary.json").read_text())["frames"] == FRAMES


def test_no_room_for_checkpoints(desk, tmp_path):
    """The runs go on to the end and say it; the old checkpoint stays."""
    place = tmp_path / "run" / "checkpoint.npz"
    place.parent.mkdir()
    simulate_robot(RobotWorld(steps=FRAMES, landmarks=10), tmp_path / "log", seed=0)
    mono, stereo = MonoConfig(particles=8, checkpoint_every=5), StereoConfig(particles=20, checkpoint_every=5)
    robot = RangeBearingConfig(particles=5, checkpoint_every=5)
    runs = {
        "mono": lambda: filter_opened(open_mono(open_images(desk), mono), checkpoint=place),
        "stereo": lambda: filter_opened(open_pairs(open_stereo(desk), stereo), checkpoint=place),
        "range-bearing": lambda: filter_recording(RobotRecording(tmp_path / "log"), robot, place.parent),
    }
    for run in runs.values():
        run()  # compiles what is not yet, which needs room as well
        place.write_bytes(b"the last one")
        with full_disk(1000):
            done = run()
        assert len(done.log) == FRAMES and done.failure is None
        assert sum("no checkpoint is kept" in words and "File too large" in words for words in done.messages) == 4
        assert place.read_bytes() == b"the last one"
        assert [path.name for path in place.parent.iterdir()] == ["checkpoint.npz"]


def test_a_stereo_run_is_finished_once(desk, tmp_path, monkeypatch):
    """Killed while it draws, it does not measure a single pair again."""
    out = tmp_path / "run"
    arguments = ["run", "stereo", str(desk), "--particles", "20", "--out", str(out)]
    assert main(arguments) == 0
    first = (out / "trajectory.tum").read_bytes()
    (out / "trajectory.tum").unlink()
    monkeypatch.setattr("rbpf.systems.stereo.slam.StereoSlam.take", None)
    assert main([*arguments, "--resume"]) == 0
    assert (out / "trajectory.tum").read_bytes() == first
