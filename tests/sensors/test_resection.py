"""Where a camera is that sees points: all known, many of them mistaken, some of uncertain depth."""

import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.sensors.camera import Pinhole, resection
from tests.sensors.camera_scenes import CAMERAS, PLAIN

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
    for _ in range(15):
        pose, points, px = scene(rng, camera, count)
        found = resection.resect(camera, points, px)
        assert cost(camera, found, points, px) < 1e-16
        if count > 4:
            assert distance(found, pose) < 1e-6


def test_too_few_points():
    with pytest.raises(InputError, match="at least four in the image, got 3"):
        resection.resect(PLAIN, SQUARE[:3], np.full((3, 2), 100.0))


@pytest.mark.parametrize("bend", [0.0, 1e-4])
def test_points_on_a_line(bend):
    line = np.outer(np.arange(5.0), [0.3, 0.1, 0.2]) + np.array([0.0, 0.0, 2.0])
    line[2, 0] += bend
    with pytest.raises(InputError, match="the known points lie on a line: add one off it"):
        resection.resect(PLAIN, line, PLAIN.project(line))


def test_pixels_of_other_points():
    """Where nothing in front of the camera explains the pixels there is no pose; never one that looks away."""
    rng, refused = np.random.default_rng(5), set()
    for _ in range(80):
        _, points, _ = scene(rng, PLAIN)
        try:
            found = resection.resect(PLAIN, points, rng.uniform([0.0, 0.0], [640.0, 480.0], size=(4, 2)))
        except InputError as error:
            refused.add(str(error))
        else:
            assert (SE3.inverse_transform(found, points)[:, 2] > 0.0).all()
    (sentence,) = refused
    assert sentence.startswith("no camera pose has all known points in front of it")


def test_pixels_without_a_direction():
    folding = Pinhole(640, 480, 400.0, 400.0, 319.5, 239.5, (-0.5, 0.0, 0.0, 0.0, 0.0))
    assert np.isnan(folding.unproject(np.array([2.0, 2.0]))).all()
    px = np.array([[2.0, 2.0], [500.0, 100.0], [400.0, 400.0], [100.0, 300.0]])
    with pytest.raises(InputError, match="the camera's distortion: check the calibration"):
        resection.resect(folding, SQUARE, px)


CAMERA = Pinhole(640, 480, 500.0, 510.0, 320.0, 240.0, (-0.2, 0.05, 0.001, -0.001, 0.0))
POSE = SE3.retract(SE3.identity(), np.array([0.2, -0.3, 0.1, 0.5, -0.2, 0.4]))


def seen(count: int, rng: np.random.Generator, noise_px: float = 0.5) -> tuple[np.ndarray, np.ndarray]:
    """Points in front of the camera, and where they are seen."""
    uv = rng.uniform(-0.4, 0.4, (count, 2))
    points = np.concatenate([uv, np.ones((count, 1))], axis=1) * rng.uniform(1.0, 4.0, (count, 1))
    return SE3.transform(POSE, points), CAMERA.project(points) + noise_px * rng.normal(size=(count, 2))


@pytest.mark.parametrize("mistaken", [0, 20, 40])
def test_finds_the_camera_among_mistakes(mistaken):
    rng = np.random.default_rng(mistaken)
    points, px = seen(25 + mistaken, rng)
    px[:mistaken] = rng.uniform((0, 0), (640, 480), (mistaken, 2))
    found = resection.resect_consensus(CAMERA, points, px, 4.0, 300, rng)
    assert found is not None
    assert found.inliers[mistaken:].mean() > 0.95
    assert found.inliers[:mistaken].sum() <= 1
    assert found.rms_px < 1.0
    assert np.abs(SE3.log(SE3.between(POSE, found.world_from_camera))).max() < 5e-3


