"""Run folders: what a comparison and a report make of them, whole or spoilt; the page, and pictures that anybody may draw."""

import json
import re
import shutil
from base64 import b64decode
from dataclasses import asdict
from gzip import decompress

import numpy as np
import pytest
from matplotlib.figure import Figure
from plotly.graph_objects import Figure as Scene

import rbpf
from rbpf.cli import main
from rbpf.core.checkpoint import load_arrays, save_arrays
from rbpf.runs.plots import World
from rbpf.runs.provenance import command_of
from rbpf.runs.results import load
from rbpf.runs.truth import RunTruth, truth_at, write_truth
from rbpf.sensors.readers import Truth
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.range_bearing.config import RangeBearingConfig
from rbpf.systems.settings import defaults_of
from rbpf.validation.report.page import _images, digits, program, scene, write_report
from rbpf.validation.simulation.laser import LaserWorld, simulate_laser
from rbpf.validation.simulation.robot import RobotWorld, simulate_robot, simulated_log
from tests.cli.sequences import sentence

pytestmark = pytest.mark.usefixtures("plain_pictures")


@pytest.fixture(scope="module")
def finished(tmp_path_factory, plain_pictures):
    """A finished run."""
    folder = tmp_path_factory.mktemp("validated")
    simulate_robot(RobotWorld(steps=40, landmarks=30), folder / "log", seed=0)
    arguments = ["run", "range-bearing", str(folder / "log"), "--out", str(folder / "run"), "--particles", "60"]
    assert main(arguments) == 0
    return folder / "run"


@pytest.fixture
def run_folder(finished, tmp_path):
    """A copy that may be spoilt."""
    return shutil.copytree(finished, tmp_path / "run")


def page(folder) -> str:
    return (folder / "report.html").read_text(encoding="utf-8")


def test_a_finished_run_has_its_verdict_on_top(finished):
    text = page(finished)
    top = text[text.index('class="verdict') : text.index("<h2>")]
    assert top.count('class="verdict ') == 2 and "<b>Path: good</b>" in top and "<b>Uncertainty: " in top
    assert "from the truth" in top and "pictures are in the truth&#39;s world." in text
    assert text.count("data:image/png;base64,") >= 9
    assert "http" not in text.partition('id="plotly"')[0]  # nothing comes from a network
    assert json.loads((finished / "validation_groundtruth.json").read_text())["figures"]["steps_compared"] == 40
    summary = json.loads((finished / "summary.json").read_text())
    assert (finished / "batch.tum").exists() and summary["batch_ate_rmse_m"] < summary["odometry_ate_rmse_m"]


def test_gtsam_stands_beside(run_folder, tmp_path, capsys):
    assert main(["validate", str(run_folder), "--against", "gtsam", "--out", str(tmp_path / "json")]) == 0
    entries = json.loads((tmp_path / "json" / "validation_gtsam.json").read_text())
    assert entries == json.loads((run_folder / "validation_gtsam.json").read_text())
    apart = json.loads((run_folder / "summary.json").read_text())["filter_minus_batch_rmse_m"]
    assert entries["figures"]["filter_minus_batch_rmse_m"] == pytest.approx(apart, rel=1e-3)
    residuals = next(s for s in entries["statistics"] if s["name"].startswith("residuals"))
    assert 0.7 < residuals["value"] < 1.3
    figures = entries["figures"]
    assert figures["landmarks_count"] > 10 and 0.0 < figures["landmarks_kullback_leibler_median"] < 5.0
    assert 0.0 < figures["poses_kullback_leibler_median"] < 5.0 and figures["poses_count"] == 1
    assert 0.5 < figures["landmarks_sigma_ratio_median"] < 1.5
    assert figures["batch_log_likelihood"] > figures["filter_log_likelihood"] - 5.0
    summary = json.loads((run_folder / "summary.json").read_text())
    names = ("log_evidence_batch", "log_evidence_batch_error", "posterior_draws_ess")
    assert [figures[name] for name in names] == pytest.approx([summary[name] for name in names], abs=0.01)
    assert figures["log_evidence_batch_error"] < 0.1 and figures["posterior_draws_ess"] > 150.0
    assert figures["log_evidence_batch"] == pytest.approx(summary["log_evidence"], abs=30.0)
    assert "Against the batch optimum" in page(run_folder) and "Against the ground truth" in page(run_folder)
    assert "uncertainty" in capsys.readouterr().err.replace("\n", " ")


