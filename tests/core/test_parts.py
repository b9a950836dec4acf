"""What is marginalised beside a landmark map and a substate: parts with names of their own, raw data, several of a kind."""

from itertools import pairwise, product
from pathlib import Path

import numpy as np
import pytest

from rbpf.conformance import Example, check_model
from rbpf.core.filter import Filter
from rbpf.core.marginals import KalmanSubstate
from rbpf.core.models import Conditional, LogDensities, Observations, Part
from rbpf.errors import InputError
from rbpf.lie import SE2, Euclidean
from rbpf.maps.joint_map import JointMap
from rbpf.maps.landmark_map import LandmarkMap
from rbpf.maps.point import Point
from rbpf.motion.odometry import OdometryMotion
from rbpf.sensors.landmark_sensor import NamedLandmarkSensor
from rbpf.sensors.range_bearing import RangeBearing
from tests.core.scripted import Scripted, fails, says
from tests.core.worlds import Recipe, drive, planar_world
from tests.exactness.models import LinearMotion, LinearObservation

MODE, BIAS, BEACONS = Part("mode"), Part("bias"), Part("beacons")
STAY = np.array([[0.9, 0.1], [0.3, 0.7]])
MEANS, STDS = np.array([-1.0, 2.0]), np.array([0.5, 1.5])


def log_normal(z, mean, std):
    return -0.5 * np.square((z - mean) / std) - np.log(std * np.sqrt(2.0 * np.pi))


class Modes(Conditional):
    """p(mode | path, data) of a Markov chain with two modes, which say how a number about the state is disturbed."""

    supplies, takes_raw = MODE, True

    def begin(self, n, lineage):
        self.log_p = np.tile(np.log([0.5, 0.5]), (n, 1))

    def predict(self, transition, space, dt):
        self.moves = dt > 0.0

    def correct(self, state, increment, groups):
        if self.moves:
            self.log_p = np.log(np.exp(self.log_p) @ STAY)
        total = np.zeros(len(state))
        for group in groups:
            joint = self.log_p + log_normal(group.data, state[:, :1] + MEANS, STDS)
            found = np.logaddexp.reduce(joint, axis=1)
            self.log_p, total = joint - found[:, None], total + found
        return LogDensities(total, total)

    def resample(self, ancestors):
        self.log_p = self.log_p[ancestors]

    def arrays(self):
        return {"log_p": self.log_p}

    def restore(self, arrays):
        self.log_p = arrays["log_p"]


def still(n=3, *parts) -> Filter:
    """A state that is known and does not move."""
    return Filter(LinearMotion(np.eye(1), np.zeros((1, 0))), Scripted(), parts, n=n, rng=np.random.default_rng(0))


def test_a_mode_that_is_marginalised_agrees_with_enumeration():
    z, filter_ = [0.3, -1.2, 2.5, 1.9, -0.7, 3.0], still(3, Modes())
    for number in z:
        filter_.step([Observations.raw(number, MODE)])
    total = -np.inf
    for modes in product((0, 1), repeat=len(z)):
        chain = np.log(0.5) + sum(np.log(STAY[a, b]) for a, b in pairwise(modes))
        total = np.logaddexp(total, chain + sum(log_normal(z, MEANS[list(modes)], STDS[list(modes)])))
    assert filter_.log_evidence == pytest.approx(total, rel=1e-12)


def test_raw_data_that_are_no_density_leave_the_evidence_out():
    filter_ = still(3, Modes())
    assert np.isnan(filter_.step([Observations.raw(0.3, MODE, normalised=False)]).log_evidence)


def test_two_substates_agree_with_the_joint_kalman_filter():
    """A velocity that drives the motion, and a bias of one sensor that moves by itself; another one reads the velocity."""
    motion = LinearMotion(np.eye(1), np.zeros((2, 0)), np.eye(1), np.eye(1), np.zeros(1))
    speed = KalmanSubstate(motion.space, np.ones(1), np.zeros((1, 1)))
    factor = np.array([[0.3]])
    bias = KalmanSubstate(
        motion.space,
        np.zeros(1),
        np.eye(1),
        BIAS,
        lambda dt: (np.array([[0.9]]), np.array([0.1]), np.sqrt(dt) * factor),
    )
    filter_ = Filter(motion, Scripted(), [speed, bias], n=4, rng=np.random.default_rng(0))
    both, z = LinearObservation(np.eye(1), np.eye(1)), np.array([0.4, 1.9, 1.7, 3.6])
    for number in z:
        filter_.step([Observations(np.array([[number]]), np.array([[[0.04]]]), both, part=BIAS)])
    # The path is known, 1, 2, 3, 4: z − x is an autoregression plus noise, a Gaussian in four dimensions.
    mean, cov, means, covs = 0.0, 1.0, [], []
    gains = np.zeros((4, 4))
    for t in range(4):
        mean, cov = 0.9 * mean + 0.1, 0.81 * cov + (0.09 if t else 0.0)
        means.append(mean)
        covs.append(cov)
        gains[t, : t + 1] = 0.9 ** np.arange(t, -1, -1)
    joint = np.array([[gains[max(i, j), min(i, j)] * covs[min(i, j)] for j in range(4)] for i in range(4)])
    joint += 0.04 * np.eye(4)
    nu = z - np.arange(1, 5) - means
    expected = -0.5 * (nu @ np.linalg.solve(joint, nu) + np.linalg.slogdet(2 * np.pi * joint)[1])
    assert filter_.log_evidence == pytest.approx(expected, rel=1e-9)
    assert filter_.marginals.parts[BIAS].mean.shape == (4, 1)


