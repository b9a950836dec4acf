"""A point in the frame of an anchor is the same landmark as the world point: whole runs agree."""

import numpy as np
import pytest

from rbpf.core.filter import Filter
from rbpf.core.models import Jacobians, ObservationModel, Observations, Records
from rbpf.core.resampling import Systematic
from rbpf.lie import SE2, SE3
from rbpf.maps.landmark_map import LandmarkMap
from rbpf.maps.point import AnchoredPoint, Point
from rbpf.motion.odometry import Odometry, OdometryMotion
from rbpf.sensors.range_bearing import RangeBearing
from tests.exactness.models import Frame, Scripted
from tests.exactness.scenes import Scene, random_covs

TOLERANCE = 1e-9
PARTICLES = 40
every_space = pytest.mark.parametrize("space", [SE2, SE3], ids=repr)


class Anchored(ObservationModel):
    """Another model, of the world point behind an anchored one."""

    def __init__(self, of: RangeBearing):
        self.of, self.dim = of, of.dim

    def predict(self, state, landmark=None, const=None, substate=None):
        return self.of.predict(state, self.of.space.transform(const, landmark))

    def jacobians(self, state, landmark=None, const=None, substate=None):
        jac = self.of.jacobians(state, self.of.space.transform(const, landmark))
        assert jac.landmark is not None
        return Jacobians(jac.state, jac.landmark @ self.of.space.rotation(const))

    def residual(self, z, predicted):
        return self.of.residual(z, predicted)


def anchored(records: Records, space, const: np.ndarray) -> Records:
    """The same estimates in the frames of anchors (N, K, E)."""
    rotation = space.rotation(const)
    mean = space.inverse_transform(const, records.mean)
    return Records(mean, np.swapaxes(rotation, -1, -2) @ records.cov @ rotation, const)


def run(space, records: Records, landmark, model: ObservationModel, truth: RangeBearing) -> Filter:
    """Eight steps, with a resampling in each; landmark 3 is unseen until the sixth."""
    rng = np.random.default_rng(77)
    held = LandmarkMap(space, compiled=False)
    motion, resampler = OdometryMotion(space), Systematic()
    filter_ = Filter(motion, Scripted(), held, None, resampler, PARTICLES, np.random.default_rng(5))
    held.add_records(records, landmark)
    landmarks, pose = landmark.homogeneous(records.mean, records.const)[0, :, :-1], space.identity()
    increment, cov = space.exp(0.2 * np.ones(space.dim)), random_covs(rng, (), space.dim, 0.05)
    for step in range(8):
        pose = space.retract(space.compose(pose, increment), rng.normal(scale=0.05, size=space.dim))
        seen = np.arange(4 if step > 4 else 3)
        z = truth.predict(pose, landmarks[seen]) + rng.normal(scale=0.1, size=(seen.size, truth.dim))
        R = np.tile(0.01 * np.eye(truth.dim), (seen.size, 1, 1))
        filter_.step(Frame([Observations(z, R, model, ids=seen)]), Odometry(increment, cov))
    return filter_


@pytest.mark.parametrize("where", ["identity", "one anchor", "an anchor per particle"])
@every_space
def test_anchored_points_equal_world_points(space, where):
    rng = np.random.default_rng(8)
    records = Scene.random(space, rng, n=PARTICLES).records
    scatter = {"identity": 0.0, "one anchor": 1.0, "an anchor per particle": 1.0}[where]
    const = space.exp(rng.normal(scale=scatter, size=(PARTICLES if "per" in where else 1, 4, space.dim)))
    const = np.array(np.broadcast_to(const, (PARTICLES, 4, space.size)))
    truth = RangeBearing(space)
    world = run(space, records, Point(truth.dim), truth, truth)
    other = run(space, anchored(records, space, const), AnchoredPoint(space), Anchored(truth), truth)

    np.testing.assert_allclose(other.particles.state, world.particles.state, atol=TOLERANCE)
    np.testing.assert_allclose(other.particles.log_weights, world.particles.log_weights, atol=1e-7)
    assert other.log_evidence == pytest.approx(world.log_evidence, abs=1e-7)
    held = other.belief().map
    before = held.read(held.ids)
    points = world.belief().read(held.ids)
    if where == "identity":
        np.testing.assert_allclose(before.mean, points.mean, atol=TOLERANCE)
    if where == "an anchor per particle":
        assert 1 < len(np.unique(before.const[:, 3, -1])) < PARTICLES
    homogeneous = AnchoredPoint(space).homogeneous(before.mean, before.const)
    np.testing.assert_array_equal(homogeneous[..., -1], 1.0)
    np.testing.assert_allclose(homogeneous[..., :-1], points.mean, atol=TOLERANCE)
    held.promote(held.ids)
    promoted = held.read(held.ids)
    np.testing.assert_allclose(promoted.mean, points.mean, atol=TOLERANCE)
    np.testing.assert_allclose(promoted.cov, points.cov, atol=TOLERANCE)
    assert promoted.const is None
