from dataclasses import replace

import numpy as np
import pytest

from rbpf.core.diagnostics import ancestors_by_step, coalescence_steps
from rbpf.core.genealogy import Lineage
from rbpf.core.history import History
from rbpf.errors import InputError
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.range_bearing.config import RangeBearingConfig
from rbpf.validation.consistency.monte_carlo import Consistency, left_for_good, run_trials
from rbpf.validation.consistency.trials import DeskTrial, RobotTrial, Trial
from rbpf.validation.simulation.features import Measuring
from rbpf.validation.simulation.point_worlds import DeskWorld
from rbpf.validation.simulation.robot import RobotWorld


def honest(rng: np.random.Generator, scale: float = 1.0, steps: int = 60) -> Trial:
    """A trial of a filter whose standard deviations are `scale` times too small."""
    nees = scale**2 * rng.chisquare(3, size=steps)
    nis, dof = rng.chisquare(8, size=steps), np.full(steps, 8.0)
    landmarks = scale**2 * rng.chisquare(2, size=30)
    return Trial(3, np.sqrt(nees), nees, nis, dof, landmarks, 2, np.full(steps, 5), None, 0.0)


def test_an_honest_filter_has_the_figures_of_one():
    rng = np.random.default_rng(0)
    found = Consistency([honest(rng) for _ in range(60)])
    assert found.overconfident_from is None
    assert found.pose_nees.value == pytest.approx(1.0, abs=3 * found.pose_nees.error)
    assert found.landmark_nees.value == pytest.approx(1.0, abs=3 * found.landmark_nees.error)
    assert found.nis.value == pytest.approx(1.0, abs=3 * found.nis.error)
    for probability in (0.5, 0.9, 0.95):
        coverage = found.coverage(probability)
        assert coverage.value == pytest.approx(probability, abs=4 * coverage.error)
    inside = (found.mean_nees > found.band().low) & (found.mean_nees < found.band().high)
    assert inside.mean() > 0.85
    assert found.coalescence == np.inf
    assert found.entries()["overconfident_from"] == "never"


def test_an_overconfident_filter_is_found_from_the_first_step():
    rng = np.random.default_rng(1)
    found = Consistency([honest(rng, 1.5) for _ in range(60)])
    assert found.overconfident_from == 0
    assert found.pose_nees.value == pytest.approx(2.25, rel=0.1)


def by_definition(mean: np.ndarray, high: float) -> int | None:
    """First step above the band such that, for each later step, at least half of those up to it are above."""
    above = mean > high
    for t in range(mean.size):
        if above[t] and all(above[t : s + 1].mean() >= 0.5 for s in range(t, mean.size)):
            return t if t <= mean.size - 10 else None
    return None


def test_leaving_for_good_is_what_the_definition_says():
    rng = np.random.default_rng(2)
    for _ in range(200):
        mean = rng.normal(size=50).cumsum() * 0.3 + rng.normal(size=50)
        assert left_for_good(mean, 0.5) == by_definition(mean, 0.5)


@pytest.mark.parametrize(
    ("nees", "expected"),
    [
        (np.ones(40), None),
        (np.where(np.arange(40) >= 20, 5.0, 1.0), 20),
        (np.where((np.arange(40) >= 20) & (np.arange(40) != 30), 5.0, 1.0), 20),
        (np.where(np.arange(40) == 10, 5.0, 1.0), None),
        (np.where(np.arange(40) >= 35, 5.0, 1.0), None),
        (np.where(np.arange(40) >= 1, 5.0, np.nan), 1),
    ],
    ids=[
        "never",
        "at 20",
        "with one step back",
        "one step out",
        "too late to tell",
        "after a start known exactly",
    ],
)
def test_single_steps_neither_begin_nor_end_overconfidence(nees, expected):
    assert left_for_good(nees, 2.0) == expected


def test_runs_of_different_lengths_are_refused():
    rng = np.random.default_rng(3)
    with pytest.raises(InputError, match="one kind and length"):
        Consistency([honest(rng), honest(rng, steps=50)])


def test_a_robot_that_is_told_three_times_too_little_noise_is_overconfident():
    from rbpf.validation.faults import scale_sensor_noise

    trial = RobotTrial(RobotWorld(steps=50), RangeBearingConfig(particles=50))
    good = run_trials(trial, range(3))
    bad = run_trials(replace(trial, spoil=lambda log, rng: scale_sensor_noise(log, 1 / 3)), range(3))
    assert good.pose_nees.value < 4.0 < bad.pose_nees.value
    assert 0.8 < good.nis.value < 1.3 < 5.0 < bad.nis.value
    assert bad.overconfident_from is not None


def test_a_desk_trial_counts_points_and_ancestors():
    trial = DeskTrial(DeskWorld(frames=40), MonoConfig(particles=20))
    found = run_trials(trial, [0]).trials[0]
    assert found.ancestors.shape == (40,)
    assert found.ancestors[-1] == 20
    assert (np.diff(found.ancestors) >= 0).all()
    assert 0.1 < np.nanmean(found.nees) / 6 < 10
    assert found.distances.max() < 0.05


def test_a_desk_without_known_points_has_no_world_to_tell_errors_in():
    with pytest.raises(InputError, match="4 known points"):
        DeskTrial(DeskWorld(), MonoConfig(), Measuring(known=0))


def test_ancestors_and_coalescence_follow_the_lineage():
    lineage = Lineage(4)
    history = History(lineage)
    for step, ancestors in enumerate([None, [0, 0, 1, 1], [2, 2, 3, 3], None, [0, 1, 2, 2]]):
        if ancestors is not None:
            lineage.advance(np.array(ancestors))
        history.record(step, np.zeros((4, 3)), np.zeros(4))
    # the last generation descends from rows 0, 1, 2 of the third, those from 2 and 3 of the second, these from row 1
    np.testing.assert_array_equal(ancestors_by_step(history), [1, 2, 3, 3, 4])
    assert coalescence_steps(history) == 4
    assert coalescence_steps(History(Lineage(2))) is None
