"""The command line from end to end, on small simulated logs."""

import json
import os
import shutil
from dataclasses import replace

import numpy as np
import pytest

from rbpf.cli import main
from rbpf.core.checkpoint import save_arrays
from rbpf.errors import InputError
from rbpf.lie import SE2
from rbpf.runs.files import numbered, own_folder, write_text
from rbpf.runs.folder import RESULTS, remove_results
from rbpf.runs.reading import RunFolder
from rbpf.runs.recordings import RobotRecording, part_of_log
from rbpf.sensors.readers import Part, open_log
from rbpf.systems.range_bearing.config import RangeBearingConfig
from rbpf.validation.simulation.robot import RobotWorld, simulate_robot, simulated_log
from tests.cli.run_outputs import FILES, REQUIRED, STEPS, layout, names, outputs
from tests.cli.sequences import sentence

OWN_FILES = {"odometry.tum", "observations_odometry.csv", "ess.png", "groundtruth_landmarks.png", "groundtruth_map.png"}
OWN_ENTRIES = {
    "landmarks", "resamplings", "ess_mean", "log_evidence", "path_rmse_m", "landmark_error_mean_m",
    "landmark_error_aligned_mean_m",
}  # fmt: skip


def run(log, out, *arguments):
    return main(["run", "range-bearing", str(log), "--out", str(out), "--particles", "30", "--no-batch", *arguments])


@pytest.fixture(scope="module")
def began(log, tmp_path_factory):
    """The folder of a run; not to be written to."""
    out = tmp_path_factory.mktemp("began") / "run"
    assert run(log, out) == 0
    return out


def test_a_run_leaves_everything(began):
    assert names(began) == FILES | OWN_FILES
    assert (summary := json.loads((began / "summary.json").read_text())).keys() >= REQUIRED | OWN_ENTRIES
    assert (summary["frames"], summary["particles"], summary["seed"]) == (STEPS, 30, 0)
    assert summary["path_rmse_m"] < summary["odometry_path_rmse_m"]
    assert set(summary["ms_per_frame"]) == {"median", "p95"}
    with np.load(began / "map.npz") as archive:
        assert archive["mean"].shape == (summary["landmarks"], 2)
        assert (np.linalg.eigvalsh(archive["cov"]) > 0).all()


@pytest.mark.slow
def test_a_robot_s_run_is_recorded_for_the_viewer(log, tmp_path):
    assert run(log, tmp_path / "run", "--rerun", str(tmp_path / "run.rrd")) == 0
    views, eye, target = layout(tmp_path / "run.rrd")
    assert views == {"path and map", "effective sample size", "NIS per degree of freedom"} and eye[2] > target[2]


@pytest.mark.slow
@pytest.mark.parametrize("association", ["known", "ml"])
def test_a_resumed_run_is_identical(log, tmp_path, association, monkeypatch):
    arguments = ("--association", association, "--set", "checkpoint_every=5")
    assert run(log, tmp_path / "whole", *arguments) == 0
    from rbpf.core.filter import Filter

    step = Filter.step

    def interrupted(self, *args, **kwargs):
        if self.steps == 13:
            raise KeyboardInterrupt
        return step(self, *args, **kwargs)

    monkeypatch.setattr(Filter, "step", interrupted)
    assert run(log, tmp_path / "cut", *arguments) == 130
    monkeypatch.setattr(Filter, "step", step)
    assert not (tmp_path / "cut" / "summary.json").exists()
    assert run(log, tmp_path / "cut", *arguments, "--resume") == 0
    assert outputs(tmp_path / "whole") == outputs(tmp_path / "cut")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--set", "nothing=1"], "no setting nothing"),
        (["--set", "particles"], "key=value"),
        (["--set", "window=0"], "window must be"),
        (["--threads", "0"], "--threads"),
        (["--config", "missing.yaml"], "missing.yaml"),
    ],
)
def test_bad_settings_are_one_sentence(log, tmp_path, capsys, arguments, message):
    assert run(log, tmp_path / "run", *arguments) == 2
    assert message in sentence(capsys)
    assert not list((tmp_path / "run").glob("*"))


def cut(_log, out):
    checkpoint = out / "checkpoint.npz"
    checkpoint.write_bytes(checkpoint.read_bytes()[:-500])


def changed(log, _out):
    """The same stamps, another content."""
    table = (log / "observations.csv").read_text().splitlines()
    cells = table[-1].split(",")
    table[-1] = ",".join([*cells[:2], "4.25", *cells[3:]])
    (log / "observations.csv").write_text("\n".join(table) + "\n")


