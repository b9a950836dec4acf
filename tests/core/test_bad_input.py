"""What a user can hand in that is wrong: one sentence each, and a filter that says in which state it is."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rbpf.core.filter import Filter
from rbpf.core.models import (
    NEW,
    NULL,
    Jacobians,
    Likelihood,
    MotionModel,
    ObservationModel,
    Part,
    Resampler,
    Transition,
)
from rbpf.core.proposals import EkfProposal, PriorProposal
from rbpf.core.resampling import EssTriggered, Systematic
from rbpf.core.substate import KalmanSubstate
from rbpf.errors import InputError
from rbpf.lie import SE2, Euclidean
from rbpf.maps.landmark_map import LandmarkMap
from rbpf.motion.odometry import OdometryMotion
from rbpf.sensors.landmark_sensor import NamedLandmarkSensor
from rbpf.sensors.range_bearing import RangeBearing
from tests.core.scripted import Scripted, fails, seen
from tests.core.worlds import Recipe, content, drive, planar_world, same

N = 6
LINE = Euclidean(1)


class Position(ObservationModel):
    """The state itself."""

    dim = 1
    reads = frozenset({Part.STATE})

    def predict(self, state, landmark=None, const=None, substate=None):
        return state.copy()


class Walk(MotionModel):
    """A random walk on the line; `given` replaces parts of its transition."""

    space = LINE

    def __init__(self, **given: Any) -> None:
        self.given = given

    def transition(self, state, control, dt):
        return replace(Transition(state, 0.1 * np.ones((1, 1, 1))), **self.given)


def on_a_line(motion: MotionModel | None = None, **options) -> Filter:
    return Filter(motion or Walk(), Scripted(), n=N, rng=np.random.default_rng(0), **options)


class TestConstruction:
    @pytest.mark.parametrize("n", [0, -3])
    def test_no_particles(self, n):
        with pytest.raises(InputError, match=f"at least one particle, got {n}"):
            Filter(Walk(), Scripted(), n=n)

    @pytest.mark.parametrize("lag", [0, -1])
    def test_no_lag(self, lag):
        with pytest.raises(InputError, match=f"keeps at least one step, got {lag}"):
            Filter(Walk(), Scripted(), lag=lag)

    def test_two_maps(self):
        with pytest.raises(InputError, match="at most one landmark map and one Kalman substate"):
            Filter(OdometryMotion(SE2), Scripted(), [LandmarkMap(SE2), LandmarkMap(SE2)])

    @pytest.mark.parametrize(
        "start", [np.zeros(2), np.zeros((N - 1, 3)), np.zeros((N, 2)), np.full(3, np.nan)]
    )
    def test_start_of_wrong_shape(self, start):
        with pytest.raises(InputError, match=rf"start must be \(3,\) or \({N}, 3\) finite numbers"):
            Filter(OdometryMotion(SE2), Scripted(), n=N, start=start)

    def test_substate_of_wrong_shape(self):
        with pytest.raises(InputError, match=r"mean \(2,\) needs a square cov of that size, got \(3, 3\)"):
            KalmanSubstate(LINE, np.zeros(2), np.eye(3))

    def test_substate_without_a_covariance(self):
        with pytest.raises(InputError, match="negative eigenvalue"):
            KalmanSubstate(LINE, np.zeros(2), np.diag([1.0, -1.0]))

    def test_iterations(self):
        with pytest.raises(InputError, match="at least one iteration, got 0"):
            EkfProposal(iterations=0)


class TestTime:
    def test_running_backwards(self):
        filter_ = on_a_line()
        filter_.step([], None, 5_000)
        fails(filter_, "time runs backwards: step 1 has stamp 4999 ns after 5000 ns", [], None, 4_999)
        filter_.step([], None, 5_000)
        assert filter_.steps == 2

    def test_a_failed_step_does_not_move_the_clock(self):
        filter_ = on_a_line()
        filter_.step([], None, 1_000)
        fails(filter_, "is not finite", seen(Position(), [[np.nan]]), None, 9_000)
        filter_.step([], None, 2_000)
        assert filter_.stamp_ns == 2_000


class TestMeasurements:
    @pytest.mark.parametrize("proposal", [EkfProposal(), PriorProposal()])
    @pytest.mark.parametrize(
        ("groups", "match"),
        [
            (seen(Position(), [[np.nan]]), "a measurement of Position or its covariance is not finite"),
            (
                seen(Position(), [[1.0]], [[[np.inf]]]),
                "a measurement of Position or its covariance is not finite",
            ),
            (
                seen(Position(), [[1.0]], [[[-1.0]]]),
                "the noise of Position has no covariance: .*negative eigenvalue",
            ),
            (
                seen(Position(), [[1.0, 2.0]]),
                r"Position measures 1 numbers: expected z \(K, 1\) .* got \(1, 2\)",
            ),
            (seen(Position(), [1.0]), r"Position measures 1 numbers: expected z \(K, 1\)"),
            (seen(Position(), [[1.0]], [[1.0]]), r"got \(1, 1\) and \(1, 1\)"),
        ],
    )
    def test_numbers_that_are_no_measurement(self, proposal, groups, match):
        fails(on_a_line(proposal=proposal), match, groups)

    def test_skewed_covariance(self):
        groups = seen(RangeBearing(SE2), [[1.0, 2.0]], [[[1.0, 0.5], [0.2, 1.0]]], ids=np.zeros(1, dtype=int))
        filter_ = Filter(OdometryMotion(SE2), Scripted(), LandmarkMap(SE2), n=N)
        fails(filter_, "the noise of RangeBearing has no covariance: .*is not symmetric", groups)

    def test_no_particle_explains_them(self):
        # Far beyond the range of floating point is still a weight; what cannot be is none.
        assert on_a_line().step(seen(Position(), [[1e3]], [[[1e-2]]])).log_evidence < -1e5
        clutter = {"ids": np.array([NULL]), "log_clutter": -np.inf}
        filter_ = Filter(OdometryMotion(SE2), Scripted(), LandmarkMap(SE2), n=N)
        groups = seen(RangeBearing(SE2), [[5.0, 0.0]], **clutter)
        fails(filter_, "step 0: all particle weights are zero, no particle explains", groups)

    def test_one_particle_cannot_explain_them(self):
        ids = np.full((N, 1), NEW)
        ids[2] = NULL
        filter_ = Filter(
            OdometryMotion(SE2),
            Scripted(),
            LandmarkMap(SE2),
            resampler=EssTriggered(Systematic(), 0.0),
            n=N,
            rng=np.random.default_rng(0),
        )
        model = RangeBearing(SE2)
        filter_.step(seen(model, [[5.0, 0.0]], ids=ids, log_clutter=-np.inf, log_new=-3.0))
        expected = np.full(N, 1 / (N - 1))
        expected[2] = 0.0
        np.testing.assert_allclose(filter_.particles.weights, expected)

    def test_a_model_that_gives_nan(self):
        fails(on_a_line(), "the weight of particle 0 is nan; check the models", seen(Poisoned(), [[1.0]]))


class Poisoned(Position):
    """Predicts NaN."""

    def predict(self, state, landmark=None, const=None, substate=None):
        return state * np.nan


class Flat(Position):
    """Forgets the particles."""

    def predict(self, state, landmark=None, const=None, substate=None):
        return np.zeros((1, 1))


class WrongSlope(Position):
    """A Jacobian for two numbers."""

    def jacobians(self, state, landmark=None, const=None, substate=None):
        return Jacobians(np.ones((*state.shape[:-1], 2, 1)))


class TestModels:
    @pytest.mark.parametrize(
        ("model", "match"),
        [
            (Flat(), rf"Flat.predict returned shape \(1, 1\), expected \({N}, 1, 1\)"),
            (
                WrongSlope(),
                rf"WrongSlope.jacobians returned a block of shape \({N}, 1, 2, 1\), expected \({N}, 1, 1",
            ),
        ],
    )
    @pytest.mark.usefixtures("unchecked_shapes")
    def test_observations_of_wrong_shape(self, model, match):
        fails(on_a_line(), match, seen(model, [[1.0]]))

    @pytest.mark.parametrize(
        ("given", "match"),
        [
            ({"mean": np.zeros((N, 2))}, rf"returned mean \({N}, 2\)"),
            ({"mean": np.zeros(1)}, r"returned mean \(1,\)"),
            (
                {"noise_factor": np.ones((1, 1))},
                rf"noise_factor \(1, 1\): expected \({N}, 1\) and \({N} or 1, 1, r\)",
            ),
            ({"noise_factor": np.ones((1, 2, 1))}, r"noise_factor \(1, 2, 1\)"),
            ({"noise_factor": np.ones((N - 1, 1, 1))}, r"noise_factor \(5, 1, 1\)"),
            (
                {"noise_factor": np.full((1, 1, 1), np.nan)},
                "returned NaN or infinity: check the control",
            ),
            ({"mean": np.full((N, 1), np.inf)}, "returned NaN or infinity: check the control"),
        ],
    )
    def test_transitions_of_wrong_shape(self, given, match):
        fails(on_a_line(Walk(**given)), f"Walk.transition {match}" if "returned" in match else match, [])

    def test_substate_that_nobody_drives(self):
        filter_ = on_a_line(conditional=KalmanSubstate(LINE, np.zeros(1), np.eye(1)))
        fails(filter_, "must give coupling, dynamics and drift: the filter has a Kalman substate", [])

    def test_substate_that_nobody_holds(self):
        parts = {"coupling": np.ones((1, 1, 1)), "dynamics": np.ones((1, 1, 1)), "drift": np.zeros((1, 1))}
        motion = Walk(noise_factor=np.eye(2)[None], **parts)
        fails(on_a_line(motion), "drives a substate: give the filter a KalmanSubstate", [])

    def test_substate_of_another_size(self):
        parts = {"coupling": np.ones((1, 1, 2)), "dynamics": np.eye(2)[None], "drift": np.zeros((1, 2))}
        motion = Walk(noise_factor=np.eye(3)[None], **parts)
        filter_ = on_a_line(motion, conditional=KalmanSubstate(LINE, np.zeros(1), np.eye(1)))
        fails(filter_, r"the substate has 1 numbers: expected coupling \(·, 1, 1\)", [])

    def test_reading_what_the_filter_does_not_hold(self):
        groups = seen(RangeBearing(SE2), [[5.0, 0.0]], ids=np.zeros(1, dtype=int))
        filter_ = Filter(OdometryMotion(SE2), Scripted(), n=N)
        fails(filter_, "RangeBearing reads a landmark, which this filter does not hold", groups)

    def test_landmark_and_substate_in_one_observation(self):
        model = RangeBearing(SE2)
        model.reads = frozenset({Part.STATE, Part.LANDMARK, Part.SUBSTATE})
        groups = seen(model, [[5.0, 0.0]], ids=np.zeros(1, dtype=int))
        filter_ = Filter(OdometryMotion(SE2), Scripted(), LandmarkMap(SE2), n=N)
        fails(filter_, "reads a landmark and the substate, which couples them", groups)

    @pytest.mark.parametrize("ancestors", [np.zeros(N - 1, dtype=int), np.full(N, N), np.full(N, -1)])
    def test_resampler_without_manners(self, ancestors):
        class Rude(Resampler):
            def ancestors(self, weights, rng):
                return ancestors

        fails(on_a_line(resampler=Rude()), f"Rude must return {N} ancestors in 0..{N - 1}", [])


def test_particles_of_weight_zero_do_no_harm():
    filter_ = on_a_line(resampler=EssTriggered(Systematic(), 0.0))
    filter_.particles.log_weights = np.log([0.5, 0.5, 1e-320, 1e-320, 1e-320, 1e-320])
    filter_.particles.log_weights[2] = -np.inf
    report = filter_.step(seen(Position(), [[0.3]], [[[0.01]]]))
    assert np.isfinite(report.log_evidence)
    assert np.isfinite(report.estimate.cov).all()
    assert filter_.particles.weights[2] == 0.0


class Impossible(Likelihood):
    """Zero everywhere, which only the correction finds out."""

    def log_density(self, nu, cov):
        return np.full(nu.shape[:-1], -np.inf)


def test_a_failed_correction_is_undone_by_loading(tmp_path):
    recipe, world = Recipe(n=N), planar_world(6, seed=2)
    filter_ = recipe.build()
    drive(filter_, world, 0, 4)
    filter_.save(tmp_path / "run.npz")
    before = content(filter_)
    (sensor,) = filter_.sensors
    assert isinstance(sensor, NamedLandmarkSensor)
    sensor.likelihood = Impossible()
    with pytest.raises(InputError, match="step 4: all particle weights are zero"):
        drive(filter_, world, 4)
    sensor.likelihood = None
    filter_.load(tmp_path / "run.npz")
    assert same(content(filter_), before)
    drive(filter_, world, 4)
    uninterrupted = recipe.build()
    drive(uninterrupted, world)
    assert same(content(filter_), content(uninterrupted))
