"""The compiled twins of the camera's models equal NumPy: rays, points and the points of constellations."""

import numpy as np
import pytest

from rbpf.conformance import check_model
from rbpf.core.models import ObservationModel
from rbpf.lie import SE3
from rbpf.sensors.camera import Pinhole, RectifiedStereo
from rbpf.sensors.camera.kernels import in_view, project
from rbpf.sensors.camera.points import CameraPoint, CameraRay, EpipolarRay, MembersView, StereoPoint
from rbpf.systems.mono.feature_table import directions
from tests.exactness.models import known
from tests.sensors.camera_scenes import CAMERAS, DISTORTED, PLAIN, Rays, compiled, with_velocity

Z = np.array([250.0, 310.0])
RIG = RectifiedStereo(PLAIN, 0.12)
every_camera = pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS.keys())


def assert_twins(model, z, pose, mean, const, tolerance=1e-10):
    """Relative to the largest number of each result: differences of large numbers are no better than these.

    With the pose alone as the state, and with a velocity behind it.
    """
    for state in (pose, with_velocity(pose)):
        nu, by_state, by_landmark = compiled(model, z, state, mean, const)
        jacobians = known(model.jacobians(state, mean, const))
        expected = (model.innovation(z, state, mean, const), known(jacobians.state)[..., :6], known(jacobians.landmark))
        for found, plain in zip((nu, by_state, by_landmark), expected, strict=True):
            assert np.isfinite(plain).all()
            np.testing.assert_allclose(found, plain, rtol=tolerance, atol=tolerance * np.abs(plain).max())