@pytest.mark.parametrize(
    ("spoil", "options", "message"),
    [
        (cut, [], "checkpoint.npz is damaged or cut off"),
        (changed, [], "recording = content of SHA-256 "),
        (None, ["--seed", "5"], "seed = 0, this one has 5"),
        (None, ["--set", "noise.std_range_m=5"], "noise.std_range_m = null, this one has 5.0"),
    ],
)
def test_a_run_goes_on_with_what_it_began_with(began, log, tmp_path, capsys, spoil, options, message):
    out, recording = (shutil.copytree(folder, tmp_path / folder.name) for folder in (began, log))
    if spoil is not None:
        spoil(recording, out)
    before = outputs(out)
    assert run(recording, out, *options, "--resume") == 2
    assert message in " ".join(capsys.readouterr().err.split())
    assert outputs(out) == before


def test_a_run_goes_on_with_what_cannot_change_its_results(began, log, tmp_path):
    """Other checkpoints, other threads, another place of the same recording, another run in it."""
    shutil.copytree(began, tmp_path / "run")
    shutil.copytree(log, tmp_path / "moved")
    shutil.copytree(began, tmp_path / "moved" / "run-2")
    changed = ["--set", "checkpoint_every=7", "--threads", "1", "--resume"]
    assert run(tmp_path / "moved", tmp_path / "run", *changed) == 0
    for name in ("trajectory.tum", "map.csv", "diagnostics.csv"):
        assert (tmp_path / "run" / name).read_bytes() == (began / name).read_bytes()


def test_a_run_is_written_over_only_where_that_is_asked_for(began, log, tmp_path, capsys):
    """Nothing that the earlier run left is there then, but what it did not write, and inputs."""
    out = shutil.copytree(began, tmp_path / "run")
    for name in {*RESULTS, "validation_path.json", "path_xy.png", "notes.txt"} - {path.name for path in out.iterdir()}:
        (out / name).touch()
    before = outputs(out)
    for arguments, message in (
        (("--seed", "9"), "holds a run already"),
        (("--resume", "--overwrite"), "leave out one of"),
    ):
        assert run(log, out, *arguments) == 2 and message in " ".join(capsys.readouterr().err.split())
    assert outputs(out) == before and run(log, out, "--seed", "9", "--overwrite") == 0
    assert names(out) == names(began) | {"notes.txt"} and outputs(out) != before
    remove_results(out, [out / "map.csv"])
    assert {path.name for path in out.iterdir()} == {"checkpoint.npz", "notes.txt", "map.csv"}


def test_only_runs_of_one_camera_are_recalibrated(began, tmp_path, capsys):
    for folder, words in (
        (tmp_path, "expected the folder that a finished `rbpf run` left"),
        (began, "no run of one camera"),
    ):
        assert main(["recalibrate", str(folder), "--out", str(tmp_path / "out")]) == 2
        assert words in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "out").exists()


def test_folders_of_runs_are_numbered(tmp_path):
    for name in ("run", "run-2", "run-3"):
        assert numbered(tmp_path / "run") == tmp_path / name
        (tmp_path / name).mkdir()
        (tmp_path / name / "checkpoint.npz").touch()
        assert numbered(tmp_path / "run", last=True) == tmp_path / name
    assert numbered(tmp_path / "other", last=True) == tmp_path / "other"


def test_one_run_at_a_time_writes_to_a_folder_and_the_lock_of_a_killed_one_is_taken_over(log, tmp_path, capsys):
    with own_folder(tmp_path / "run"):
        assert run(log, tmp_path / "run") == 2
        assert f"another run, process {os.getpid()}, writes to" in " ".join(capsys.readouterr().err.split())
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / ".lock").write_text("1\n")
    with own_folder(tmp_path / "run"):
        assert (tmp_path / "run" / ".lock").read_text() == f"{os.getpid()}\n"
    assert list((tmp_path / "run").iterdir()) == []


def test_a_folder_that_cannot_be_written_to_is_noticed_before_filtering(log, monkeypatch, capsys):
    monkeypatch.setattr("rbpf.systems.range_bearing.slam.RangeBearingSlam.take", None)
    assert run(log, "/proc/self") == 2
    assert "/proc/self cannot be written to" in " ".join(capsys.readouterr().err.split())


def test_an_empty_name_is_refused(log, capsys):
    for words in (["--out", ""], ["--out="]):
        assert main(["run", "range-bearing", str(log), *words]) == 2
        assert "--out is empty" in capsys.readouterr().err


@pytest.mark.parametrize("write", [write_text, lambda path, _: save_arrays(path, {"a": np.zeros(1)})])
def test_a_link_under_a_temporary_name_is_not_followed(tmp_path, write):
    victim = tmp_path / "victim"
    victim.write_text("mine")
    for name in ("map.partial.npz", "map.npz.partial"):
        (tmp_path / name).symlink_to(victim)
    write(tmp_path / "map.npz", "text")
    assert victim.read_text() == "mine" and (tmp_path / "map.npz").is_file()


