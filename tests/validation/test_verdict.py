"""The verdict on simulated runs, trusted where nothing is wrong and not where something is; the noise that it advises."""

from pathlib import Path

import numpy as np
import pytest

from examples.studies.verdict import CASES, SHORT, is_right, judged, robot, swap_names
from rbpf.core.diagnostics import motion_correction
from rbpf.core.filter import Filter
from rbpf.runs.folder import write_run
from rbpf.runs.reading import RunFolder
from rbpf.runs.results import Results
from rbpf.validation.consistency import comparison
from rbpf.validation.consistency.against_groundtruth import pose_statistics
from rbpf.validation.consistency.statistic import Statistic, coverage, step_ratio, variance_ratio, whitened_errors
from tests.core.scripted import Scripted, seen
from tests.exactness.models import LinearMotion, LinearObservation

WALK, FIX = LinearMotion(np.eye(2), np.eye(2)), LinearObservation(by_state=np.eye(2))

ALIKE = {
    "sensor noise × 2", "sensor noise ÷ 3", "odometry noise × 3", "nothing, another world", "the same in another world",
    "the same in another world, joint map",
}  # fmt: skip
SLOW = {"20 % wrong names"}


@pytest.mark.slow
@pytest.mark.parametrize("case", [case for case in CASES if case.name not in ALIKE | SLOW], ids=lambda case: case.name)
def test_the_verdict_on_runs_whose_fault_is_known(case, tmp_path):
    *verdicts, found = judged(case.run(), tmp_path)
    for verdict in verdicts:
        assert is_right(case, verdict, found), verdict.sentences[1]


@pytest.mark.slow
def test_wrong_names_are_told_by_the_innovations(tmp_path):
    """Their batch, which takes a minute, is in the study's table."""
    run = robot(lambda log: swap_names(log, 0.2, np.random.default_rng(0)), world=SHORT)()
    write_run(run, tmp_path, {"recording": "here"})
    found = comparison.compare_with_itself(RunFolder.open(tmp_path))
    assert comparison.verdict_of(RunFolder.open(tmp_path), [found]).trust == "do not trust"


def linear_gaussian(claimed: float, seed: int = 0, steps: int = 300) -> comparison.Verdict:
    """Fixes of 1 m, and what the filter is told of them."""
    rng = np.random.default_rng(seed)
    truth = np.cumsum(rng.normal(size=(steps, 2)), axis=0)
    filter_, cov = Filter(WALK, Scripted(), n=300, rng=rng), claimed**2 * np.eye(2)[None]
    reports = [filter_.step(seen(FIX, fix[None], cov)) for fix in truth + rng.normal(size=(steps, 2))]
    found = [motion_correction(report.mixture) for report in reports]
    own = comparison.innovation_statistics(
        np.array([report.nis for report in reports]),
        np.array([report.rows for report in reports], dtype=float),
        np.array([correction.mean for correction in found]),
        np.array([correction.cov for correction in found]),
    )
    mean, cov = (np.array([getattr(r.estimate, name) for r in reports]) for name in ("mean", "cov"))
    poses = pose_statistics(whitened_errors(WALK.space, mean, cov, truth))
    return comparison.judge([*poses, *own], [statistic.name for statistic in poses])


@pytest.mark.parametrize("seed", range(2))
def test_a_linear_gaussian_run_is_trusted(seed):
    assert linear_gaussian(1.0, seed).trust == "trust"


@pytest.mark.parametrize("claimed", [3.0, 1 / 3])
def test_a_linear_gaussian_run_with_wrong_noise_is_not(claimed):
    verdict = linear_gaussian(claimed)
    assert verdict.trust == "do not trust"
    assert ("too large" if claimed > 1.0 else "too small") in verdict.reason
    # Fixes that are weighted too little leave larger errors too: the poses are within a factor of two of what is claimed.
    assert verdict.leaning == ("" if claimed > 1.0 else "over-confident")
    assert (verdict.leaning or "innovations do not tell") in verdict.sentences[1]


def test_one_that_claims_too_much_outweighs_all_that_are_cautious():
    """A wide innovation must not hide a pose that is further off than it says."""
    cautious = variance_ratio("innovations", 0.01, 5000.0, 1.1)
    daring = variance_ratio("poses", 20.0, 50.0, 2.0)
    few_inside = coverage(np.full(200, 30.0), 6, 200.0)[:1]
    many_inside = coverage(np.full(5000, 0.1), 6, 5000.0)[:1]
    assert comparison.judge(many_inside, [many_inside[0].name]).leaning == "cautious"
    assert comparison.judge([cautious, daring]).leaning == "over-confident"
    assert comparison.judge([cautious, daring]).reason.startswith("poses: ")
    assert comparison.judge([cautious, *few_inside]).leaning == "over-confident"
    assert comparison.judge([variance_ratio("poses", 1.0, 2.0, 2.0)]).leaning == ""


def test_innovations_alone_never_say_cautious():
    """They do not see a past that the particles have forgotten: a run whose noise is too large may still claim too much."""
    small, good = variance_ratio("innovations", 0.25, 5000.0, 1.1), variance_ratio("poses", 1.0, 400.0, 2.0)
    for verdict in (comparison.judge([small]), comparison.judge([small, good], ["poses"])):
        assert (verdict.trust, verdict.leaning) == ("do not trust", "")
        assert "to which side the poses err innovations do not tell" in verdict.sentences[1]
    wide = variance_ratio("poses", 0.1, 400.0, 2.0)
    assert comparison.judge([small, wide], ["poses"], truth=["poses"]).leaning == "cautious"
    told = comparison.judge([small, good], ["poses"], truth=["poses"])  # by the truth, which has not the run's noise
    assert told.trust == "trust" and "noise is stated too large: innovations: " in told.reason
    far = variance_ratio("landmarks", 6.0, 3.0, 2.0)  # it may be far off
    assert comparison.judge([good, far], ["poses", "landmarks"]).trust == "cannot tell"
    # The batch has the run's calibration: only innovations that are not too large vouch for that.
    for more, trust in (([], "cannot tell"), ([0.8], "trust"), ([1.5], "cannot tell")):
        own = [variance_ratio(comparison.INNOVATIONS, value, 5.0, 1.1) for value in more]
        assert comparison.judge([good, *own], ["poses"]).trust == trust
    large = variance_ratio("innovations", 4.0, 5000.0, 1.1)
    assert comparison.judge([large, good], ["poses"], truth=["poses"]).leaning == "over-confident"


