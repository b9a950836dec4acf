"""Paths by relations between their poses: against poses that are known, and figures of others."""

import json

import numpy as np
import pytest

from rbpf.cli import main
from rbpf.errors import InputError
from rbpf.lie import SE2, SE3
from rbpf.runs.results import load
from rbpf.runs.trajectory import Trajectory, in_space, read_tum, write_tum
from rbpf.sensors.readers import read_laser_log
from rbpf.validation.metrics.relations import entries, read_relations, relation_errors, sentence
from rbpf.validation.simulation.robot import RobotWorld, simulate_robot

SECONDS = np.arange(5)
PLANAR = np.array([[0.0, 0.0, 0.0], [0.5, 1.0, 0.0], [1.5, 1.0, 2.0], [3.0, 0.0, 2.0], [-3.0, 0.0, 0.0]])
PATH = in_space(SECONDS * 10**9, PLANAR)


def written(folder, *rows):
    path = folder / "some.relations"
    path.write_text("# t1 t2 x y z roll pitch yaw\n" + "".join(" ".join(map(str, row)) + "\n" for row in rows))
    return path


def relation(first, second, pose):
    """A row of a pose of SE2 at the second time seen from the first."""
    theta, x, y = pose
    return [first, second, x, y, 0, 0, 0, theta]


def test_a_path_misses_its_own_relations_by_nothing_and_others_by_how_they_differ(tmp_path):
    ends = [(0, 1), (3, 1), (2, 4)]
    own = [relation(a, b, SE2.between(PLANAR[a], PLANAR[b])) for a, b in ends]
    errors = relation_errors(PATH, read_relations(written(tmp_path, *own)))
    np.testing.assert_allclose(errors.translations, 0.0, atol=1e-12)
    np.testing.assert_allclose(errors.rotations_deg, 0.0, atol=1e-5)
    # A relation that differs by 0.3 m, 0.4 m and a tenth of a radian at its end.
    wrong = SE2.compose(SE2.between(PLANAR[2], PLANAR[4]), SE2.inverse(np.array([0.1, 0.3, 0.4])))
    errors = relation_errors(PATH, read_relations(written(tmp_path, *own[:2], relation(2, 4, wrong))))
    np.testing.assert_allclose(errors.translations, [0, 0, 0.5], atol=1e-12)
    found = entries(errors)
    assert found["relations"] == 3
    assert found["relations_translation_mean_m"] == pytest.approx(0.5 / 3)
    assert found["relations_rotation_std_deg"] == pytest.approx(np.std([0, 0, np.degrees(0.1)]))


def test_between_two_poses_the_path_is_a_line_and_the_shortest_turn_and_roll_and_pitch_count(tmp_path):
    middle = np.array([np.pi, 0.0, 1.0])  # of headings 3 and -3
    half = [relation(0, 0.5, [0.25, 0.5, 0.0]), relation(1, 3.5, SE2.between(PLANAR[1], middle))]
    errors = relation_errors(PATH, read_relations(written(tmp_path, *half)))
    np.testing.assert_allclose(errors.translations, 0.0, atol=1e-12)
    np.testing.assert_allclose(errors.rotations_deg, 0.0, atol=1e-5)
    turn = SE3.from_ypr(np.array([1.0, 2.0, 3.0]), 0.3, 0.2, 0.1)
    path = Trajectory(np.array([0, 10**9]), np.stack([SE3.identity(), turn]))
    errors = relation_errors(path, read_relations(written(tmp_path, [0, 1, 1, 2, 3, 0.1, 0.2, 0.3])))
    np.testing.assert_allclose([errors.translations[0], errors.rotations_deg[0]], 0.0, atol=1e-5)


def test_relations_outside_of_the_path_are_told(tmp_path):
    relations = read_relations(written(tmp_path, relation(0, 1, [0.5, 1, 0]), relation(1, 9, [0, 0, 0])))
    errors = relation_errors(PATH, relations)
    assert len(errors.translations) == 1
    assert "misses 1 relations of 2 (the others end outside of its time) by 0.000 ± 0.000 m" in sentence(errors, 2)
    with pytest.raises(InputError, match="None of the relations has both ends within the path"):
        relation_errors(PATH.take(np.array([3, 4])), relations)


def test_a_run_is_scored_by_relations_and_by_another_path(tmp_path, capsys, plain_pictures):
    simulate_robot(RobotWorld(steps=12, landmarks=20), tmp_path / "log", seed=0)
    run = tmp_path / "run"
    command = ["run", "range-bearing", str(tmp_path / "log"), "--out", str(run), "--particles", "20", "--no-batch"]
    assert main(command) == 0
    path = load(run).path.world_from_body
    off = SE2.compose(SE2.between(path[2], path[10]), SE2.inverse(np.array([0.0, 0.3, 0.0])))
    # Logs without times count their steps, in nanoseconds.
    file = written(tmp_path, relation("0.000000002", "0.000000010", off))
    assert main(["validate", str(run), "--relations", str(file)]) == 0
    assert "misses 1 relations by 0.300 ± 0.000 m" in capsys.readouterr().err.replace("\n", " ")
    summary = json.loads((run / "summary.json").read_text())
    assert summary["relations_translation_mean_m"] == pytest.approx(0.3)
    assert summary["odometry_relations_translation_mean_m"] > 0.0
    page = (run / "report.html").read_text()
    assert "Against known relations" in page and "Against the ground truth" in page
    # Its own path, moved as a whole, is the same path.
    moved = load(run).trajectory
    turn = SE3.from_ypr(np.array([1.0, 2.0, 0.0]), 1.0, 0.0, 0.0)
    write_tum(tmp_path / "other.tum", Trajectory(moved.stamps_ns, SE3.compose(turn, moved.world_from_body)))
    assert main(["validate", str(run), "--path", str(tmp_path / "other.tum")]) == 0
    figures = json.loads((run / "validation_path.json").read_text())["figures"]
    assert figures["path_minus_other_rmse_m"] < 1e-9 and figures["steps_compared"] == 12
    assert main(["validate", str(run), "--path", str(file), "--relations", str(file)]) == 2
    assert main(["validate", str(run), "--relations", str(tmp_path / "none")]) == 2
    assert "none: no such file; expected a table of relations" in capsys.readouterr().err.replace("\n", " ")


@pytest.mark.real_data
def test_figures_of_a_known_path_and_of_odometry(data_dir):
    """The path that GMapping found on this log, and the wheels alone."""
    folder = data_dir / "laser_intel"
    relations = read_relations(folder / "intel.relations")
    found = entries(relation_errors(read_tum(folder / "gmapping.tum"), relations))
    assert found["relations"] == 2984
    assert found["relations_translation_mean_m"] == pytest.approx(0.126, abs=5e-4)
    assert found["relations_translation_std_m"] == pytest.approx(0.118, abs=5e-4)
    assert found["relations_rotation_mean_deg"] == pytest.approx(4.1, abs=0.05)
    log = read_laser_log(folder / "intel.clf")
    found = entries(relation_errors(in_space(log.stamps_ns, log.odometry), relations))
    assert found["relations_translation_mean_m"] == pytest.approx(7.43, abs=0.01)
