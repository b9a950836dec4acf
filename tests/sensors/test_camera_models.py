"""Points and rays seen by a camera whose pose is the state."""

import numpy as np
import pytest

from rbpf.conformance import Example, check_model
from rbpf.core.likelihoods import Gaussian
from rbpf.core.linearisation import information, innovation_covariance, linearise
from rbpf.core.models import ObservationModel, Records
from rbpf.core.particles import Information, Prior
from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.maps.constellation import Constellation
from rbpf.sensors.camera import Pinhole, RectifiedStereo
from rbpf.sensors.camera.distortion import MIN_DEPTH_FRACTION
from rbpf.sensors.camera.kernels import in_view, project
from rbpf.sensors.camera.points import CameraPoint, CameraRay, EpipolarRay, MembersView, StereoPoint
from rbpf.systems.mono.feature_table import directions
from tests.exactness.models import known
from tests.sensors.camera_scenes import CAMERAS, DISTORTED, PLAIN, Rays, compiled, with_velocity

every_camera = pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS.keys())


@every_camera
def test_a_ray_is_seen_where_its_point_is(camera):
    rays = Rays.random(seed=2)
    point = CameraPoint(camera).predict(rays.state[:, None], rays.points)
    ray = CameraRay(camera).predict(rays.state[:, None], rays.mean, rays.const)
    np.testing.assert_allclose(ray, point, rtol=1e-12)
    np.testing.assert_allclose(
        point, camera.project(SE3.inverse_transform(rays.state[:, None], rays.points)), rtol=1e-13
    )


@every_camera
def test_at_infinity_only_rotation_counts(camera):
    rays = Rays.random(seed=3)
    far = rays.mean * [1.0, 1.0, 0.0]
    model = CameraRay(camera)
    seen = model.predict(rays.state[:, None], far, rays.const)
    shifted = rays.state + np.array([0.0, 0.0, 0.0, 0.0, 5.0, -3.0, 9.0])
    np.testing.assert_allclose(model.predict(shifted[:, None], far, rays.const), seen, rtol=1e-9)
    jacobians = known(model.jacobians(rays.state[:, None], far, rays.const))
    np.testing.assert_array_equal(known(jacobians.state)[..., 3:6], 0.0)
    assert np.isfinite(known(jacobians.landmark)).all()