def spoil_version(folder):
    arrays = load_arrays(folder / "trajectory.npz")
    save_arrays(folder / "trajectory.npz", arrays | {"version": np.array(99)})


def spoil_truth_of_another_run(folder):
    write_truth(folder, RunTruth(np.array([500]), load(folder).path.world_from_body[:1]))


def spoil_measurements(folder):
    path = folder / "observations_odometry.csv"
    lines = path.read_text().splitlines()
    rows = next(k for k, line in enumerate(lines) if line.startswith("# rows"))
    lines[rows] = f"# rows: {int(lines[rows].split(':')[1]) - 1}"
    path.write_text("\n".join(lines[:-1]) + "\n")


@pytest.mark.parametrize(
    ("spoil", "against", "message"),
    [
        (spoil_version, "groundtruth", "version 99"),
        (lambda folder: (folder / "truth.npz").unlink(), "groundtruth", "no ground truth"),
        (spoil_truth_of_another_run, "groundtruth", "another run"),
        (lambda folder: (folder / "observations.csv").unlink(), "gtsam", "observations.csv"),
        (spoil_measurements, "gtsam", "observations"),
        (lambda folder: None, "colmap", "cannot be compared with colmap"),
    ],
)
def test_what_cannot_be_compared_is_one_sentence_and_the_report_is_written(run_folder, spoil, against, message, capsys):
    (run_folder / "validation_groundtruth.json").unlink()
    spoil(run_folder)
    (run_folder / "report.html").unlink()
    assert main(["validate", str(run_folder), "--against", against]) == 2
    assert message in sentence(capsys) and f"Not compared with {against}" in page(run_folder)
    assert "ess mean" in page(run_folder)


@pytest.mark.parametrize(
    ("command", "spoil", "message"),
    [
        (["report"], lambda folder: shutil.rmtree(folder), "no such folder"),
        (["report"], lambda folder: (folder / "summary.json").write_text("{"), "damaged"),
        (["report"], lambda run: (run / "summary.json").write_text('{"problems": 7}'), "expected a list of sentences"),
        (["plot"], lambda run: (run / "diagnostics.csv").write_text("x\n1\n"), "expected a table with the columns"),
        (["plot", "run"], lambda run: (run / "trajectory.npz").unlink(), "of one recording can: run has no trajectory"),
        (["plot"], lambda run: (run / "timings.csv").write_text("x\n"), "timings.csv: expected a header, and rows of"),
        (["plot"], lambda run: (run / "diagnostics.csv").write_text("lost\n1\n"), "a row of each frame, found 1"),
        (["export", "--format", "tum"], lambda run: (run / "config.yaml").unlink(), "no config.yaml: expected the"),
        (["validate", "--against", "gtsam", "--truth-std-m", "0.01"], lambda run: None, "are of the ground truth, not"),
    ],
)
def test_a_folder_that_is_no_run_is_refused(run_folder, command, spoil, message, capsys, monkeypatch):
    monkeypatch.chdir(run_folder.parent)
    spoil(run_folder)
    assert main([*command, str(run_folder)]) == 2 and not (run_folder / "export").exists()
    assert message in sentence(capsys)


def test_a_damaged_comparison_is_said_and_the_others_count(run_folder):
    (run_folder / "validation_groundtruth.json").write_text("{}")
    (run_folder / "diagnostics.csv").write_text("a,b\n1\n")
    verdict = write_report(run_folder)
    assert "from the batch optimum" in verdict.path.sentence and page(run_folder).count('class="problem"') == 2
    assert "validation_groundtruth.json is no comparison of this version" in verdict.said[0]


def test_a_run_without_truth_is_judged_by_the_batch_posterior_that_it_found_or_by_nothing(run_folder):
    (run_folder / "truth.npz").unlink()
    (run_folder / "validation_groundtruth.json").unlink()
    apart = 1e3 * json.loads((run_folder / "summary.json").read_text())["filter_minus_batch_rmse_m"]
    verdict = write_report(run_folder)
    assert f"is {apart:.3g} mm (rms) from the batch optimum" in verdict.path.sentence
    assert "from the truth is not known" in verdict.path.sentence and verdict.path.grade == "good"
    assert "against the batch optimum: " in verdict.reason and verdict.trust != "cannot tell"
    (run_folder / "validation_gtsam.json").unlink()
    verdict = write_report(run_folder)
    assert "compared with nothing" in verdict.path.sentence and verdict.path.grade == "not known"
    assert verdict.trust in ("cannot tell", "do not trust")