def test_a_stated_calibration_that_the_measurements_contradict_is_not_trusted():
    """The batch optimum has it, too, and vouches for any; a truth that supports the run says that it is good enough."""
    good, own = variance_ratio("poses", 1.0, 400.0, 2.0), variance_ratio(comparison.INNOVATIONS, 1.0, 5000.0, 1.1)
    for apart, trust in ((5.0, "cannot tell"), (7.0, "do not trust")):
        wrong = Statistic("ranges: 1 is stated", apart, apart - 3.0, apart + 3.0, (-np.inf, 3.0), 99, "calibration")
        found, names = [good, own, wrong], ["poses", wrong.name]
        verdict = comparison.judge(found, names)
        assert verdict.trust == trust and f"ranges: 1 is stated, {apart:.0f} standard deviations" in verdict.reason
        assert comparison.judge(found, names, truth=["poses"]).trust == "trust"
    for system, advice in (("range-bearing", "calibrate=odometry"), ("mono", "calibrate=online")):
        assert advice in comparison.calibration_advice(record(system), [wrong])
        assert comparison.calibration_advice(record(system, calibrate="online"), [wrong]) == ""


def test_the_path_has_a_light_of_its_own():
    """As good as the best, and ten times too sure: neither light knows of the other."""
    near = comparison.grade_path("The path is near.", 0.01, 1.0, 0, 100)
    assert near.grade == "good" and "1 % of its spread" in near.sentence and "None of 100" in near.sentence
    verdict = comparison.judge([variance_ratio("poses", 100.0, 500.0, 2.0)], ["poses"], near)
    assert (verdict.path.grade, verdict.leaning) == ("good", "over-confident")
    assert [comparison.grade_path("", e, 1.0).grade for e in (0.03, 0.05, 0.2)] == ["good", "fair", "poor"]
    assert comparison.grade_path("", None, None).grade == "not known"


def record(system: str, **config: object) -> Results:
    return Results(Path("run"), {"system": system, **config}, {"map": "joint"})


def innovations(value: float):
    return [variance_ratio(comparison.INNOVATIONS, value, 5000.0, 1.1)]


def test_where_no_setting_holds_it_the_factor_is_told_and_nothing_where_nothing_contradicts():
    assert "measurements 3 times as large" in comparison.noise_advice(record("range-bearing"), innovations(9.0))
    assert "times as large" in comparison.noise_advice(record("mono", search="damaged"), innovations(9.0))
    assert comparison.noise_advice(record("mono"), innovations(1.0)) == ""
    assert comparison.noise_advice(record("mono"), [variance_ratio(comparison.INNOVATIONS, 0.01, 50.0, 1.1)]) == ""
    assert comparison.noise_advice(record("mono"), [variance_ratio("poses", 9.0, 500.0, 2.0)]) == ""
    assert comparison.noise_advice(record("mono"), []) == ""
    for kind, value, told in ((None, 36.0, True), (None, 9.0, False), ("outliers", 36.0, False)):
        assert (
            "kind=outliers" in comparison.noise_advice(record("mono", likelihood={"kind": kind}), innovations(value))
        ) == told


def test_odometry_that_errs_alike_in_all_steps_should_be_learnt():
    """Told by many steps, none of which tells anything by itself; not where it is learnt."""
    cov, rng = np.full((3000, 1, 1), 0.01), np.random.default_rng(0)
    for bias, calibrate, advised in ((1.0, "off", True), (0.0, "off", False), (1.0, "odometry", False)):
        correction = 0.01 * bias + 0.1 * rng.normal(size=(3000, 1))
        _, found = comparison.innovation_statistics(np.ones(3000), np.ones(3000), correction, cov)
        own = record("range-bearing", calibrate=calibrate, association="known")
        advice = comparison.motion_advice(own, [found])
        assert found.kind == "bias" and ("--set calibrate=odometry" in advice) == advised


@pytest.mark.slow
@pytest.mark.parametrize("claimed", [4.0, 0.25])
def test_a_filter_of_fixes_is_told_its_noise(claimed):
    """Fixes of 1 m on a walk of 1 m per step; advice that is followed again and again ends near the truth."""
    off = abs(np.log(claimed))
    rng = np.random.default_rng(0)
    fixes = np.cumsum(rng.normal(size=(400, 2)), axis=0) + rng.normal(size=(400, 2))
    for _ in range(8):
        filter_, cov = Filter(WALK, Scripted(), n=200, rng=np.random.default_rng(1)), claimed**2 * np.eye(2)[None]
        reports = [filter_.step(seen(FIX, fix[None], cov)) for fix in fixes]
        nis = step_ratio(comparison.INNOVATIONS, *np.array([(r.nis, r.rows) for r in reports], dtype=float).T)
        advice = comparison.noise_advice(record("mono", search={"noise_px": claimed}), [nis])
        if not advice:
            break
        claimed = float(advice.split("noise_px=")[1].split(" ")[0])
    assert advice == ""
    assert abs(np.log(claimed)) < 0.25 * off