def test_information_of_known_points_is_that_of_the_error():
    errors, predicted = [], None
    for seed in range(60):
        points, px = seen(20, np.random.default_rng(1), 0.0)
        px = px + 0.5 * np.random.default_rng(seed).normal(size=px.shape)
        found = resection.refined(CAMERA, POSE, points, px, 10.0)
        assert found is not None
        errors.append(SE3.log(SE3.between(POSE, found.world_from_camera)))
        predicted = 0.25 * np.linalg.inv(found.information)
    assert np.std(errors, axis=0) == pytest.approx(np.sqrt(np.diag(predicted)), rel=0.35)


NEAR = SE3.retract(SE3.identity(), np.array([0.05, -0.1, 0.1, 0.3, -0.1, 0.1]))
START = SE3.retract(NEAR, np.array([0.01, -0.01, 0.01, 0.02, 0.01, -0.02]))


def sights_of(
    known: int, on_lines: int, rng: np.random.Generator, noise_px: float, wrong: bool = True
) -> resection.Sights:
    """Points that a camera at the origin sees; of those on lines the depth may be wrong by up to a third."""
    count = known + on_lines
    uv = rng.uniform(-0.35, 0.35, (count, 2))
    depth = rng.uniform(1.5, 2.5, (count, 1))
    points = np.concatenate([uv, np.ones((count, 1))], axis=1) * depth
    px = CAMERA.project(SE3.inverse_transform(NEAR, points)) + noise_px * rng.normal(size=(count, 2))
    told = points.copy()
    if wrong:
        told[known:] *= 2.0 / depth[known:]
    spread = 0.5 * told
    spread[:known] = 0.0
    return resection.Sights(told, spread, px, np.full(count, max(noise_px, 0.5)))


def test_distances_are_those_of_the_covariance():
    sights = sights_of(5, 20, np.random.default_rng(0), 1.0)
    seen, far = (SE3.inverse_transform(START, p) for p in (sights.points, sights.points + 1e-6 * sights.spread))
    slope = (CAMERA.project(far) - CAMERA.project(seen)) / 1e-6
    cov = sights.std_px[:, None, None] ** 2 * np.eye(2) + slope[:, :, None] * slope[:, None]
    miss = sights.px - CAMERA.project(seen)
    expected = np.einsum("mp,mpq,mq->m", miss, np.linalg.inv(cov), miss)
    assert resection.squared_distances(CAMERA, START[None], sights)[0] == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize(("wrong", "error"), [(False, 1e-6), (True, 0.02)])
def test_lines_fix_the_motion_and_few_points_its_length(wrong, error):
    rng = np.random.default_rng(1)
    sights = sights_of(4, 60, rng, 0.0, wrong)
    sights.px[10:20] = rng.uniform((0.0, 0.0), (640.0, 480.0), (10, 2))
    found = resection.refined_on_all(CAMERA, START, sights)
    assert found is not None
    assert np.abs(SE3.log(SE3.between(NEAR, found.world_from_camera))).max() < error
    assert found.inliers[:10].all() and found.inliers[20:].all()
    assert found.inliers[10:20].mean() < 0.3


def test_information_is_that_of_the_error():
    errors, predicted = [], []
    for seed in range(80):
        found = resection.refined_on_all(CAMERA, START, sights_of(8, 60, np.random.default_rng(seed), 0.7))
        assert found is not None
        errors.append(SE3.log(SE3.between(NEAR, found.world_from_camera)))
        predicted.append(np.linalg.inv(found.information))
    # Depths within a third of one another are less spread than the lines allow, and say a little more.
    nees = np.einsum("sa,sab,sb->s", errors, np.linalg.inv(predicted), errors)
    assert 3.0 < nees.mean() < 8.0


def test_too_few_or_none_that_agree_fix_nothing():
    sights = sights_of(3, 0, np.random.default_rng(0), 0.0)
    assert resection.refined_on_all(CAMERA, START, sights) is None
    other = sights_of(0, 30, np.random.default_rng(0), 0.0)
    other.px[:] += 400.0
    assert resection.refined_on_all(CAMERA, START, other) is None
    assert (resection.squared_distances(CAMERA, START[None], other) > resection.GATE).all()