def in_two(seed: int = 1) -> Filter:
    """Even landmarks in one map, odd ones in another."""

    class Half(NamedLandmarkSensor):  # type: ignore[misc]
        def __init__(self, part, odd):
            super().__init__(RangeBearing(SE2), Point(2), part=part)
            self.odd = odd

        def of(self, frame):
            mine = frame.landmarks % 2 == self.odd
            return frame.take(mine)

        def observe(self, frame, belief):
            return super().observe(self.of(frame), belief)

        def new_landmarks(self, frame, belief, observed):
            return super().new_landmarks(self.of(frame), belief, observed)

    sensors = [Half(Part.LANDMARK, 0), Half(BEACONS, 1)]
    maps = [LandmarkMap(SE2), LandmarkMap(SE2, part=BEACONS)]
    for one in maps:
        one.register(Point(2))
    return Filter(OdometryMotion(SE2), sensors, maps, n=40, rng=np.random.default_rng(seed))


def test_two_maps_agree_with_one(tmp_path: Path):
    world, one, two = planar_world(20), Recipe().build(), in_two()
    drive(one, world)
    drive(two, world, 0, 10)
    two.save(tmp_path / "filter.npz")
    again = in_two(7)
    again.load(tmp_path / "filter.npz")
    drive(again, world, 10)
    assert again.log_evidence == pytest.approx(one.log_evidence, rel=1e-9)
    np.testing.assert_allclose(again.particles.state, one.particles.state, atol=1e-9)
    beacons = again.marginals.parts[BEACONS]
    assert isinstance(beacons, LandmarkMap)
    odd = beacons.ids
    assert odd.size and (odd % 2 == 1).all()


def test_what_does_not_fit_together_is_said():
    raw = Observations.raw(0.0, MODE)
    fails(still(3), "raw data are for a mode, which this filter does not hold", [raw])
    fails(still(3, LandmarkMap(Euclidean(1), part=MODE)), "LandmarkMap takes no raw data, only rows", [raw])
    with pytest.raises(InputError, match="two parts of the filter are named 'mode': give one of them another name"):
        still(3, Modes(), Modes())
    with pytest.raises(InputError, match="two parts of the filter are named 'landmark'"):
        Filter(OdometryMotion(SE2), Scripted(), [LandmarkMap(SE2), JointMap(SE2)])
    with pytest.raises(InputError, match="unnamed landmarks of old sub-maps are kept without constants"):
        JointMap(SE2, (np.zeros(1), np.eye(1)), submap=10, unnamed=True, constants=1)


GROUPS = Example(groups=[Observations.raw(0.4, MODE)])


def test_sound_parts():
    assert check_model(Modes(), Euclidean(1), example=GROUPS) == []


class Hasty(Modes):
    def predict(self, transition, space, dt):
        self.log_p = np.log(np.exp(self.log_p) @ STAY)
        self.moves = False


class Alike(Modes):
    """Updates in place what its copies share."""

    def correct(self, state, increment, groups):
        joint = [log_normal(group.data, state[:, :1] + MEANS, STDS) for group in groups]
        total = np.logaddexp.reduce(self.log_p + sum(joint), axis=1)
        for row, own in zip(self.log_p, sum(joint), strict=True):
            row += own - 0.5
        return LogDensities(total, total)

    def resample(self, ancestors):
        self.log_p = np.broadcast_to(self.log_p[ancestors[0]], self.log_p.shape)
        self.log_p.flags.writeable = True


class Deaf(Modes):
    def resample(self, ancestors):
        """Forgets to."""


class Late(Modes):
    def correct(self, state, increment, groups):
        total = super().correct(state, increment, groups).all
        return LogDensities(total, 0.0 * total)


class Loose(Modes):
    def restore(self, arrays):
        self.log_p = 0.5 * arrays["log_p"]


@pytest.mark.filterwarnings("ignore:Numpy has detected|setting a broadcasted|ignore::DeprecationWarning")
@pytest.mark.parametrize(
    ("part", "sentence"),
    [
        (Hasty(), "Hasty.predict changes what is held: a step may be looked at and not be taken"),
        (Alike(), "Alike.resample: copies share memory, what one particle sees changes another"),
        (Deaf(), "Deaf.resample: descendants of one particle weigh the same differently"),
        (Late(), "Late.correct: information says nothing, so that after_sampling must be all of the density"),
        (Loose(), "Loose.restore does not bring back what arrays"),
    ],
)
def test_findings_about_parts(part, sentence):
    says(check_model(part, Euclidean(1), example=GROUPS), sentence)
