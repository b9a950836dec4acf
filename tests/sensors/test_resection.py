"""Where a camera is that sees known points."""

import cv2
import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.sensors.camera.resection import resect
from tests.sensors.camera_scenes import CAMERAS, DISTORTED, PLAIN

SQUARE = np.array([[-0.2, -0.2, 0.0], [0.2, -0.2, 0.0], [0.2, 0.2, 0.0], [-0.2, 0.2, 0.0]])


def scene(rng: np.random.Generator, camera, count: int = 4) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A pose, points that it sees 1 to 4 m away, and their pixels."""
    pose = SE3.exp(rng.normal(size=6))
    while True:
        px = rng.uniform([60.0, 60.0], [580.0, 420.0], size=(count, 2))
        extent = np.linalg.svd(px - px.mean(axis=0), compute_uv=False)
        if extent[1] > 0.3 * extent[0]:
            break
    depth = rng.uniform(1.0, 4.0, size=(count, 1))
    ray = np.concatenate([camera.unproject(px), np.ones((count, 1))], axis=1)
    return pose, SE3.transform(pose, depth * ray), px


def cost(camera, pose: np.ndarray, points: np.ndarray, px: np.ndarray) -> float:
    """Sum of squares in normalised coordinates, which is what is minimised."""
    local = SE3.inverse_transform(pose, points)
    return float(np.square(local[:, :2] / local[:, 2:] - camera.unproject(px)).sum())


def distance(found: np.ndarray, pose: np.ndarray) -> float:
    return float(np.abs(SE3.local(pose, found)).max())


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS.keys())
@pytest.mark.parametrize("count", [4, 5, 12])
def test_without_noise_it_is_the_truth(camera, count):
    rng = np.random.default_rng(count)
    for _ in range(60):
        pose, points, px = scene(rng, camera, count)
        found = resect(camera, points, px)
        assert cost(camera, found, points, px) < 1e-16
        if count > 4:
            assert distance(found, pose) < 1e-6


def test_four_points_in_general_position():
    """Almost all scenes of four points have one solution; where there are two, both explain the pixels."""
    rng = np.random.default_rng(0)
    errors = []
    for _ in range(150):
        pose, points, px = scene(rng, PLAIN)
        errors.append(distance(resect(PLAIN, points, px), pose))
    assert np.median(errors) < 1e-9
    assert np.mean(np.array(errors) < 1e-8) > 0.95


def refined(points: np.ndarray, uv: np.ndarray, turn: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """OpenCV's descent from one start (camera_from_world), as world_from_camera."""
    turn, shift = cv2.solvePnPRefineLM(points, uv, np.eye(3), None, turn.copy(), shift.copy())
    camera_from_world = np.eye(4)
    camera_from_world[:3, :3], camera_from_world[:3, 3] = cv2.Rodrigues(turn)[0], shift[:, 0]
    return SE3.inverse(SE3.from_matrix(camera_from_world))


@pytest.mark.parametrize("count", [4, 6])
def test_with_noise_no_pose_nearby_is_better(count):
    """Neither the truth nor, beyond the descent's own tolerance, what a descent from the truth finds."""
    rng = np.random.default_rng(7)
    for _ in range(80):
        pose, points, px = scene(rng, PLAIN, count)
        noisy = px + rng.normal(size=px.shape)
        found = cost(PLAIN, resect(PLAIN, points, noisy), points, noisy)
        assert found <= cost(PLAIN, pose, points, noisy)
        back = SE3.matrix(SE3.inverse(pose))
        near = refined(points, PLAIN.unproject(noisy), cv2.Rodrigues(back[:3, :3])[0], back[:3, 3:])
        assert found <= 1.01 * cost(PLAIN, near, points, noisy)