def test_the_truth_is_told_from_the_first_pose():
    log = simulated_log(RobotWorld(steps=20), 0)
    moved = log.space.retract(log.space.identity(), np.array([0.5, 3.0, -2.0]))
    points = {k: log.space.transform(moved, p[:2]) for k, p in log.truth.landmarks.items()}
    truth = Truth(log.truth.stamps_ns, log.space.compose(moved, log.truth.poses), points)
    stamps = np.array([frame.stamp_ns for frame in log.frames])
    here, there = (truth_at(log.space, one, stamps, "first frame") for one in (log.truth, truth))
    np.testing.assert_allclose(there.poses, here.poses, atol=1e-12)
    for name, point in here.landmarks.items():
        np.testing.assert_allclose(there.landmarks[name], point, atol=1e-12)
    late, few, none = (Truth(truth.stamps_ns[part], truth.poses[part]) for part in (slice(5, None), slice(2), slice(0)))
    assert truth_at(log.space, late, stamps, "first frame").alignment == "rigid"
    assert all(truth_at(log.space, one, stamps, "first frame") is None for one in (few, none))


def test_a_link_that_points_outside_is_not_embedded(tmp_path):
    (tmp_path / "secret").write_bytes(b"secret")
    (run := tmp_path / "run").mkdir()
    (run / "own.png").write_bytes(b"own")
    (run / "evil.png").symlink_to(tmp_path / "secret")
    (run / "again.png").symlink_to("own.png")
    assert [picture.name for picture in _images(run, ["own.png", "evil.png", "again.png"])] == ["own", "again"]


# What stands on a page, and the pictures.


@pytest.fixture(scope="module")
def two(tmp_path_factory, plain_pictures):
    """Folders of two runs over one recording in space."""
    folder = tmp_path_factory.mktemp("two")
    simulate_robot(RobotWorld(steps=20, landmarks=20, spatial=True), folder / "log", seed=0)
    for seed in (0, 1):
        arguments = ["--out", str(folder / f"run{seed}"), "--particles", "20", "--seed", str(seed), "--no-batch"]
        assert main(["run", "range-bearing", str(folder / "log"), *arguments]) == 0
    return folder / "run0", folder / "run1"


@pytest.mark.parametrize(
    ("value", "name", "said"),
    [
        (0.00432, "ate_rmse_m", "4.32 mm"),
        (12.3456, "ate_rmse_m", "12.3 m"),
        (7110.34, "log_evidence", "7,110"),
        (0.5, "rotation_deg", "0.500°"),
        (1234, "frames", "1,234"),
        (7.28e-115, "nis", "7.3e-115"),
        (0.0, "nis", "0.00"),
        (9.996, "nis", "10.00"),
        (True, "x", "True"),
    ],
)
def test_numbers_have_three_digits_and_a_unit(value, name, said):
    assert digits(value, name) == said


def test_a_command_names_what_is_not_the_default():
    usual = asdict(MonoConfig())
    entries = {"rbpf": "0", "system": "mono", "recording": "a b", **usual, "particles": 7, "known_points": "k.csv"}
    entries |= {"map": "particles", "search": usual["search"] | {"noise_px": 0.5}, "video": False}
    words = command_of(entries, usual)
    assert words[:4] == ["rbpf", "run", "mono", "a b"] and "--no-video" in words
    rest = " ".join(words[4:])
    for part in ("--known-points k.csv", "--particles 7", "--set map=particles", "--set search.noise_px=0.5"):
        assert part in rest
    assert words.count("--set") == 2
    # And what is not the default of a run so set, as a window of 5 where a sensor's place is estimated.
    entries = asdict(RangeBearingConfig(calibrate="sensor")) | {"system": "range-bearing"}
    usual = asdict(RangeBearingConfig()), asdict(defaults_of(RangeBearingConfig, entries))
    assert command_of(entries, *usual)[4:] == ["--set", "window=5", "--set", "calibrate=sensor"]


