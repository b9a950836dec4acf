"""Known points, exact or uncertain, marginalised: the joint EKF of all of them on a path that is known."""

import numpy as np
import pytest

from rbpf import gaussian
from rbpf.core.genealogy import Lineage
from rbpf.core.models import Observations, Records
from rbpf.core.particles import Prior
from rbpf.lie import SE3, skew
from rbpf.maps.constellation import Constellation
from rbpf.maps.landmark_map import LandmarkMap
from rbpf.sensors.camera.points import MembersView
from tests.exactness.models import Kalman
from tests.sensors.camera_scenes import DISTORTED

POINTS = np.random.default_rng(0).uniform([-0.5, -0.4, -0.3], [0.5, 0.4, 0.3], size=(4, 3))
STD = 0.02
COV_FRAME = np.diag(np.repeat([0.02**2, 0.04**2], 3))
NOISE_PX = 1.5
SEEN = [np.array([0, 1, 2, 3]), np.array([3, 1]), np.array([2, 0, 1]), np.array([0])]
every_group = pytest.mark.parametrize("errors", [True, False], ids=["errors", "exact"])
every_path = pytest.mark.parametrize("compiled", [True, False], ids=["compiled", "numpy"])


class World:
    """A camera moves past a group whose frame was drawn from its prior, and each of whose points, where they have errors."""

    def __init__(self, errors: bool, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.std = STD if errors else 0.0
        self.given = SE3.exp(np.array([0.3, -0.2, 0.1, 0.5, 0.2, 3.0]))
        self.group = Constellation(POINTS, np.tile(self.std**2 * np.eye(3), (4, 1, 1)))
        first = self.started(1)
        self.mean, self.cov = first.mean[0, 0], first.cov[0, 0]
        self.true = self.mean + gaussian.psd_factor(self.cov) @ rng.standard_normal(self.mean.size)
        steps = rng.normal(scale=[0.05, 0.05, 0.05, 0.2, 0.2, 0.2], size=(len(SEEN), 6))
        self.path = SE3.exp(steps)
        self.views = [MembersView(DISTORTED, seen) for seen in SEEN]
        self.z = [
            view.predict(pose, self.true) + NOISE_PX * rng.standard_normal(view.dim)
            for view, pose in zip(self.views, self.path, strict=True)
        ]

    def started(self, n: int) -> Records:
        """Where the frame puts the points, with what frame and errors do to them."""
        turn = SE3.rotation(self.given)
        by_frame = np.concatenate([np.hstack([-turn @ skew(point), turn]) for point in POINTS])
        by_errors = np.kron(np.eye(4), turn)
        cov = by_frame @ COV_FRAME @ by_frame.T + self.std**2 * by_errors @ by_errors.T
        return self.group.started(n, SE3.transform(self.given, POINTS), cov)

    def map(self, n: int, compiled: bool) -> LandmarkMap:
        held = LandmarkMap(SE3, compiled=compiled)
        held.begin(n, Lineage(n))
        held.add_records(self.started(n), self.group)
        return held

    def observed(self, t: int) -> Observations:
        cov = NOISE_PX**2 * np.eye(self.views[t].dim)[None]
        return Observations(self.z[t][None], cov, self.views[t], ids=np.array([0]))


def slope(view: MembersView, pose: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Numeric derivative by the landmark."""
    step = 1e-6
    columns = [
        view.predict(pose, mean + step * axis) - view.predict(pose, mean - step * axis) for axis in np.eye(mean.size)
    ]
    return np.stack(columns, axis=-1) / (2 * step)


@every_path
@every_group
def test_joint_ekf(errors, compiled):
    """Means, covariances and densities after every frame, all particles on the path."""
    world = World(errors, seed=3)
    held = world.map(3, compiled)
    ekf = Kalman(world.mean, world.cov)
    for t, (view, pose) in enumerate(zip(world.views, world.path, strict=True)):
        before = ekf.log_evidence
        H = slope(view, pose, ekf.mean)
        residual = world.z[t] - view.predict(pose, ekf.mean)
        ekf.update(residual + H @ ekf.mean, H, NOISE_PX**2 * np.eye(view.dim))
        density = held.correct(np.tile(pose, (3, 1)), np.zeros((3, 6)), [world.observed(t)]).all
        np.testing.assert_allclose(density, ekf.log_evidence - before, rtol=1e-5)
        records = held.read(held.ids)
        scale = np.sqrt(np.diag(ekf.cov))
        np.testing.assert_allclose((records.mean[:, 0] - ekf.mean) / scale, 0.0, atol=1e-4)
        np.testing.assert_allclose((records.cov[:, 0] - ekf.cov) / np.outer(scale, scale), 0.0, atol=1e-5)
    if errors:
        assert np.abs((ekf.cov / np.outer(scale, scale))[:3, 3:]).max() > 0.1


@every_group
def test_information_of_a_frame_has_the_frames_uncertainty(errors):
    """Λ = Hᵀ(J P Jᵀ + R)⁻¹H about the pose; a frame that is known says more."""
    world = World(errors, seed=4)
    pose, prior = world.path[:1], Prior.exactly(SE3, world.path[:1])
    held = world.map(1, True)
    found = held.information(pose, [world.observed(0)], prior).info[0]
    mean, cov = held.read(held.ids).mean[0, 0], held.read(held.ids).cov[0, 0]
    J = slope(world.views[0], pose[0], mean)
    moves = np.stack([SE3.retract(pose[0], sign * 1e-6 * np.eye(6)) for sign in (1.0, -1.0)])
    ahead, back = world.views[0].predict(moves, mean)
    H = (ahead - back).T / 2e-6
    R = NOISE_PX**2 * np.eye(len(J))
    expected = H.T @ np.linalg.solve(J @ cov @ J.T + R, H)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5 * np.abs(expected).max())
    known = H.T @ np.linalg.solve(R, H)
    assert np.linalg.eigvalsh(known - found).min() > 0.0
