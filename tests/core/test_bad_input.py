"""What a user can hand in that is wrong: one sentence each, and a filter that says in which state it is."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rbpf.core import models as core
from rbpf.core.filter import Filter
from rbpf.core.marginals import KalmanSubstate
from rbpf.core.proposals import EkfProposal, PriorProposal
from rbpf.core.resampling import EssTriggered, Systematic
from rbpf.errors import InputError
from rbpf.lie import SE2, Euclidean
from rbpf.maps.landmark_map import LandmarkMap
from rbpf.maps.point import Point
from rbpf.motion.odometry import Odometry, OdometryMotion
from rbpf.sensors.landmark_sensor import NamedLandmarkSensor
from rbpf.sensors.range_bearing import RangeBearing
from tests.core.scripted import Scripted, fails, seen
from tests.core.worlds import Recipe, content, drive, planar_world, same
from tests.exactness.models import Curved

N = 6
LINE = Euclidean(1)
STATE = Curved(np.copy)


class Walk(core.MotionModel):
    """A random walk on the line; `given` replaces parts of its transition."""

    space = LINE

    def __init__(self, **given: Any) -> None:
        self.given = given

    def transition(self, state, control, dt):
        return replace(core.Transition(state, 0.1 * np.ones((1, 1, 1))), **self.given)


def on_a_line(motion: core.MotionModel | None = None, **options) -> Filter:
    return Filter(motion or Walk(), Scripted(), n=N, rng=np.random.default_rng(0), **options)


def in_the_plane(conditional=None, **options) -> Filter:
    held = LandmarkMap(SE2) if conditional is None else conditional
    return Filter(OdometryMotion(SE2), Scripted(), held, n=N, rng=np.random.default_rng(0), **options)


# fmt: off
CONSTRUCTION: dict[str, Callable[[], object]] = {
    "at least one particle, got 0": lambda: Filter(Walk(), Scripted(), n=0),
    "keeps at least one step, got 0": lambda: Filter(Walk(), Scripted(), lag=0),
    rf"start must be \(3,\) or \({N}, 3\) finite numbers, got \(2,\)": lambda: in_the_plane(start=np.zeros(2)),
    r"start must be .*, got \(3,\): \[nan": lambda: in_the_plane(start=np.full(3, np.nan)),
    r"mean \(2,\) needs a cov of that size, got \(3, 3\)":
        lambda: KalmanSubstate(LINE, np.zeros(2), np.eye(3)),
    "negative eigenvalue": lambda: KalmanSubstate(LINE, np.zeros(2), np.diag([1.0, -1.0])),
    "iterations must be a whole number, at least 1 .*, got 0": lambda: EkfProposal(iterations=0),
    "needs a landmark map: give the filter a LandmarkMap": lambda: in_the_plane(()).belief().map,
}
# fmt: on


@pytest.mark.parametrize("message", CONSTRUCTION)
def test_construction(message):
    with pytest.raises(InputError, match=message):
        CONSTRUCTION[message]()


ODOMETRY = [
    (np.zeros(2), np.eye(3), r"odometry needs delta \(3,\) and cov \(3, 3\), got \(2,\)"),
    (np.zeros(3), -np.eye(3), "the covariance of the odometry is not valid: .*negative eigenvalue"),
    (np.zeros(3), np.triu(np.ones((3, 3))), "the covariance of the odometry is not valid: .*not symmetric"),
    (np.zeros(3), np.full((3, 3), np.nan), "the covariance of the odometry is not valid: .*not finite"),
    (np.array([0.0, np.nan, 0.0]), np.eye(3), "the odometry increment .* holds NaN or infinity"),
]


@pytest.mark.parametrize(("delta", "cov", "match"), ODOMETRY)
def test_odometry(delta, cov, match):
    fails(in_the_plane(()), match, [], Odometry(delta, cov))


def test_time_running_backwards_and_a_failed_step_that_does_not_move_the_clock():
    filter_ = on_a_line()
    filter_.step([], None, 5_000)
    fails(filter_, "time runs backwards: step 1 has stamp 4999 ns after 5000 ns", [], None, 4_999)
    fails(filter_, "is not finite", seen(STATE, [[np.nan]]), None, 9_000)
    filter_.step([], None, 5_000)
    assert (filter_.steps, filter_.stamp_ns) == (2, 5_000)


class TestMeasurements:
    @pytest.mark.parametrize("proposal", [EkfProposal(), PriorProposal()])
    @pytest.mark.parametrize(
        ("z", "cov", "match"),
        [
            ([[np.nan]], None, "a measurement of Curved or its covariance is not finite"),
            ([[1.0]], [[[np.inf]]], "a measurement of Curved or its covariance is not finite"),
            ([[1.0]], [[[-1.0]]], "the noise covariance of Curved is not valid: .*negative eigenvalue"),
            ([[1.0, 2.0]], None, r"Curved measures 1 numbers: expected z \(K, 1\) .* got \(1, 2\)"),
            ([[1.0]], [[1.0]], r"got \(1, 1\) and \(1, 1\)"),
        ],
    )
    def test_numbers_that_are_no_measurement(self, proposal, z, cov, match):
        fails(on_a_line(proposal=proposal), match, seen(STATE, z, cov))

    def test_no_particle_explains_them(self):
        # Far beyond the range of floating point is still a weight; what cannot be is none.
        filter_ = on_a_line(resampler=EssTriggered(Systematic(), 0.0))
        assert filter_.step(seen(STATE, [[1e3]], [[[1e-2]]])).log_evidence < -1e5
        filter_.step(seen(STATE, [[1e18]], [[[1e-4]]]))  # a logarithm in which that of a sum would be rounded away
        assert filter_.particles.weights.sum() == pytest.approx(1.0)
        clutter = {"ids": np.array([core.NULL]), "log_clutter": -np.inf}
        groups = seen(RangeBearing(SE2), [[5.0, 0.0]], **clutter)
        fails(in_the_plane(), "step 0: all particle weights are zero, no particle explains", groups)

    def test_one_particle_cannot_explain_them(self):
        ids = np.full((N, 1), core.NEW)
        ids[2] = core.NULL
        filter_, model = in_the_plane(resampler=EssTriggered(Systematic(), 0.0)), RangeBearing(SE2)
        filter_.step(seen(model, [[5.0, 0.0]], ids=ids, log_clutter=-np.inf, log_new=-3.0))
        expected = np.full(N, 1 / (N - 1))
        expected[2] = 0.0
        np.testing.assert_allclose(filter_.particles.weights, expected)

    def test_a_model_that_gives_nan(self):
        poisoned = Curved(np.copy)
        poisoned.predict = lambda state, *parts: state * np.nan
        fails(on_a_line(), "the weight of particle 0 is nan; check the models", seen(poisoned, [[1.0]]))


class TestModels:
    @pytest.mark.usefixtures("unchecked_shapes")
    def test_observations_of_wrong_shape(self):
        flat, slope = Curved(np.copy), Curved(np.copy)
        flat.predict = lambda *parts: np.zeros((1, 1))
        slope.jacobians = lambda state, *parts: core.Jacobians(np.ones((*state.shape[:-1], 2, 1)))
        match = rf"Curved.predict returned shape \(1, 1\), expected \({N}, 1, 1\)"
        fails(on_a_line(), match, seen(flat, [[1.0]]))
        match = rf"jacobians returned a block of shape \({N}, 1, 2, 1\), expected \({N}, 1, 1"
        fails(on_a_line(), match, seen(slope, [[1.0]]))

    @pytest.mark.parametrize(
        ("given", "match"),
        [
            ({"mean": np.zeros((N, 2))}, rf"Walk.transition returned mean \({N}, 2\)"),
            ({"noise_factor": np.ones((1, 1))}, rf"\(1, 1\): expected \({N}, 1\) and \({N} or 1, 1, r\)"),
            ({"noise_factor": np.ones((N - 1, 1, 1))}, r"noise_factor \(5, 1, 1\)"),
            ({"noise_factor": np.full((1, 1, 1), np.nan)}, "Walk.transition returned NaN or infinity: check"),
        ],
    )
    def test_transitions_of_wrong_shape(self, given, match):
        fails(on_a_line(Walk(**given)), match, [])

    def test_substates(self):
        def driving(m: int) -> Walk:
            parts = {"coupling": np.ones((1, 1, m)), "dynamics": np.eye(m)[None], "drift": np.zeros((1, m))}
            return Walk(noise_factor=np.eye(1 + m)[None], **parts)

        held = {"conditional": KalmanSubstate(LINE, np.zeros(1), np.eye(1))}
        fails(on_a_line(**held), "needs coupling, dynamics and drift of the motion model", [])
        fails(on_a_line(driving(1)), "drives a substate: give the filter a KalmanSubstate", [])
        match = r"the substate has 1 numbers: expected coupling \(·, 1, 1\)"
        fails(on_a_line(driving(2), **held), match, [])

    def test_reading_what_the_filter_does_not_hold(self):
        groups = seen(RangeBearing(SE2), [[5.0, 0.0]], ids=np.zeros(1, dtype=int))
        fails(in_the_plane(()), "RangeBearing reads a landmark, which this filter does not hold", groups)

    def test_landmark_and_substate_in_one_observation(self):
        model = RangeBearing(SE2)
        model.reads = frozenset({core.Part.STATE, core.Part.LANDMARK, core.Part.SUBSTATE})
        groups = seen(model, [[5.0, 0.0]], ids=np.zeros(1, dtype=int))
        fails(in_the_plane(), "reads a landmark and the substate, which couples them", groups)

    @pytest.mark.parametrize("ancestors", [np.zeros(N - 1, dtype=int), np.full(N, N), np.full(N, -1)])
    def test_resampler_without_manners(self, ancestors):
        class Rude(core.Resampler):
            def ancestors(self, weights, rng):
                return ancestors

        fails(on_a_line(resampler=Rude()), f"Rude must return {N} ancestors in 0..{N - 1}", [])


class TestLandmarks:
    @pytest.fixture
    def filter_(self) -> Filter:
        """Two landmarks, of which the first was removed again, and a resampling on the way."""
        filter_ = Recipe(n=N).build()
        drive(filter_, planar_world(4, landmarks=5, seed=8))
        filter_.sensors = [Scripted()]
        filter_.belief().map.remove(np.array([3]))
        return filter_

    @pytest.mark.parametrize(
        ("ids", "match"),
        [
            (None, "RangeBearing reads a landmark: its observations need ids"),
            ([3], "is of landmark 3, which is not in the map"),
            ([[4]] * (N - 1) + [[10**9]], "is of landmark 1000000000, which is not in the map"),
            ([1, 2], rf"ids of 1 measurements must be \(1,\) or \({N}, 1\), got \(2,\)"),
            ([-3], "ids of RangeBearing must be integers: landmarks, NULL = -1 or NEW = -2"),
            ([1.0], "ids of RangeBearing must be integers"),
        ],
    )
    @pytest.mark.usefixtures("unchecked_shapes")
    def test_ids(self, filter_, ids, match):
        ids = None if ids is None else np.array(ids)
        fails(filter_, match, seen(RangeBearing(SE2), [[5.0, 0.0]], ids=ids))

    def test_reading_the_map(self, filter_):
        landmark_map = filter_.belief().map
        for use in (landmark_map.read, landmark_map.remove):
            with pytest.raises(InputError, match="the map has no landmark 3"):
                use(np.array([3]))
        with pytest.raises(InputError, match="the map has no landmark 7"):
            filter_.belief().project(RangeBearing(SE2), np.array([7]))
        with pytest.raises(InputError, match="the map has no landmark -1"):
            landmark_map.landmark_of(-1)
        with pytest.raises(InputError, match="no landmark id was given"):
            landmark_map.read(np.zeros(0, dtype=int))

    def test_landmarks_that_cannot_be_added(self, filter_):
        class Bearing(RangeBearing):  # type: ignore[misc]
            invert = core.ObservationModel.invert

        held = filter_.belief().map
        new = core.NewLandmarks(np.ones((1, 2)), np.eye(2)[None], RangeBearing(SE2), Point(2))
        for changed, match in (
            ({"mask": np.ones((N, 1), dtype=bool)}, "only need a map with evidence=True"),
            ({"z": np.array([[np.nan, 0.0]])}, "a new Point has a mean or covariance that is not finite"),
            ({"model": Bearing(SE2)}, r"Bearing cannot initialise landmarks: override invert or"),
        ):
            with pytest.raises(InputError, match=match):
                held.add(replace(new, **changed), filter_.particles.state)
        with pytest.raises(InputError, match="has no log-odds: build it with evidence=True"):
            held.set_log_odds(np.array([4]), np.zeros((N, 1)))


def test_particles_of_weight_zero_do_no_harm():
    filter_ = on_a_line(resampler=EssTriggered(Systematic(), 0.0))
    filter_.particles.log_weights = np.log([0.5, 0.5, 1e-320, 1e-320, 1e-320, 1e-320])
    filter_.particles.log_weights[2] = -np.inf
    report = filter_.step(seen(STATE, [[0.3]], [[[0.01]]]))
    assert np.isfinite(report.log_evidence) and np.isfinite(report.estimate.cov).all()
    assert filter_.particles.weights[2] == 0.0


class Impossible(core.Likelihood):
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