def test_the_page_has_a_head_a_scene_and_no_empty_section(two):
    write_report(two[0])
    text = (two[0] / "report.html").read_text()
    command = re.search(r"<pre>(.*)</pre>", text)[1]
    assert command.startswith("rbpf run range-bearing ") and command.endswith("--no-batch --particles 20")
    assert '<meta name="viewport"' in text and len(text) < 8e6
    for section in text.split("<h2>")[1:]:
        assert len(re.sub(r"<[^>]+>", "", section.partition("</h2>")[2]).split()) + section.count("<img") > 0
    captions = re.findall(r"<figcaption>(.*?)</figcaption>", text)
    assert len(captions) >= 6 and all(captions)
    vectors = re.findall(r'<a href="(\w+\.pdf)">PDF</a></figcaption>', text)
    assert len(vectors) == len(captions) and all((two[0] / name).read_bytes().startswith(b"%PDF") for name in vectors)
    packed = re.search(r'id="plotly">([^<]+)<', text)[1]
    assert packed == program() and b"plotly.js v" in decompress(b64decode(packed))[:200]
    told = json.loads(re.search(r'id="traces">([^<]+)<', text)[1])
    assert {t["name"] for t in told["data"]} == {"path", "truth", "odometry alone", "poses", "landmarks", "3σ"}


def numbers_of(trace) -> np.ndarray:
    return np.array([np.frombuffer(b64decode(trace[axis]["bdata"]), trace[axis]["dtype"]) for axis in "xyz"]).T


def test_the_scene_shows_the_path_and_ellipsoids_where_they_are(two):
    found = rbpf.load(two[0])
    told = json.loads(scene(found, World.of(found)))
    Scene(told)  # plotly knows every name and value
    traces = {trace["name"]: trace for trace in told["data"]}
    np.testing.assert_allclose(numbers_of(traces["path"]), found.trajectory.positions, atol=1e-5)
    mesh, whole = traces["3σ"], found.map.points()
    corners = numbers_of(mesh).reshape(-1, 56, 3)
    for corner in corners:
        k = np.argmin(np.linalg.norm(whole.mean - corner.mean(axis=0), axis=1))
        offset = corner - whole.mean[k]
        distance = np.sqrt(np.einsum("pa,ab,pb->p", offset, np.linalg.inv(whole.cov[k]), offset))
        np.testing.assert_allclose(distance, 3.0, rtol=1e-2)
    faces = np.array([np.frombuffer(b64decode(mesh[c]["bdata"]), "i4") for c in "ijk"])
    assert faces.min() == 0 and faces.max() == corners.size // 3 - 1


def test_a_scanner_s_scene_has_its_walls(tmp_path):
    simulate_laser(LaserWorld(scans=12), tmp_path / "log", seed=0)
    log, out = tmp_path / "log" / "robot.clf", tmp_path / "run"
    assert main(["run", "laser", str(log), "--particles", "3", "--out", str(out)]) == 0
    found = rbpf.load(tmp_path / "run")
    told = json.loads(scene(found, World.of(found)))
    walls = next(trace for trace in told["data"] if trace["name"] == "walls")
    assert len(numbers_of(walls)) == (found.grid.log_odds > 0).sum() > 100
    assert 'id="scene"' in (tmp_path / "run" / "report.html").read_text()


@pytest.mark.parametrize("draw", [rbpf.plot_trajectory, rbpf.plot_map, rbpf.plot_consistency, rbpf.plot_error])
def test_pictures_are_drawn_into_axes_that_are_given(two, draw):
    axes, found = Figure().subplots(), rbpf.load(two[0])
    assert draw(found, ax=axes) is axes.figure and axes.lines
    assert draw(found) is not axes.figure


def test_paths_of_two_runs_are_in_one_world(two):
    axes, runs = Figure().subplots(), [rbpf.load(run) for run in two]
    rbpf.plot_trajectory(*runs, ax=axes)
    lines = {line.get_label(): line.get_xydata() for line in axes.lines}
    for run in runs:
        np.testing.assert_allclose(lines[run.folder.name], run.trajectory.positions[:, :2])
    assert {"truth", "run0", "run1"} <= lines.keys()


def test_runs_are_plotted_beside_one_another(two, tmp_path, capsys):
    assert main(["plot", *map(str, two), "--out", str(tmp_path), "--format", "png", "svg", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert sorted(told["files"]) == sorted(path.name for path in tmp_path.iterdir())
    assert {"path.svg", "error.png", "consistency.svg"} <= set(told["files"])
    assert (tmp_path / "path.svg").read_text().startswith("<?xml")
    assert main(["plot", str(two[0]), "--out", str(tmp_path / "one"), "--format", "pdf"]) == 0
    assert (tmp_path / "one" / "map.pdf").read_bytes().startswith(b"%PDF")
    assert main(["plot", "--out", str(tmp_path)]) == 2
