"""Pinhole and fisheye: OpenCV, numeric derivatives, round trips, visibility, refusals, and where the distortion folds."""

import pickle
import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rbpf.errors import InputError
from rbpf.sensors.camera import Pinhole, RectifiedStereo
from rbpf.sensors.camera.distortion import MAX_ANGLE, MIN_DEPTH_FRACTION, Equidistant

EUROC = (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05, 0.0)
TUM_VI = (0.0034823894022493434, 0.0007150348452162257, -0.0020532361418706202, 0.00020293673591811182)
CAMERAS = {
    "undistorted": Pinhole(640, 480, 525.0, 520.0, 319.5, 239.5),
    "euroc": Pinhole(752, 480, 458.654, 457.296, 367.215, 248.375, EUROC),
    "wide": Pinhole(640, 480, 360.0, 358.0, 322.0, 236.0, (-0.28, 0.08, 0.002, -0.001, -0.0085)),
    "pincushion": Pinhole(1280, 720, 700.0, 710.0, 640.0, 355.0, (0.25, 0.12, -0.003, 0.004, 0.05)),
    "folding": Pinhole(640, 480, 320.0, 320.0, 320.0, 240.0, (-0.25, 0.0, 0.0, 0.0, 0.0)),
}
FISHEYES = {
    "ideal": Pinhole(640, 480, 262.0, 262.0, 319.5, 239.5, (0.0, 0.0, 0.0, 0.0), "equidistant"),
    "tum-vi": Pinhole(512, 512, 190.98, 190.97, 254.93, 256.90, TUM_VI, "equidistant"),
}
EVERY = CAMERAS | FISHEYES
every_camera = pytest.mark.parametrize("camera", EVERY.values(), ids=EVERY.keys())
FOLDING = CAMERAS["folding"]


def matrix(camera: Pinhole) -> np.ndarray:
    return np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])


def seen_points(camera: Pinhole) -> np.ndarray:
    """Points at depths from 0.3 m to 30 m all over the image, its border and the axis among them."""
    rng = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(np.linspace(-1.5, 1.5, 41), np.linspace(-1.2, 1.2, 31)), axis=-1)
    if camera.distortion_model == "equidistant":
        grid *= 2.4
    uv = np.concatenate([grid.reshape(-1, 2), rng.normal(0.0, 1e-7, (20, 2)), np.zeros((1, 2))])
    rays = np.concatenate([uv, np.ones((len(uv), 1))], axis=1)
    rays = rays[camera.visible(rays)]
    return rays * rng.uniform(0.3, 30.0, (len(rays), 1))