def test_where_one_start_finds_a_local_optimum():
    """OpenCV's SQPnP, refined, ends in a worse optimum in some scenes of four noisy points; this never does."""
    rng, worse = np.random.default_rng(0), 0
    for _ in range(300):
        _, points, px = scene(rng, PLAIN)
        noisy = px + 2.0 * rng.normal(size=px.shape)
        uv = PLAIN.unproject(noisy)
        _, turn, shift = cv2.solvePnP(points, uv, np.eye(3), None, flags=cv2.SOLVEPNP_SQPNP)
        single = refined(points, uv, turn, shift)
        ours = cost(PLAIN, resect(PLAIN, points, noisy), points, noisy)
        in_front = (SE3.inverse_transform(single, points)[:, 2] > 0.0).all()
        theirs = cost(PLAIN, single, points, noisy) if in_front else np.inf
        assert ours <= 1.01 * theirs
        worse += ours < 0.5 * theirs
    assert worse >= 1


@pytest.mark.parametrize("tilt", [0.0, 0.3, -0.8])
def test_planar_target(tilt):
    """A square seen from the front and from the side, which has a second local optimum."""
    pose = SE3.compose(
        SE3.exp(np.array([0.1, tilt, 0.2, 0.0, 0.0, 0.0])), SE3.exp(np.array([0, 0, 0, 0.1, 0.0, -2.0]))
    )
    px = PLAIN.project(SE3.inverse_transform(pose, SQUARE))
    assert distance(resect(PLAIN, SQUARE, px), pose) < 1e-7
    noisy = px + np.random.default_rng(1).normal(scale=0.3, size=px.shape)
    found = resect(PLAIN, SQUARE, noisy)
    assert cost(PLAIN, found, SQUARE, noisy) <= cost(PLAIN, pose, SQUARE, noisy)


@pytest.mark.parametrize("count", [0, 1, 3])
def test_too_few_points(count):
    with pytest.raises(InputError, match=f"at least four that are seen, got {count}"):
        resect(PLAIN, SQUARE[:count], np.full((count, 2), 100.0))


@pytest.mark.parametrize("bend", [0.0, 1e-4])
def test_points_on_a_line(bend):
    line = np.outer(np.arange(5.0), [0.3, 0.1, 0.2]) + np.array([0.0, 0.0, 2.0])
    line[2, 0] += bend
    with pytest.raises(InputError, match="the known points lie on a line: add one beside it"):
        resect(PLAIN, line, PLAIN.project(line))


def test_three_on_a_line_and_one_beside_it():
    """Some of the triples have no solution or many; the others find the camera."""
    points = np.array([[-0.4, 0.0, 2.0], [0.0, 0.05, 2.2], [0.4, 0.1, 2.4], [0.1, 0.4, 1.8]])
    pose = SE3.exp(np.array([0.05, -0.1, 0.2, 0.1, -0.2, 0.1]))
    px = PLAIN.project(SE3.inverse_transform(pose, points))
    found = resect(PLAIN, points, px)
    assert cost(PLAIN, found, points, px) < 1e-14


def found_or_refused(points: np.ndarray, px: np.ndarray) -> np.ndarray | str:
    """The pose, or the sentence that says why there is none."""
    try:
        return resect(PLAIN, points, px)
    except InputError as error:
        return str(error)


def test_pixels_of_other_points():
    """Where nothing in front of the camera explains the pixels there is no pose; never one that looks away."""
    rng, refused = np.random.default_rng(5), set()
    for _ in range(300):
        _, points, _ = scene(rng, PLAIN)
        found = found_or_refused(points, rng.uniform([0.0, 0.0], [640.0, 480.0], size=(4, 2)))
        if isinstance(found, str):
            refused.add(found)
        else:
            assert (SE3.inverse_transform(found, points)[:, 2] > 0.0).all()
    (sentence,) = refused
    assert sentence.startswith("no camera in front of the known points sees them as measured")


def test_pixels_without_a_direction():
    folding = type(DISTORTED)(640, 480, 400.0, 400.0, 319.5, 239.5, (-0.5, 0.0, 0.0, 0.0, 0.0))
    assert np.isnan(folding.unproject(np.array([2.0, 2.0]))).all()
    px = np.array([[2.0, 2.0], [500.0, 100.0], [400.0, 400.0], [100.0, 300.0]])
    with pytest.raises(InputError, match="the camera's distortion has no direction: check the calibration"):
        resect(folding, SQUARE, px)