@pytest.fixture
def unnamed(tmp_path):
    simulate_robot(RobotWorld(12, 10, unnamed=True), tmp_path / "log", 0)
    return tmp_path / "log"


@pytest.mark.parametrize("column", [True, False])
def test_unnamed_observations_are_those_of_the_named_log(unnamed, tmp_path, column):
    simulate_robot(RobotWorld(12, 10), tmp_path / "named", 0)
    if not column:
        table = unnamed / "observations.csv"
        rows = [line.split(",") for line in table.read_text().splitlines()]
        table.write_text("".join(",".join([row[0], *row[2:]]) + "\n" for row in rows))
    for frame, named in zip(open_log(unnamed).frames, open_log(tmp_path / "named").frames, strict=True):
        assert (frame.landmarks == -1).all() and frame.landmarks.size == named.landmarks.size
        np.testing.assert_array_equal(frame.z, named.z)


def test_names_are_needed_where_the_association_is_known(unnamed):
    with pytest.raises(InputError, match="without a landmark's name: filter it with --association ml"):
        RobotRecording(unnamed).open(RangeBearingConfig())


@pytest.mark.slow
def test_an_unnamed_log_is_filtered(tmp_path):
    words = ["--steps", "12", "--landmarks", "10", "--unnamed"]
    assert main(["simulate", "range-bearing", "--out", str(tmp_path / "log"), *words]) == 0
    assert run(tmp_path / "log", tmp_path / "run", "--association", "ml") == 0
    found = RunFolder.open(tmp_path / "run")
    assert found.summary["landmarks"] == len(found.map.mean) > 3


# Part of a robot's log: fewer frames, with the odometry between them composed.


WORLD = RobotWorld(12, 20, std_translation_m=0.2, std_rotation_deg=10.0)


@pytest.mark.parametrize("timed", [False, True], ids=["steps", "seconds"])
def test_odometry_is_composed_with_its_covariance(timed):
    """Against draws of each motion's noise."""
    log = simulated_log(WORLD, 0)
    if timed:
        frames = [replace(frame, stamp_ns=5 * 10**9 + frame.stamp_ns * 10**9) for frame in log.frames]
        log = replace(log, frames=frames)
    part = part_of_log(log, Part(2.0, 10.0, 3))
    assert [frame.stamp_ns for frame in part.frames] == [log.frames[t].stamp_ns for t in (2, 5, 8)]
    assert part.frames[0].delta is None and part.frames[0].cov_delta is None
    rng = np.random.default_rng(0)
    for number, last in ((1, 5), (2, 8)):
        np.testing.assert_array_equal(part.frames[number].z, log.frames[last].z)
        exact, noisy = SE2.identity(), SE2.identity()
        for frame in log.frames[last - 2 : last + 1]:
            exact = SE2.compose(exact, frame.delta)
            noise = rng.multivariate_normal(np.zeros(3), 1e-4 * frame.cov_delta, 100_000)
            noisy = SE2.compose(noisy, SE2.retract(frame.delta, noise))
        np.testing.assert_allclose(part.frames[number].delta, exact, atol=1e-12)
        cov = np.cov(SE2.local(exact, noisy).T) / 1e-4
        np.testing.assert_allclose(part.frames[number].cov_delta, cov, atol=0.02 * np.abs(cov).max())


def test_nothing_left():
    with pytest.raises(InputError, match="no frame is left from 12 steps on: the recording is 11 steps long"):
        part_of_log(simulated_log(WORLD, 0), Part(12.0))


@pytest.mark.slow
def test_a_part_is_run_repeated_and_compared(tmp_path, capsys):
    simulate_robot(RobotWorld(12, 20), tmp_path / "log", 0)
    words = ["run", "range-bearing", str(tmp_path / "log"), "--particles", "5", "--no-batch", "--out"]
    assert main([*words, str(tmp_path / "part"), "--start", "2", "--every", "3"]) == 0
    assert main(["run", "--from", str(tmp_path / "part" / "config.yaml"), "--out", str(tmp_path / "again")]) == 0
    assert main([*words, str(tmp_path / "whole")]) == 0
    once, again = (RunFolder.open(tmp_path / name).path.world_from_body for name in ("part", "again"))
    assert len(once) == 4
    np.testing.assert_array_equal(once, again)
    capsys.readouterr()
    assert main(["compare", str(tmp_path / "part"), str(tmp_path / "whole"), "--seeds", "2"]) == 2
    assert "or parts of one" in capsys.readouterr().err.replace("\n", " ")