def numeric_slope(function, at: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Central differences of fourth order (…, p, D), with a step (…,) per point."""
    columns = []
    for direction in np.eye(at.shape[-1]):
        h = step[..., None] * direction
        near = function(at + h) - function(at - h)
        far = function(at + 2.0 * h) - function(at - 2.0 * h)
        columns.append((8.0 * near - far) / (12.0 * step[..., None]))
    return np.stack(columns, axis=-1)


@every_camera
def test_projects_and_unprojects_as_opencv(camera):
    points, none, lens = seen_points(camera), np.zeros((3, 1)), (matrix(camera), np.array(camera.distortion))
    fisheye = camera.distortion_model == "equidistant"
    precise = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 500, 1e-15)
    assert len(points) > (500 if fisheye else 100)
    if fisheye:
        assert np.arctan2(np.hypot(*points[:, :2].T), points[:, 2]).max() > np.deg2rad(73.0)
        px = cv2.fisheye.projectPoints(points[:, None], none, none, *lens)[0]
        uv, inner = cv2.fisheye.undistortPoints(px, *lens, criteria=precise), slice(None)
    else:
        px, by_pose = cv2.projectPoints(points[:, None], none, none, *lens)
        expected = by_pose[:, 3:6].reshape(-1, 2, 3)
        np.testing.assert_allclose(camera.jacobian(points), expected, rtol=1e-9, atol=1e-9)
        uv = cv2.undistortPoints(px, *lens, criteria=precise)
        inner = np.hypot(*camera.unproject(px[:, 0]).T) < 0.6  # its iteration diverges towards a fold
        assert inner.sum() > 100
    np.testing.assert_allclose(camera.project(points), px[:, 0], rtol=0, atol=1e-9)
    np.testing.assert_allclose(camera.unproject(px[inner, 0]), uv[inner, 0], rtol=0, atol=1e-8 if fisheye else 1e-9)


@every_camera
def test_slope_is_the_derivative(camera):
    points = seen_points(camera)
    numeric = numeric_slope(camera.project, points, 1e-3 * points[:, 2])
    scale = camera.fx / points[:, 2, None, None]
    np.testing.assert_allclose(camera.jacobian(points) / scale, numeric / scale, rtol=0, atol=1e-8)


@every_camera
def test_unproject_jacobian_is_the_derivative_and_the_inverse(camera):
    px = camera.project(seen_points(camera))
    uv = camera.unproject(px)
    inner = np.hypot(*uv.T) < 0.8 * camera.lens.monotonic_radius
    px, uv = px[inner], uv[inner]
    slope = camera.unproject_jacobian(px)
    numeric = numeric_slope(camera.unproject, px, np.full(len(px), 0.05))
    np.testing.assert_allclose(slope * camera.fx, numeric * camera.fx, rtol=1e-7, atol=1e-7)
    rays = np.concatenate([uv, np.ones((len(uv), 1))], axis=1)
    both = camera.jacobian(rays)[..., :2] @ slope
    np.testing.assert_allclose(both, np.broadcast_to(np.eye(2), both.shape), rtol=0, atol=1e-9)


@every_camera
def test_other_ways_to_make_the_same_camera(camera):
    assert Pinhole.from_params(camera.width, camera.height, camera.params) == camera
    listed = replace(camera, distortion=list(camera.distortion))
    assert listed == camera and hash(listed) == hash(camera) and pickle.loads(pickle.dumps(camera)) == camera


@every_camera
def test_nothing_behind_or_beside_the_camera_is_visible(camera):
    behind = np.array([[0.0, 0.0, -1.0], [0.1, -0.2, -3.0], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -0.0]])
    assert not camera.visible(behind).any() and not camera.visible(np.array([np.nan, 0.0, 1.0]))
    assert camera.visible(np.array([0.0, 0.0, 1e-9]))


def test_the_edges_of_an_image():
    camera = CAMERAS["undistorted"]
    corners = np.array([[-0.5, -0.5], [639.5, 479.5]])
    assert camera.inside(corners).all()
    assert not camera.inside(corners + np.array([[-1e-9, 0.0], [0.0, 1e-9]])).any()
    assert camera.inside(np.array([[9.5, 9.5], [629.5, 469.5]]), margin_px=10.0).all()
    assert not camera.inside(np.array([[9.4, 100.0], [100.0, 469.6]]), margin_px=10.0).any()
    assert camera.inside(np.array([-5.0, 10.0]), margin_px=-5.0) and not camera.inside(np.array([np.nan, 10.0]))


CAMERA = Pinhole(640, 480, 525.0, 520.0, 319.5, 239.5)
BENT = "the camera of a rectified stereo pair has"
RECTIFY = "rectify the images and give the camera of the rectified ones"
GOOD = {"width": 640, "height": 480, "fx": 500.0, "fy": 500.0, "cx": 320.0, "cy": 240.0}
MOST, POSITIVE = "at least 1 and at most 10000000", "above 0 and at most 1000000000"
FINITE = "at least -1000000000 and at most 1000000000"
FOUR = "the camera's distortion must be the 4 numbers k1, k2, k3, k4, got "
FIVE = "the camera's distortion must be the 5 numbers k1, k2, p1, p2, k3 (k3 = 0 if there are four), got "


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"width": 0}, f"the camera's width must be a whole number, {MOST}, got 0"),
        ({"fx": 0.0}, f"the camera's fx must be {POSITIVE}, got 0.0"),
        ({"cy": float("nan")}, f"the camera's cy must be {FINITE}, got nan"),
        ({"cx": "320"}, f"the camera's cx must be {FINITE}, got '320'"),
        ({"distortion": (0.1, 0.0, 0.0, 0.0)}, f"{FIVE}(0.1, 0.0, 0.0, 0.0)"),
        (
            {"distortion_model": "fov"},
            "the camera's distortion_model must be radial-tangential or equidistant, got 'fov'",
        ),
        ({"distortion_model": "equidistant"}, f"{FOUR}(0.0, 0.0, 0.0, 0.0, 0.0)"),
        (
            {"distortion_model": "equidistant", "distortion": (0.0, 0.0, 0.0, float("nan"))},
            f"the camera's distortion must be numbers, each {FINITE}, got (0.0, 0.0, 0.0, nan)",
        ),
        ((CAMERA, 0.0), f"the stereo pair's baseline_m must be {POSITIVE}, got 0.0"),
        ((CAMERA, float("nan")), f"the stereo pair's baseline_m must be {POSITIVE}, got nan"),
        ((FOLDING, 0.1), f"{BENT} radial-tangential distortion (-0.25, 0.0, 0.0, 0.0, 0.0): {RECTIFY}"),
        ((FISHEYES["ideal"], 0.1), f"{BENT} equidistant distortion (0.0, 0.0, 0.0, 0.0): {RECTIFY}"),
    ],
)
def test_a_wrong_camera_and_a_wrong_pair_are_refused(wrong, message):
    with pytest.raises(InputError, match=f"^{re.escape(message)}$"):
        RectifiedStereo(*wrong) if isinstance(wrong, tuple) else Pinhole(**(GOOD | wrong))


STEREO = RectifiedStereo(CAMERA, 0.12)


def test_pixels_of_a_pair():
    z = STEREO.project(np.array([0.5, -0.3, 4.0]))
    left = [319.5 + 525.0 * 0.125, 239.5 - 520.0 * 0.075, 319.5 + 525.0 * 0.38 / 4.0]
    np.testing.assert_allclose(z, left, rtol=1e-15)
    assert STEREO.dim == z.shape[-1] == 3


def test_no_point_without_disparity():
    z = np.array([[100.0, 100.0, 100.0], [100.0, 100.0, 101.0], [101.0, 100.0, 100.0]])
    np.testing.assert_array_equal(np.isfinite(STEREO.triangulate(z)).all(axis=1), [False, False, True])


def test_visible_in_both_images():
    # 0.6 m to the left at 1 m: u_left is 4.5, u_right is −58.5.
    points = np.array([[-0.6, 0.0, 1.0], [-0.4, 0.0, 1.0], [0.0, 0.0, -1.0], [0.7, 0.0, 1.0], [0.0, 0.6, 1.0]])
    np.testing.assert_array_equal(STEREO.visible(points), [False, True, False, False, False])
    assert STEREO.camera.visible(points[0]) and not STEREO.camera.visible(points[3])
    assert not STEREO.visible(points[1], margin_px=50.0)
    np.testing.assert_array_equal(STEREO.inside(STEREO.project(points[:2])), [False, True])


@every_camera
def test_the_camera_of_turned_and_of_smaller_images_sees_the_same_there(camera):
    """A quarter of a turn clockwise moves column and row (u, v) to (h − 1 − v, u), and the world about the axis."""
    points, turn = seen_points(camera), np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    px = camera.project(points)
    turned = np.stack([camera.height - 1 - px[:, 1], px[:, 0]], axis=1)
    np.testing.assert_allclose(camera.turned(1).project(points @ turn.T), turned, atol=1e-9)
    np.testing.assert_allclose(camera.turned(3).turned(1).params, camera.params, atol=1e-9)
    smaller = camera.resized(camera.width // 2, camera.height // 2)
    scale = np.array([smaller.width / camera.width, smaller.height / camera.height])
    np.testing.assert_allclose(smaller.project(points), scale * (px + 0.5) - 0.5, atol=1e-9)


@pytest.mark.parametrize("k3", [0.0, 1e-300, -1e-300, -0.05, -3.0])
@pytest.mark.parametrize(("k1", "k2"), [(-0.4, 0.02), (-0.4, -0.1), (0.3, -0.2), (0.0, -0.1)])
def test_radius_is_the_first_turning_point(k1, k2, k3):
    radius = Pinhole(640, 480, 300.0, 300.0, 320.0, 240.0, (k1, k2, 0.0, 0.0, k3)).lens.monotonic_radius

    def slope(r):
        return 1.0 + 3.0 * k1 * r**2 + 5.0 * k2 * r**4 + 7.0 * k3 * r**6

    assert slope(np.linspace(0.0, radius * (1.0 - 1e-9), 10_001)).min() > 0.0
    assert slope(radius) == pytest.approx(0.0, abs=1e-13)


def test_pixels_beyond_the_fold_have_no_direction():
    radius = FOLDING.lens.monotonic_radius
    reach = FOLDING.fx * radius * (1.0 - 0.25 * radius**2)
    px = FOLDING.cx + np.array([-1.0, -0.999, 0.999, 1.001, 5.0])[:, None] * [reach, 0.0]
    px[:, 1] = FOLDING.cy
    finite = np.isfinite(FOLDING.unproject(px[1:]))
    np.testing.assert_array_equal(finite, [[True, True], [True, True], [False, False], [False, False]])
    np.testing.assert_array_equal(np.isfinite(FOLDING.unproject_jacobian(px[1:]))[:, 0, 0], finite[:, 0])
    assert np.isnan(FOLDING.unproject(np.array([[np.nan, 1.0], [np.inf, 1.0]]))).all()


@given(
    k1=st.floats(-0.5, 0.5),
    k2=st.floats(-0.3, 0.3),
    k3=st.floats(-0.1, 0.1),
    tangential=st.tuples(st.floats(-0.01, 0.01), st.floats(-0.01, 0.01)),
    fraction=st.floats(0.0, 0.98),
    angle=st.floats(0.0, 6.3),
)
def test_every_visible_direction_comes_back(k1, k2, k3, tangential, fraction, angle):
    camera = Pinhole(4000, 4000, 500.0, 500.0, 2000.0, 2000.0, (k1, k2, *tangential, k3))
    length = fraction * min(camera.lens.monotonic_radius, 1.5)
    seen = np.array([length * np.cos(angle), length * np.sin(angle), 1.0])
    if camera.visible(seen):
        assert_it_comes_back(camera, seen)


def assert_it_comes_back(camera: Pinhole, seen: np.ndarray) -> None:
    """A direction (3,) from its pixel, as exactly as the lens allows there."""
    again = np.append(camera.unproject(camera.project(seen)), 1.0)
    np.testing.assert_allclose(camera.project(again), camera.project(seen), rtol=0, atol=1e-8)
    least = np.linalg.svd(camera.jacobian(again)[:, :2], compute_uv=False)[-1] / camera.fx
    np.testing.assert_allclose(again, seen / seen[2], rtol=0, atol=1e-11 / least)


FOLDING_LENS = (-0.3, 0.0, 0.0, 0.0)


def ray(angle: float | np.ndarray, around: float = 0.7) -> np.ndarray:
    """Directions (…, 3) at an angle from the axis."""
    angle = np.asarray(angle, float)
    parts = [np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)]
    return np.stack(parts, axis=-1)


def test_it_sees_75_degrees_from_the_axis_and_no_more():
    camera = Pinhole(2000, 2000, 262.0, 262.0, 1000.0, 1000.0, (0.0, 0.0, 0.0, 0.0), "equidistant")
    near, beyond = ray(np.deg2rad(74.99)), ray(np.deg2rad([75.01, 80.0, 89.9, 90.0, 100.0]))
    assert camera.visible(near) and not camera.visible(beyond).any()
    assert np.isfinite(camera.unproject(camera.project(near))).all()
    assert np.isnan(camera.unproject(camera.project(beyond[:3]))).all()
    # The models of landmarks hold the depth positive from `MIN_DEPTH_FRACTION` on: there no pixel may still be taken for it.
    assert np.cos(MAX_ANGLE) > MIN_DEPTH_FRACTION


def test_the_circle_in_which_it_sees():
    camera = FISHEYES["tum-vi"]
    rows, columns = np.mgrid[:512, :512]
    seen = np.isfinite(camera.unproject(np.stack([columns, rows], axis=-1).astype(float)))[..., 0]
    np.testing.assert_array_equal(camera.field_of_view_mask(0.0), seen)
    px = np.argwhere(camera.field_of_view_mask(16.0))[:, ::-1]
    for corner in np.array([[-11.0, -11.0], [-11.0, 11.0], [11.0, -11.0], [11.0, 11.0]]):
        assert np.isfinite(camera.unproject(px + corner)).all()
    assert replace(camera, width=300, height=300, cx=150.0, cy=150.0).field_of_view_mask(16.0) is None
    assert Pinhole(640, 480, 320.0, 320.0, 320.0, 240.0, (-0.25, 0.0, 0.0, 0.0, 0.0)).field_of_view_mask(16.0) is None


def test_a_lens_that_folds_back_is_seen_up_to_there():
    lens = Equidistant(FOLDING_LENS)
    fold = np.sqrt(1.0 / 0.9)
    assert lens.max_angle == pytest.approx(fold, rel=1e-14)
    camera = Pinhole(900, 900, 262.0, 262.0, 450.0, 450.0, FOLDING_LENS, "equidistant")
    assert camera.visible(ray(fold - 1e-6)) and not camera.visible(ray(fold + 1e-6))
    reach = 262.0 * fold * (1.0 - 0.3 * fold**2)
    px = np.array([[450.0 + 0.999 * reach, 450.0], [450.0 + 1.001 * reach, 450.0], [np.nan, 1.0], [np.inf, 1.0]])
    np.testing.assert_array_equal(np.isfinite(camera.unproject(px))[:, 0], [True, False, False, False])


@given(coefficients=st.tuples(*[st.floats(-0.2, 0.2)] * 4), fraction=st.floats(0.0, 0.98), around=st.floats(0.0, 6.3))
def test_every_visible_direction_of_a_fisheye_comes_back(coefficients, fraction, around):
    lens = Equidistant(coefficients)
    camera = Pinhole(8000, 8000, 262.0, 262.0, 4000.0, 4000.0, coefficients, "equidistant")
    seen = ray(fraction * lens.max_angle, around)
    assert camera.visible(seen)
    assert_it_comes_back(camera, seen)
