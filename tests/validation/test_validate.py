"""Run folders: what a comparison and a report make of them, whole or spoilt."""

import json
import shutil

import numpy as np
import pytest

from rbpf.cli import main
from rbpf.core.checkpoint import load_arrays, save_arrays
from rbpf.runs.results import load
from rbpf.runs.truth import RunTruth, truth_at, write_truth
from rbpf.sensors.readers import Truth
from rbpf.validation.report.page import _images, write_report
from rbpf.validation.simulation.robot import RobotWorld, simulate_robot, simulated_log

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
    entries = json.loads((finished / "validation_groundtruth.json").read_text())
    assert entries["figures"]["steps_compared"] == 40
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
    assert figures["landmarks_count"] > 10
    assert 0.0 < figures["landmarks_kullback_leibler_median"] < 5.0
    assert 0.0 < figures["poses_bhattacharyya_median"] < 5.0 and figures["poses_count"] == 1
    assert 0.5 < figures["landmarks_sigma_ratio_median"] < 1.5
    assert figures["batch_log_likelihood"] > figures["filter_log_likelihood"] - 5.0
    summary = json.loads((run_folder / "summary.json").read_text())
    names = ("log_evidence_batch", "log_evidence_batch_error", "posterior_draws_ess")
    assert [figures[name] for name in names] == pytest.approx([summary[name] for name in names], abs=0.01)
    assert figures["log_evidence_batch_error"] < 0.1 and figures["posterior_draws_ess"] > 150.0
    assert figures["log_evidence_batch"] == pytest.approx(summary["log_evidence"], abs=30.0)
    assert "Against the batch optimum" in page(run_folder)
    assert "Against the ground truth" in page(run_folder)
    assert "uncertainty" in capsys.readouterr().err.replace("\n", " ")


def spoil_version(folder):
    arrays = load_arrays(folder / "trajectory.npz")
    save_arrays(folder / "trajectory.npz", arrays | {"version": np.array(99)})


def spoil_truth_of_another_run(folder):
    path = load(folder).path
    write_truth(folder, RunTruth(np.array([500]), path.world_from_body[:1]))


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
    error = capsys.readouterr().err
    assert error.startswith("rbpf: ")
    assert message in error
    assert error.count("\n") == 1
    assert f"Not compared with {against}" in page(run_folder)
    assert "ess mean" in page(run_folder)


@pytest.mark.parametrize(
    ("command", "spoil", "message"),
    [
        (["report"], lambda folder: shutil.rmtree(folder), "no such folder"),
        (["report"], lambda folder: (folder / "summary.json").write_text("{"), "damaged"),
        (
            ["export", "--format", "tum"],
            lambda folder: (folder / "config.yaml").unlink(),
            "no config.yaml: expected the folder",
        ),
        (
            ["validate", "--against", "gtsam", "--truth-std-m", "0.01"],
            lambda folder: None,
            "are of the ground truth, not",
        ),
    ],
)
def test_a_folder_that_is_no_run_is_refused(run_folder, command, spoil, message, capsys):
    spoil(run_folder)
    assert main([*command, str(run_folder)]) == 2 and not (run_folder / "export").exists()
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_a_damaged_comparison_is_said_on_the_page(run_folder):
    (run_folder / "validation_groundtruth.json").write_text("{}")
    (run_folder / "diagnostics.csv").write_text("a,b\n1\n")
    verdict = write_report(run_folder)
    assert verdict.trust == "cannot tell"
    assert page(run_folder).count('class="problem"') == 2


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
    truth = Truth(
        log.truth.stamps_ns,
        log.space.compose(moved, log.truth.poses),
        {k: log.space.transform(moved, p[:2]) for k, p in log.truth.landmarks.items()},
    )
    stamps = np.array([frame.stamp_ns for frame in log.frames])
    here, there = (truth_at(log.space, one, stamps, "first frame") for one in (log.truth, truth))
    np.testing.assert_allclose(there.poses, here.poses, atol=1e-12)
    for name, point in here.landmarks.items():
        np.testing.assert_allclose(there.landmarks[name], point, atol=1e-12)
    late = Truth(truth.stamps_ns[5:], truth.poses[5:])
    assert truth_at(log.space, late, stamps, "first frame").alignment == "rigid"
    assert truth_at(log.space, Truth(truth.stamps_ns[-2:], truth.poses[-2:]), stamps, "first frame") is None


def test_a_link_that_points_outside_is_not_embedded(tmp_path):
    (tmp_path / "secret").write_bytes(b"secret")
    run = tmp_path / "run"
    run.mkdir()
    (run / "own.png").write_bytes(b"own")
    (run / "evil.png").symlink_to(tmp_path / "secret")
    (run / "again.png").symlink_to("own.png")
    assert [picture.name for picture in _images(run, ["own.png", "evil.png", "again.png"])] == ["own", "again"]
