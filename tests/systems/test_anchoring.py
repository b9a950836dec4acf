"""The start re-estimated in each particle's world, and poses relative to it."""

import numpy as np
import pytest

from rbpf.core.filter import Filter
from rbpf.core.proposals import EkfProposal
from rbpf.errors import InputError
from rbpf.lie import SE2, SE3
from rbpf.maps.landmark_map import LandmarkMap
from rbpf.maps.point import Point
from rbpf.motion.odometry import Odometry, OdometryMotion
from rbpf.sensors.landmark_sensor import NamedLandmarkSensor
from rbpf.sensors.range_bearing import RelativePosition
from rbpf.sensors.readers import Frame
from rbpf.systems.anchoring import Anchored, StartAnchor, relative_estimate

COV_Z = np.diag([0.04, 0.09])
LANDMARKS = np.array([[4.0, 1.0], [3.0, -2.0], [6.0, 0.5], [5.0, 3.0]])


def frame(rng, pose, stamp_ns):
    z = SE2.inverse_transform(pose, LANDMARKS) + rng.multivariate_normal(np.zeros(2), COV_Z, len(LANDMARKS))
    names = np.arange(len(LANDMARKS))
    return Frame(stamp_ns, None, None, names, z, np.repeat(COV_Z[None], len(LANDMARKS), axis=0))


def started(n):
    model, own = RelativePosition(SE2), LandmarkMap(SE2)
    sensor, anchor = NamedLandmarkSensor(model, Point(2)), StartAnchor(own, model, 1)
    filter_ = Filter(OdometryMotion(SE2), sensor, [own, anchor], EkfProposal(), n=n, rng=np.random.default_rng(0))
    return filter_, anchor


CONTROL = Odometry(np.array([0.1, 0.5, 0.0]), np.diag([0.02, 0.1, 0.1]) ** 2)


def drive(steps):
    rng = np.random.default_rng(100)
    filter_, anchor = started(50)
    pose = SE2.identity()
    for t in range(steps):
        control = CONTROL if t else None
        if t:
            pose = SE2.retract(SE2.compose(pose, CONTROL.delta), np.sqrt(np.diag(CONTROL.cov)) * rng.standard_normal(3))
        report = filter_.step(frame(rng, pose, t * 10**9), control, t * 10**9)
        anchored = anchor.after_step(report)
    return filter_, anchor, anchored


def test_law_of_the_start_equals_the_joint_gaussian():
    """Against a plain information-form solution: odometry from x_0 to x_1, first frame against the rest of the map."""
    filter_, anchor, _ = drive(4)
    anchored = anchor.estimate()
    records = filter_.belief().read(np.arange(len(LANDMARKS)))
    x1, z0 = anchor._second, anchor._z
    model = RelativePosition(SE2)
    for i in (0, 17, 49):
        start = SE2.compose(x1[i], SE2.inverse(CONTROL.delta))
        adjoint = SE2.adjoint(CONTROL.delta)
        prior_info = np.linalg.inv(adjoint @ CONTROL.cov @ adjoint.T)
        x, origin = start, start
        for _ in range(2):
            offset = SE2.local(origin, x)
            info, vector = prior_info.copy(), -prior_info @ offset
            for k in range(len(LANDMARKS)):
                info_map = np.linalg.inv(records.cov[i, k])
                j0 = model.jacobians(np.zeros(3), records.mean[i, k]).landmark
                without = np.linalg.inv(info_map - j0.T @ np.linalg.inv(COV_Z) @ j0)
                gap = z0[k] - model.predict(np.zeros(3), records.mean[i, k])
                mean = records.mean[i, k] - without @ j0.T @ np.linalg.inv(COV_Z) @ gap
                jac = model.jacobians(x, mean)
                h = jac.state @ SE2.right_jacobian(offset)
                s = np.linalg.inv(jac.landmark @ without @ jac.landmark.T + COV_Z)
                info += h.T @ s @ h
                vector += h.T @ s @ (z0[k] - model.predict(x, mean))
            step = np.linalg.solve(info, vector)
            x = SE2.retract(origin, offset + step)
        np.testing.assert_allclose(anchored.mean[i], x, atol=1e-9)
        factor = anchored.factor[i]
        np.testing.assert_allclose(factor @ factor.T, np.linalg.inv(info), atol=1e-9)


def test_zero_period_is_refused():
    with pytest.raises(InputError, match="every 1, 2"):
        StartAnchor(LandmarkMap(SE2), RelativePosition(SE2), 0)


# Poses relative to a frame that each particle knows in its own world, up to a covariance.

every_space = pytest.mark.parametrize("space", [SE2, SE3], ids=repr)


def draw(space, n: int, spread: float, seed: int = 0):
    """Weighted particles whose own worlds differ much more than their poses relative to the frame."""
    rng = np.random.default_rng(seed)
    frames = space.exp(rng.normal(size=(n, space.dim)))
    relative = space.retract(space.exp(np.full(space.dim, 0.7)), spread * rng.normal(size=(n, space.dim)))
    factor = 0.02 * rng.normal(size=(n, space.dim, space.dim + 1))
    log_weights = np.log(rng.dirichlet(np.ones(n)))
    return Anchored(frames, factor), space.compose(frames, relative), relative, log_weights


@every_space
def test_covariance_of_the_frame_is_turned_into_the_poses_chart(space):
    """Against samples of x_0 = mean Exp(F e) of one particle."""
    anchored, state, _, _ = draw(space, 1, 0.0)
    found = relative_estimate(space, anchored, state, np.zeros(1))
    n, factor = 100_000, anchored.factor[0]
    noise = np.random.default_rng(1).standard_normal((n, factor.shape[1]))
    moved = space.between(space.retract(anchored.mean, noise @ factor.T), state)
    errors = space.local(found.mean, moved)
    scale = np.sqrt(np.outer(np.diag(found.cov), np.diag(found.cov)))
    assert (np.abs(np.cov(errors.T) - found.cov) / scale).max() < 0.05
    assert (np.abs(factor @ factor.T - found.cov) / scale).max() > 0.1
