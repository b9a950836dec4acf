"""The noise that a report advises is the one that the measurements have."""

from pathlib import Path

import numpy as np
import pytest

from rbpf.core.filter import Filter
from rbpf.runs.results import Results
from rbpf.validation.consistency.comparison import INNOVATIONS, noise_advice
from rbpf.validation.consistency.statistic import step_ratio, variance_ratio
from tests.validation.fixes import Receiver, Walk


def record(system: str, **config: object) -> Results:
    return Results(Path("run"), {"system": system, **config}, {})


def innovations(value: float):
    return [variance_ratio(INNOVATIONS, value, 5000.0, 1.1)]


def test_the_setting_is_named_with_its_value():
    mono = record("mono", search={"noise_px": 2.0})
    assert "--set search.noise_px=0.5 in place of 2;" in noise_advice(mono, innovations(1 / 16))
    assert "--set search.noise_px=6 in place of 2;" in noise_advice(mono, innovations(9.0))


def test_where_no_setting_holds_it_the_factor_is_told():
    assert "measurements 3 times as large" in noise_advice(record("range-bearing"), innovations(9.0))
    assert "times as large" in noise_advice(record("mono", search="damaged"), innovations(9.0))


def test_nothing_is_advised_where_nothing_contradicts():
    assert noise_advice(record("mono"), innovations(1.0)) == ""
    assert noise_advice(record("mono"), [variance_ratio("poses", 9.0, 500.0, 2.0)]) == ""
    assert noise_advice(record("mono"), []) == ""


@pytest.mark.slow
@pytest.mark.parametrize("claimed", [4.0, 0.25])
def test_a_filter_of_fixes_is_told_its_noise(claimed):
    """Fixes of 1 m on a walk of 1 m per step; advice that is followed again and again ends near the truth."""
    off = abs(np.log(claimed))
    rng = np.random.default_rng(0)
    fixes = np.cumsum(rng.normal(size=(400, 2)), axis=0) + rng.normal(size=(400, 2))
    for _ in range(8):
        filter_ = Filter(Walk(), Receiver(claimed), n=200, rng=np.random.default_rng(1))
        reports = [filter_.step(fix) for fix in fixes]
        nis = step_ratio(INNOVATIONS, *np.array([(r.nis, r.rows) for r in reports], dtype=float).T)
        advice = noise_advice(record("mono", search={"noise_px": claimed}), [nis])
        if not advice:
            break
        claimed = float(advice.split("noise_px=")[1].split(" ")[0])
    assert advice == ""
    assert abs(np.log(claimed)) < 0.25 * off