def lanes(seed: int, moved: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """31 lanes: states, rays, their points and anchors."""
    rays = Rays.random(31, 1, seed, moved)
    return rays.state, rays.mean[:, 0], rays.points[:, 0], rays.const[:, 0]


@every_camera
@pytest.mark.parametrize("moved", [0.0, 1e-6, 0.2, 3.0])
@pytest.mark.parametrize("kind", [CameraRay, EpipolarRay])
def test_rays(kind, camera, moved):
    """Where the camera has hardly moved, and where points lie behind it."""
    state, mean, _, const = lanes(1, moved)
    mean[3:6, 2] = [0.0, -0.1, 1e-9]
    assert_twins(kind(camera), Z, state, mean, const)
    if moved == 3.0:
        in_camera = CameraRay(camera).in_camera(state, mean, const)
        assert (in_camera[:, 2] < 0.0).any() and (in_camera[:, 2] > 0.0).any()


@every_camera
@pytest.mark.parametrize("moved", [0.2, 3.0])
def test_points(camera, moved):
    """In front of the cameras and behind them."""
    state, _, points, _ = lanes(2, moved)
    assert_twins(CameraPoint(camera), Z, state, points, None)
    if camera is PLAIN:
        assert_twins(StereoPoint(RIG), np.append(Z, 241.0), state, points, None)
    if moved == 3.0:
        assert (CameraPoint(camera).in_camera(state, points)[:, 2] < 0.0).any()


def test_behind_the_camera():
    points = 0.3 * np.eye(3)
    state = SE3.exp(np.array([[0.0, 0.0, 0.0, 0.0, 0.0, z] for z in (-3.0, 0.1, 3.0)]))
    uncertain = MembersView(DISTORTED, np.arange(3))
    assert_twins(uncertain, np.tile(Z, 3), state, np.tile(points.ravel(), (3, 1)), np.zeros((3, 0)), 1e-9)


def test_a_pair_of_cameras_starts_points():
    """A sound model, with a lens so long that no step of the check's turning camera is by chance about 2π px.

    The analytic covariance against the numeric one of `invert`; the points are seen where they were measured.
    """
    long = RectifiedStereo(Pinhole(6400, 4800, 4000.0, 4100.0, 3199.5, 2399.5), 0.12)
    assert check_model(StereoPoint(long), SE3) == []
    rays, model = Rays.random(4, 5), StereoPoint(RIG)
    local = np.random.default_rng(1).uniform([-1.0, -1.0, 2.0], [1.0, 1.0, 6.0], size=(5, 3))
    z, cov = RIG.project(local), np.broadcast_to(np.diag([0.1, 0.2, 0.15]) + 0.05, (5, 3, 3))
    records = model.initialise(rays.state, z, cov)
    seen = model.predict(rays.state[:, None], records.mean)
    np.testing.assert_allclose(seen, np.broadcast_to(z, (4, 5, 3)), atol=1e-9)
    numeric = ObservationModel.initialise(model, rays.state, z, cov)
    np.testing.assert_allclose(records.mean, numeric.mean, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(records.cov, numeric.cov, rtol=1e-5, atol=1e-9)


DISTORTIONS = {
    "none": (0.0, 0.0, 0.0, 0.0, 0.0),
    "barrel": (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05, 0.0),
    "strong": (-0.42, 0.21, 0.012, -0.009, -0.06),
    "pincushion": (0.3, 0.2, -0.01, 0.01, 0.08),
    "equidistant": (0.0, 0.0, 0.0, 0.0),
    "fisheye": (-0.03, 0.02, -0.012, 0.002),
}


@pytest.mark.parametrize("distortion", DISTORTIONS.values(), ids=DISTORTIONS.keys())
def test_pixels_and_slope_equal_numpys(distortion):
    model = "equidistant" if len(distortion) == 4 else "radial-tangential"
    camera = Pinhole(752, 480, 458.654, 457.296, 367.215, 248.375, distortion, model)
    rng = np.random.default_rng(3)
    depth = rng.uniform(0.2, 40.0, (500, 1)) * rng.choice([-1.0, 1.0], (500, 1))
    points = np.concatenate([rng.uniform(-1.2, 1.2, (500, 2)), np.ones((500, 1))], axis=1) * depth
    points[0] = [0.0, 0.0, 2.0]
    points[1:5, :2] = points[1:5, 2:] * np.array([[1e-9, 0.0], [-2e-8, 1e-8], [3.6, 0.5], [1e-200, 0.0]])
    out = np.array([project(*point, camera.params) for point in points.tolist()])
    np.testing.assert_allclose(out[:, :2], camera.project(points), rtol=1e-12, atol=1e-12 * camera.fx)
    slope, scale = camera.jacobian(points), camera.fx / np.abs(points[:, 2, None, None])
    np.testing.assert_allclose(out[:, 2:].reshape(-1, 2, 3) / scale, slope / scale, rtol=1e-12, atol=1e-12)


def test_the_plane_of_the_camera_gives_no_number_and_no_error():
    camera = Pinhole(640, 480, 500.0, 510.0, 320.0, 240.0)
    assert not np.isfinite(project(1.0, 0.5, 0.0, camera.params)[:2]).any()
    assert not np.isfinite(camera.project(np.array([1.0, 0.5, 0.0]))).any()


VIEWERS = {
    "plain": Pinhole(640, 480, 400.0, 410.0, 319.5, 239.5),
    "folding": Pinhole(640, 480, 300.0, 300.0, 320.0, 240.0, (-0.42, 0.21, 0.012, -0.009, -0.06)),
    "fisheye": Pinhole(640, 480, 220.0, 220.0, 320.0, 240.0, (-0.03, 0.02, -0.012, 0.002), "equidistant"),
}


@pytest.mark.parametrize("camera", VIEWERS.values(), ids=VIEWERS.keys())
def test_chosen_features_are_those_that_the_camera_sees_nearly_as_at_first(camera):
    rng, count, margin, least, most = np.random.default_rng(1), 4000, 8.0, 0.7, 2.0
    place = np.concatenate([rng.uniform(-3.0, 3.0, (count, 3)), np.ones((count, 1))], axis=1)
    place[:200, 3] = rng.uniform(0.0, 1.0, 200)
    first_pose, pose = SE3.exp(0.5 * rng.normal(size=(count, 6))), SE3.exp(0.2 * rng.normal(size=6))
    alive = rng.uniform(size=count) < 0.8
    rows, px = np.empty(count, dtype=np.int64), np.empty((count, 2))
    limits = np.array([camera.width, camera.height, margin, camera.monotonic_radius, least, most])
    found = in_view(place, first_pose, alive, pose, camera.params, limits, rows, px)

    seen = directions(place, pose)
    then = place[:, :3] - place[:, 3:] * SE3.translation(first_pose)
    now = place[:, :3] - place[:, 3:] * SE3.translation(pose)
    lengths = np.linalg.norm(then, axis=1), np.linalg.norm(now, axis=1)
    scale, cosine = lengths[1] / lengths[0], (then * now).sum(axis=1) / (lengths[0] * lengths[1])
    wanted = alive & camera.visible(seen, margin) & (cosine >= least)
    wanted &= (scale <= most) & (scale >= 1.0 / most)
    assert 50 < wanted.sum() < count / 2
    np.testing.assert_array_equal(rows[:found], np.flatnonzero(wanted))
    np.testing.assert_allclose(px[:found], camera.project(seen[wanted]), rtol=0.0, atol=1e-9)
