"""Failures that were silent are told of, and filters that are sound are not suspected."""

import warnings
from dataclasses import replace

import numpy as np
import pytest

from rbpf.core.diagnostics import Health, HealthWarning
from rbpf.core.filter import Filter
from rbpf.core.models import LikelihoodSensor, MotionModel, Transition
from rbpf.core.proposals import PriorProposal
from rbpf.lie import SE2, Euclidean, Product
from tests.core.scripted import Scripted, seen
from tests.core.worlds import Recipe, drive, planar_world
from tests.exactness.models import Curved, LinearMotion

PERIOD, FIX_EVERY, STD_FIX = 0.1, 10, 0.5
FIX = Curved(lambda state: state[..., 1:3], dim=2)


class Wheeled(MotionModel):
    """A pose and the gyroscope's bias, which is sampled; the control is turn rate [rad/s] and speed [m/s]."""

    space = Product(SE2, Euclidean(1))

    def transition(self, state, control, dt):
        pose, bias = self.space.split(state)
        twist = np.concatenate([control[0] - bias, np.full_like(bias, control[1]), 0.0 * bias], axis=1)
        return Transition(
            self.space.join([SE2.retract(pose, dt * twist), bias]), np.diag([0.002, 0.01, 0.001, 0.0])[None]
        )


def driven(n: int, seconds: int, bias_std: float = 0.1) -> Filter:
    """Fixes at 1 Hz, wheels and a gyroscope ten times as often."""
    rng, pose, bias = np.random.default_rng(2), SE2.identity(), 0.15
    start = np.zeros((n, 4))
    start[:, 3] = bias_std * rng.standard_normal(n)
    filter_ = Filter(Wheeled(), Scripted(), n=n, rng=np.random.default_rng(3), start=start)
    for t in range(int(seconds / PERIOD)):
        rates = np.array([0.2 * np.sin(0.05 * t), 5.0])
        if t:
            moved = PERIOD * np.array([*rates, 0.0]) + np.array([0.002, 0.01, 0.001]) * rng.standard_normal(3)
            pose = SE2.retract(pose, moved)
        fixes = []
        if t % FIX_EVERY == 0:
            fixes = seen(FIX, [pose[1:] + STD_FIX * rng.standard_normal(2)], STD_FIX**2 * np.eye(2)[None])
        filter_.step(fixes, rates + np.array([bias, 0.0]), int(t * PERIOD * 1e9))
    return filter_


def findings(filter_: Filter) -> set[str]:
    return set(filter_.health.findings)


def test_a_filter_that_has_diverged_says_so():
    """Too few particles for a bias: the fixes are left behind, for good."""
    with pytest.warns(HealthWarning) as caught:
        filter_ = driven(50, 100)
    assert findings(filter_) >= {"innovations", "copies"}
    assert [str(warning.message) for warning in caught] == list(filter_.health.findings.values()), "each is told once"
    assert "step 200: squared innovations are " in filter_.health.findings["innovations"]
    assert "have had all the weight" in filter_.health.findings.get("weights", "have had all the weight")


def test_a_bias_that_is_a_copy_in_all_particles_is_told_before_anything_diverges():
    with pytest.warns(HealthWarning, match=r"component 3 of the state has \d+ values left among 100 particles"):
        filter_ = driven(100, 20)
    assert findings(filter_) == {"copies"}


class Level(LikelihoodSensor):
    """Weights alone: no innovation tells."""

    def log_likelihood(self, frame, state):
        return -0.5 * np.square(frame - state[:, 0]) - 0.5 * np.log(2 * np.pi)


class Still(MotionModel):
    space = Euclidean(1)

    def sample(self, state, control, dt, rng):
        return state + 0.1 * rng.standard_normal(state.shape)


def follow(filter_: Filter, levels: np.ndarray) -> None:
    for level in levels:
        filter_.step(level)


@pytest.mark.parametrize("proposal", [None, PriorProposal()])
def test_evidence_that_collapses(proposal):
    rng = np.random.default_rng(0)
    filter_ = Filter(Still(), Level(), proposal=proposal, n=100, rng=rng)
    follow(filter_, rng.standard_normal(80))
    assert not filter_.health.findings
    with pytest.warns(HealthWarning):
        follow(filter_, np.linspace(40.0, 400.0, 30))
    assert "the log-evidence per component fell from" in filter_.health.findings["evidence"]


def test_sound_filters_are_not_suspected():
    """Known and unknown association, a first fix that decides between guesses, an outlier."""
    for known in (True, False):
        filter_ = Recipe(known=known, n=40).build()
        drive(filter_, planar_world(80, seed=3, clutter=0.0 if known else 0.5))
        assert not filter_.health.findings
    filter_ = Filter(Still(), Level(), n=100, rng=(rng := np.random.default_rng(1)))
    for t in range(300):
        filter_.step(rng.standard_normal() * (30.0 if t % 50 == 7 else 1.0))
    assert not filter_.health.findings
    # At a repeated time stamp nothing makes copies differ.
    filter_ = Filter(motion := LinearMotion(np.eye(1), np.eye(1)), Scripted(), proposal=PriorProposal(), n=100, rng=rng)
    for std in (*[100.0] * 19, 1e-3, 1e-3):
        filter_.step(seen(Curved(np.copy), [[0.0]], [[[std**2]]]))
        motion.L = np.eye(1) * (std > 1.0)
    assert not filter_.health.findings


def test_noise_that_is_stated_too_large_is_a_remark_and_no_finding():
    """A third of it is the band's other side, a failure."""
    world, found = planar_world(80, seed=3), []
    for factor in (0.3, 1.0, 3.0):
        frames = [replace(frame, cov_z=factor**2 * frame.cov_z) for frame in world.frames]
        controls = [control and replace(control, cov=factor**2 * control.cov) for control in world.controls]
        filter_ = Recipe(n=40).build()
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", HealthWarning)
            drive(filter_, replace(world, frames=frames, controls=controls))
        found.append((findings(filter_), len(caught)))
        assert ("caution" in filter_.health.remarks) == (factor == 3.0)
    assert found[1:] == [(set(), 0), (set(), 0)]
    assert "innovations" in found[0][0] and found[0][1] == len(found[0][0])
    assert "stated too large" in filter_.health.remarks["caution"]


def test_a_resampled_filter_with_few_particles_is_judged_by_particles_not_by_fractions():
    health = Health(5, Euclidean(1))
    for step in range(100):
        health.states(step, np.zeros((5, 1)))
        health.innovations(step, 1.0, 1.0, 2.5)
        health.descendants(step, np.array([0, 1, 2, 2, 2]))
    assert not health.findings

    def coalesce() -> None:
        for step in range(100, 130):
            health.descendants(step, np.zeros(5, dtype=np.int64))

    with pytest.warns(HealthWarning, match="all 5 particles descend from 1 of those before"):
        coalesce()