@every_camera
@pytest.mark.parametrize(
    "point", [[0.1, 0.2, -1.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [-3.0, 2.0, 1e-9], [1e-9, 0.0, -1e-9]]
)
def test_behind_the_camera_is_finite_and_far_outside(camera, point):
    identity, point = SE3.identity(), np.array(point)
    ray, anchor = np.array([0.1, -0.1, 0.5]), SE3.exp(np.array([0.0, np.pi, 0.0, *point]))
    models = (CameraPoint(camera), point, None), (CameraRay(camera), ray, anchor), (EpipolarRay(camera), ray, anchor)
    for model, landmark, const in models:
        jacobians = known(model.jacobians(identity, landmark, const))
        for part in (model.predict(identity, landmark, const), jacobians.state, jacobians.landmark):
            assert np.isfinite(known(part)).all()
        assert not model.visible(identity, landmark, const)
    side = np.linalg.norm(point[:2]) / np.linalg.norm(point)
    px = CameraPoint(PLAIN).predict(identity, point) - [319.5, 239.5]
    assert np.linalg.norm(px) >= 0.99 * 400.0 * side / MIN_DEPTH_FRACTION


@every_camera
@pytest.mark.parametrize("kind", [CameraRay, EpipolarRay])
def test_a_ray_starts_through_its_first_sighting(camera, kind):
    """In every particle's own frame, with the noise carried to (u, v) and the prior of q beside it."""
    model, state = kind(camera, rho=(0.7, 0.3)), with_velocity(Rays.random(seed=5).state)
    z = np.array([[100.0, 50.0], [400.0, 300.0]])
    cov = np.array([[[1.0, 0.3], [0.3, 2.0]], [[0.5, 0.0], [0.0, 0.5]]])
    records = model.initialise(state, z, cov)
    assert records.mean.shape == (4, 2, 3)
    np.testing.assert_array_equal(records.const, np.repeat(state[:, None, :7], 2, axis=1))
    np.testing.assert_allclose(
        CameraRay(camera).predict(state[:, None], records.mean, records.const), np.broadcast_to(z, (4, 2, 2))
    )
    np.testing.assert_array_equal(records.mean[..., 2], 0.7)
    np.testing.assert_allclose(records.cov[..., 2, 2], 0.09)
    np.testing.assert_array_equal(records.cov[..., 2, :2], 0.0)
    by_landmark = known(known(CameraRay(camera).jacobians(state[0], records.mean[0], records.const[0])).landmark)
    carried = by_landmark @ records.cov[0] @ np.swapaxes(by_landmark, -1, -2)
    np.testing.assert_allclose(carried, cov, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("rho", [(0.0, 0.5), (1.0, 0.0), (np.nan, 0.5)])
def test_bad_prior(rho):
    with pytest.raises(InputError, match="prior of the inverse depth needs a positive mean and deviation"):
        CameraRay(PLAIN, rho)


# Several known points at once, which share the pose of their frame.

POINTS = np.random.default_rng(0).uniform([-0.5, -0.4, -0.3], [0.5, 0.4, 0.3], size=(4, 3))
COVS = np.tile(1e-4 * np.eye(3), (4, 1, 1))
SEEN = np.array([2, 0, 3])


def scene(turn: float = 0.7, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Five particles 2.5 m in front of the group: states, and where its points are, with one axis of landmarks."""
    rng = np.random.default_rng(seed)
    frame = SE3.retract(SE3.exp(rng.normal(size=(5, 1, 6))), rng.normal(scale=turn, size=(5, 1, 6)))
    state = SE3.retract(frame, np.array([0.0, 0.0, 0.0, 0.0, 0.0, -2.5]))
    state = SE3.retract(state, rng.normal(scale=0.1, size=(5, 1, 6)))
    points = SE3.transform(frame[..., None, :], POINTS + rng.normal(scale=0.02, size=(5, 1, 4, 3)))
    return state, points.reshape(5, 1, 12)


@every_camera
@pytest.mark.parametrize("turn", [1e-5, 0.7, 2.0])
def test_sound_model(camera, turn):
    state, mean = scene(turn)
    group, cov = Constellation(POINTS, COVS), np.tile(np.eye(12), (5, 1, 1, 1))
    example = Example(state=state[:, 0], landmark=group, records=Records(mean, cov))
    assert check_model(MembersView(camera, SEEN), SE3, example=example) == []


def test_visible_where_all_points_are():
    """While the camera turns away the points leave the image one after the other."""
    state, mean = scene(seed=1)
    turned = SE3.retract(state, np.linspace(0.0, 1.0, 30)[:, None, None, None] * np.eye(6)[1])
    in_camera = SE3.inverse_transform(turned[..., None, :], mean.reshape(5, 1, 4, 3)[:, :, SEEN])
    expected = PLAIN.visible(in_camera)
    assert (expected.any(axis=-1) & ~expected.all(axis=-1)).any()
    seen = MembersView(PLAIN, SEEN).visible(turned, mean)
    assert seen.dtype == bool and seen[0].all()
    np.testing.assert_array_equal(seen, expected.all(axis=-1))


# The compiled twins of the camera's models equal NumPy: rays, points and the points of constellations.

Z = np.array([250.0, 310.0])
RIG = RectifiedStereo(PLAIN, 0.12)


def assert_twins(model, z, pose, mean, const, tolerance=1e-10):
    """Relative to the largest number of each result: differences of large numbers are no better than these.
    With the pose alone as the state, and with a velocity behind it."""
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
    The analytic covariance against the numeric one of `invert`; the points are seen where they were measured."""
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


FOLDING = Pinhole(640, 480, 300.0, 300.0, 320.0, 240.0, DISTORTIONS["strong"])


@pytest.mark.parametrize("camera", [*CAMERAS.values(), FOLDING], ids=[*CAMERAS, "folding"])
def test_chosen_features_are_those_that_the_camera_sees_nearly_as_at_first(camera):
    rng, count, margin, least, most = np.random.default_rng(1), 4000, 8.0, 0.7, 2.0
    place = np.concatenate([rng.uniform(-3.0, 3.0, (count, 3)), np.ones((count, 1))], axis=1)
    place[:200, 3] = rng.uniform(0.0, 1.0, 200)
    first_pose, pose = SE3.exp(0.5 * rng.normal(size=(count, 6))), SE3.exp(0.2 * rng.normal(size=6))
    alive = rng.uniform(size=count) < 0.8
    rows, px = np.empty(count, dtype=np.int64), np.empty((count, 2))
    limits = np.array([camera.width, camera.height, margin, camera.lens.monotonic_radius, least, most])
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


# The part of a ray's measurement that does not depend on its depth (E06 §5.2).

R = np.diag([1.7, 1.7])


def measured(rays: Rays, camera, seed: int = 1) -> np.ndarray:
    """(K, 2) as the first particle sees the rays, with noise."""
    px = CameraRay(camera).predict(rays.state[0], rays.mean[0], rays.const[0])
    return px + np.random.default_rng(seed).normal(scale=3.0, size=px.shape)


def covariances(rays: Rays, var_q: float) -> np.ndarray:
    half = np.random.default_rng(2).normal(scale=2e-3, size=(*rays.mean.shape[:2], 2, 3))
    cov = np.zeros((*rays.mean.shape[:2], 3, 3))
    cov[..., :2, :2] = half @ np.swapaxes(half, -1, -2)
    cov[..., 2, 2] = var_q
    return cov


def terms(model: CameraRay, rays: Rays, z: np.ndarray, var_q: float) -> Information:
    nu, jac = linearise(model, SE3, z, rays.state[:, None], rays.mean, rays.const)
    cov = innovation_covariance(known(jac.landmark), covariances(rays, var_q), np.broadcast_to(R, (5, 2, 2)))
    return information(nu, known(jac.state), cov, Gaussian(), Prior.exactly(SE3, rays.state))


@every_camera
def test_depth_along_the_line_does_not_matter(camera):
    """To first order in q, in every ray, while the full residual moves by pixels."""
    rays = Rays.random(seed=3)
    model, full, z = EpipolarRay(camera), CameraRay(camera), measured(rays, camera)
    before = model.innovation(z, rays.state[:, None], rays.mean, rays.const)
    by_rho = known(known(full.jacobians(rays.state[:, None], rays.mean, rays.const)).landmark)[..., 2]
    direction = by_rho / np.linalg.norm(by_rho, axis=-1, keepdims=True)
    np.testing.assert_allclose((before * direction).sum(axis=-1), 0.0, atol=1e-10)
    change, moved = {}, {}
    for step in (1e-3, 1e-4):
        nearer = rays.mean + np.array([0.0, 0.0, step])
        after = full.innovation(z, rays.state[:, None], nearer, rays.const)
        across = after - (after * direction).sum(axis=-1, keepdims=True) * direction
        change[step] = np.abs(across - before).max()
        moved[step] = np.abs(after - full.innovation(z, rays.state[:, None], rays.mean, rays.const)).max()
    assert moved[1e-3] > 0.05 and change[1e-3] < 0.02 * moved[1e-3]
    assert change[1e-4] < 0.02 * change[1e-3] + 1e-11


@every_camera
def test_what_is_left_is_the_distance_from_the_line(camera):
    """Its length is that of the residual's component across ∂h/∂q, and its Jacobians see no depth."""
    rays = Rays.random(seed=4)
    z, at = measured(rays, camera), (rays.state[:, None], rays.mean, rays.const)
    full = known(CameraRay(camera).jacobians(*at))
    along = known(full.landmark)[..., 2]
    normal = np.stack([-along[..., 1], along[..., 0]], axis=-1) / np.linalg.norm(along, axis=-1)[..., None]
    y = (normal * CameraRay(camera).innovation(z, *at)).sum(axis=-1)
    np.testing.assert_allclose(EpipolarRay(camera).innovation(z, *at), y[..., None] * normal, atol=1e-9)
    projected = known(EpipolarRay(camera).jacobians(*at))
    np.testing.assert_allclose(known(projected.landmark)[..., 2], 0.0, atol=1e-9)
    row = (normal[..., None, :] @ known(full.state))[..., 0, :]
    np.testing.assert_allclose(known(projected.state), normal[..., None] * row[..., None, :], atol=1e-8)


@every_camera
def test_limit_of_the_marginal_with_unknown_depth(camera):
    """Λ and η tend to the epipolar constraint's as P_qq → ∞, with an error that falls as 1/P_qq."""
    rays = Rays.random(seed=5)
    z = measured(rays, camera)
    limit = terms(EpipolarRay(camera), rays, z, 0.25)
    scale_info, scale_vector = np.abs(limit.info).max(), np.abs(limit.vector).max()
    errors = []
    for var_q in (1.0, 1e2, 1e4):
        marginal = terms(CameraRay(camera), rays, z, var_q)
        by_info = np.abs(marginal.info - limit.info).max() / scale_info
        errors.append([by_info, np.abs(marginal.vector - limit.vector).max() / scale_vector])
    assert min(errors[0]) > 1e-5
    np.testing.assert_allclose(errors[1], 1e-2 * np.array(errors[0]), rtol=0.05)
    np.testing.assert_allclose(errors[2], 1e-4 * np.array(errors[0]), rtol=0.3)
    again = terms(EpipolarRay(camera), rays, z, 1e6)
    np.testing.assert_allclose(again.info, limit.info, rtol=1e-7, atol=1e-9 * scale_info)
