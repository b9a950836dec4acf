"""Maps that follow from sightings and a path, and the figures of a run over a part of the laboratory."""

from types import SimpleNamespace

import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.sensors.feature_log import CameraTruth
from rbpf.validation.s05.drive import Setting
from rbpf.validation.s05.record import Best, Paths, Record, errors
from rbpf.validation.s05.sweeps import HEADER, settings, sweep


def path(count: int, rng: np.random.Generator, noise: float) -> np.ndarray:
    steps = np.zeros((count, 6))
    steps[:, 1], steps[:, 5] = 0.1, 0.2
    poses = [SE3.identity()]
    for step in steps[1:] + noise * rng.standard_normal((count - 1, 6)):
        poses.append(SE3.compose(poses[-1], SE3.exp(step)))
    return np.array(poses)


@pytest.fixture
def scene():
    """Ten landmarks seen from a true path, without noise, some names not asked for; a path that is 5 % too long."""
    rng = np.random.default_rng(3)
    true = path(12, rng, 0.0)
    places = rng.uniform([-3.0, -1.0, 1.0], [3.0, 1.0, 6.0], (10, 3))
    names, record = np.arange(10) * 3 + 1, Record(due=(4,))
    for t in range(12):
        seen = rng.permutation(10)[:6]
        record.sightings.append((names[seen], t, SE3.inverse_transform(true[t], places[seen])))
    return true, places, names, record


def test_the_true_path_puts_landmarks_where_they_are(scene):
    true, places, names, record = scene
    np.testing.assert_allclose(record.places(true, names), places, atol=1e-12)
    some = names[[1, 4, 9]]
    np.testing.assert_allclose(record.places(true, some), places[[1, 4, 9]], atol=1e-12)


def test_errors_of_maps_and_paths(scene):
    """A rigid motion of everything is an error that alignment removes; a wrong scale is one that it does not."""
    true, places, names, record = scene
    moved = SE3.compose(SE3.exp(np.array([0.0, 0.05, 0.0, 0.1, 0.0, 0.0])), true)
    longer = true.copy()
    longer[:, 4:] *= 1.05
    updated = np.ones(len(true), dtype=bool)
    best = Best(names, places, true, np.zeros((1, 3)))
    found = errors(record, Paths(true, moved, longer, true), best, updated)
    for name in ("path, best particle", "map, best particle", "map, wheels"):
        assert found[name] == pytest.approx(0.0, abs=1e-12)
    assert found["map, filter"] > 0.1 and found["map, filter, aligned"] < 1e-9
    assert found["path, filter"] > 0.1 and found["path, filter, aligned"] < 1e-9
    assert found["map, odometry"] > found["map, odometry, aligned"] > 0.005
    length = np.linalg.norm(true[-1, 4:])
    assert found["end, odometry"] == pytest.approx(0.05 * length)


def test_rows_of_the_table_are_taken_when_they_are_due():
    manager = SimpleNamespace(confirmed=np.array([True, False, True]), next_name=9)
    sensor = SimpleNamespace(manager=manager, names=np.zeros(0, dtype=np.int64))
    run = SimpleNamespace(
        front_end=SimpleNamespace(sensor=sensor), updated=np.zeros(6), stamps_ns=np.arange(6)
    )
    record = Record(due=(2, 4))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("rbpf.validation.s05.record.sensor_of", lambda one: one.front_end.sensor)
        for t in range(6):
            record(t, run)
    assert [row.pairs for row in record.rows] == [2, 4, 6]
    assert record.rows[0].landmarks == 2 and record.rows[0].features == 9
    assert len(record.cpu) == 6 and min(record.cpu) >= 0.0


def test_sweeps_change_one_thing(tmp_path):
    base = Setting(tmp_path).config()
    assert base.dof == 3 and base.particles == 400
    for name, config in settings(base).items():
        changed = [item for item in vars(base) if getattr(config, item) != getattr(base, item)]
        assert len(changed) == (0 if name == "as it is" else 2 if name.startswith("refined") else 1), name
    with pytest.raises(InputError, match="dof must be 3 or 6"):
        Setting(tmp_path, dof=4).config()


def test_a_sweep_tells_median_and_range_over_the_seeds(tmp_path, monkeypatch):
    """The true path is at the origin; each seed is off by its own constant, its odometry by ten times that."""
    base, still = Setting(tmp_path).config(), np.tile(SE3.identity(), (5, 1))

    def off(by: float) -> np.ndarray:
        path = still.copy()
        path[1:, 4] = by
        return path

    def run_images(drive, config):
        ours, cov = off(0.1 * config.seed), np.tile(0.01 * np.eye(6), (5, 1, 1))
        stamps, truth = np.arange(5), CameraTruth(np.arange(5), still)
        names = {"stamps_ns": stamps, "truth": truth, "world_from_camera": ours, "cov": cov}
        return SimpleNamespace(**names, odometry=off(config.seed), seconds=np.full(5, 0.5))

    monkeypatch.setattr("rbpf.validation.s05.sweeps.run_images", run_images)
    first, alone, *others = map(list, sweep(None, base, (1, 2, 4)))
    assert [first[0], *(row[0] for row in others)] == list(settings(base))
    assert {len(row) for row in (first, alone, *others)} == {len(HEADER)}
    fraction = np.sqrt(4 / 5)
    assert first[1:5] == pytest.approx([0.2 * fraction, 0.1 * fraction, 0.4 * fraction, 0.2])
    assert first[5:8] == pytest.approx([4.0, 1.0, 16.0]) and first[9] == 0.5
    assert alone[0] == "odometry alone" and alone[1:5] == pytest.approx(
        [2.0 * fraction, fraction, 4.0 * fraction, 2.0]
    )
