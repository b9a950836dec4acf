import csv
from pathlib import Path

import pytest
import yaml

from rbpf.cli import main
from rbpf.errors import InputError
from rbpf.validation import sweep as sweeping
from rbpf.validation.simulation.robot import RobotWorld, simulate_robot
from rbpf.validation.sweep import ROWS, TABLE, SweepFile, plan, read_plan, read_rows, sweep
from tests.cli.sequences import FRAMES, render_desk, render_room, sentence

pytestmark = pytest.mark.slow

PLAN = {
    "system": "range-bearing",
    "sequences": ["log"],
    "particles": [5, 10],
    "seeds": 2,
    "options": {"as it is": {}, "one linearisation": {"proposal.iterations": 1}},
    "settings": {"window": 5},
}


@pytest.fixture
def config(tmp_path):
    simulate_robot(RobotWorld(steps=12, landmarks=25), tmp_path / "log", seed=0)
    path = tmp_path / "sweep.yaml"
    path.write_text(yaml.safe_dump(PLAN))
    return path


def table(out: Path) -> list[dict[str, str]]:
    with (out / TABLE).open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def steady(rows):
    """Rows without what differs from call to call."""
    return [{k: v for k, v in row.items() if not k.startswith(("ms_", "peak_"))} for row in rows]


def test_a_sweep_is_one_tidy_table(config, tmp_path):
    rows = sweep(read_plan(config), tmp_path / "out", workers=1)
    assert len(rows) == 8
    found = table(tmp_path / "out")
    assert [(row["option"], row["particles"], row["seed"]) for row in found] == [
        (option, particles, seed)
        for option in ("as it is", "one linearisation")
        for particles in ("5", "10")
        for seed in ("0", "1")
    ]
    assert all(float(row["path_rmse_m"]) > 0 and float(row["pose_nees_mean"]) > 0 for row in found)
    assert len({row["path_rmse_m"] for row in found}) == 8


def test_an_interrupted_sweep_loses_nothing(config, tmp_path, monkeypatch, capsys):
    calls: list[str] = []
    right = sweeping.run_job

    def interrupted(job):
        calls.append(job.key)
        if len(calls) == 4:
            raise KeyboardInterrupt
        return right(job)

    out = tmp_path / "out"
    monkeypatch.setattr(sweeping, "run_job", interrupted)
    assert main(["sweep", str(config), "--out", str(out), "--workers", "1"]) == 130
    assert len(table(out)) == 3
    with (out / ROWS).open("a", encoding="utf-8") as file:
        file.write('{"key": "cut o')
    first = calls[:3]
    calls.clear()
    monkeypatch.setattr(sweeping, "run_job", lambda job: calls.append(job.key) or right(job))
    assert main(["sweep", str(config), "--out", str(out), "--workers", "1"]) == 0
    assert len(calls) == 5 and not set(calls) & set(first)
    whole = sweep(read_plan(config), tmp_path / "whole", workers=1)
    assert steady(table(out)) == steady(table(tmp_path / "whole")) and len(whole) == 8
    assert "8 runs" in capsys.readouterr().err


def test_a_run_that_is_not_possible_does_not_stop_the_others(config, tmp_path, capsys):
    broken = tmp_path / "broken"
    broken.mkdir()
    for path in (tmp_path / "log").iterdir():
        (broken / path.name).write_text(path.read_text().replace("step", "stop", 1))
    config.write_text(yaml.safe_dump(PLAN | {"sequences": ["broken", "log"], "seeds": 1, "particles": [5]}))
    assert main(["sweep", str(config), "--out", str(tmp_path / "out"), "--workers", "1"]) == 2
    assert "2 of 4 runs were not possible" in capsys.readouterr().err
    found = table(tmp_path / "out")
    assert [bool(row["failure"]) for row in found] == [True, True, False, False]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"system": "sonar"}, "range-bearing, laser, mono, stereo"),
        ({"sequences": ["nowhere"]}, "no sequence"),
        ({"seeds": [1, 1]}, "same run twice"),
        ({"particles": [0]}, "particles must be a whole number, at least 1"),
        ({"settings": {"proposal.iterations": "two"}}, "iterations"),
        ({"seeds": 10**9}, "more than"),
    ],
)
def test_a_bad_plan_is_one_sentence(config, tmp_path, capsys, change, message):
    config.write_text(yaml.safe_dump(PLAN | change))
    assert main(["sweep", str(config), "--out", str(tmp_path / "out")]) == 2
    assert message in sentence(capsys) and not (tmp_path / "out").exists()


NO_PLANS = [(read_plan, text, r"plan\.yaml") for text in ("[1, 2]", "system: [", "- a\n- b", "")]
NO_ROWS = (read_rows, '{"key": "a", "figures": {}}\nnonsense\n', "line 2")


@pytest.mark.parametrize(("read", "text", "words"), [*NO_PLANS, NO_ROWS])
def test_a_file_that_is_no_plan_and_damaged_rows_are_refused(tmp_path, read, text, words):
    path = tmp_path / "plan.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=words):
        read(path)


def test_processes_and_clusters_change_nothing(config, tmp_path):
    jobs = read_plan(config)[:2]
    alone = steady(sweep(jobs, tmp_path / "alone", workers=1))
    assert steady(sweep(jobs, tmp_path / "two", workers=2)) == alone
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as cluster:
        assert steady(sweep(jobs, tmp_path / "cluster", scheduler=cluster.scheduler_address)) == alone


def test_a_scheduler_that_does_not_answer_is_said(config, tmp_path, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(sweeping, "SECONDS", 1)
    with pytest.raises(InputError, match="no Dask scheduler answers at tcp"):
        sweep(read_plan(config), tmp_path / "out", scheduler="tcp://127.0.0.1:9")


def test_images_are_swept_with_their_known_points(tmp_path):
    render_desk(tmp_path / "desk")
    sequence = {"recording": "desk", "known_points": "desk/known_points.csv"}
    file = SweepFile("mono", [sequence, {"recording": "desk"}], [8], settings={"search.measurements": 15})
    known, alone = sweep(plan(file, tmp_path), tmp_path / "out", workers=1)
    assert known["known_points"] == 6 and known["pose_nees_mean"] > 0.0
    assert alone["known_points"] == 0 and "pose_nees_mean" not in alone
    assert alone["frames_tracked"] == known["frames_tracked"] == FRAMES


def test_pairs_of_images_are_swept(tmp_path):
    """With and without the map: odometry that differs by its draws alone, another filter."""
    render_room(tmp_path / "room")
    options = {"map": {}, "no map": {"map.used": False}}
    file = SweepFile("stereo", ["room"], [20], options=options)
    mapped, alone = sweep(plan(file, tmp_path), tmp_path / "out", workers=1)
    assert mapped["vo_ate_rmse_m"] == pytest.approx(alone["vo_ate_rmse_m"], rel=1e-3) and alone["vo_ate_rmse_m"] > 0.0
    assert mapped["landmarks_mean_per_particle"] > 0 == alone["landmarks_mean_per_particle"]
    assert mapped["pose_nees_mean"] > 0.0
