import csv

import numpy as np
import pytest

from examples.studies.point_worlds import MONO, DeskWorld, Measuring, simulate_features
from rbpf.lie import SE3
from rbpf.runs.recordings import filter_features
from rbpf.systems.mono.config import MonoConfig
from rbpf.validation.consistency.statistic import whitened_errors
from rbpf.validation.tables import write_table


def test_nees_of_errors_drawn_from_the_covariance_is_six():
    rng = np.random.default_rng(0)
    factor = 0.1 * rng.normal(size=(4000, 6, 6))
    truth = SE3.exp(rng.normal(size=(4000, 6)))
    cov = factor @ np.swapaxes(factor, 1, 2)
    drawn = np.einsum("tab,tb->ta", factor, rng.normal(size=(4000, 6)))
    inverse = SE3.retract(SE3.identity(), drawn)
    estimate = SE3.compose(truth, SE3.inverse(inverse))
    errors = whitened_errors(SE3, estimate, cov, truth)
    assert errors.nees.mean() == pytest.approx(6.0, abs=0.25)
    assert (errors.ranks == 6).all()


def test_a_table_is_printed_in_columns_and_kept(tmp_path, capsys):
    write_table(tmp_path / "new" / "table.csv", ["name", "error"], [["a", 1.23456789], ["long", 12]])
    assert capsys.readouterr().out.splitlines() == ["name  error", "a      1.23", "long     12"]
    with (tmp_path / "new" / "table.csv").open(encoding="utf-8", newline="") as file:
        assert list(csv.reader(file)) == [["name", "error"], ["a", "1.23457"], ["long", "12"]]


def test_a_camera_s_map_is_told_in_the_world_of_the_known_points():
    log = simulate_features(DeskWorld(frames=60), Measuring(), MONO, seed=0)
    summary = filter_features(log, MonoConfig(particles=50)).system.map().points()
    truth = np.array([log.truth.landmarks[name] for name in summary.ids.tolist()])
    error = summary.mean - truth
    squared = np.einsum("kd,kde,ke->k", error, np.linalg.inv(summary.cov), error)
    assert summary.ids.size > 10
    assert np.linalg.norm(error, axis=1).max() < 0.15
    assert 0.3 < np.median(squared) / 3.0 < 3.0
