"""A camera from points of which some are known on a line only."""

import numpy as np
import pytest

from rbpf.lie import SE3
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.camera.resection import GATE, Sights, refined_on_all, squared_distances

CAMERA = Pinhole(640, 480, 500.0, 510.0, 320.0, 240.0, (-0.2, 0.05, 0.001, -0.001, 0.0))
POSE = SE3.retract(SE3.identity(), np.array([0.05, -0.1, 0.1, 0.3, -0.1, 0.1]))
START = SE3.retract(POSE, np.array([0.01, -0.01, 0.01, 0.02, 0.01, -0.02]))


def scene(known: int, on_lines: int, rng: np.random.Generator, noise_px: float, wrong: bool = True) -> Sights:
    """Points that a camera at the origin sees; of those on lines the depth may be wrong by up to a third."""
    count = known + on_lines
    uv = rng.uniform(-0.35, 0.35, (count, 2))
    depth = rng.uniform(1.5, 2.5, (count, 1))
    points = np.concatenate([uv, np.ones((count, 1))], axis=1) * depth
    px = CAMERA.project(SE3.inverse_transform(POSE, points)) + noise_px * rng.normal(size=(count, 2))
    told = points.copy()
    if wrong:
        told[known:] *= 2.0 / depth[known:]
    spread = 0.5 * told
    spread[:known] = 0.0
    return Sights(told, spread, px, np.full(count, max(noise_px, 0.5)))


def test_distances_are_those_of_the_covariance():
    sights = scene(5, 20, np.random.default_rng(0), 1.0)
    seen, far = (
        SE3.inverse_transform(START, p) for p in (sights.points, sights.points + 1e-6 * sights.spread)
    )
    slope = (CAMERA.project(far) - CAMERA.project(seen)) / 1e-6
    cov = sights.std_px[:, None, None] ** 2 * np.eye(2) + slope[:, :, None] * slope[:, None]
    miss = sights.px - CAMERA.project(seen)
    expected = np.einsum("mp,mpq,mq->m", miss, np.linalg.inv(cov), miss)
    assert squared_distances(CAMERA, START[None], sights)[0] == pytest.approx(expected, rel=1e-4)


def test_points_behind_a_camera_are_infinitely_far():
    sights = scene(5, 5, np.random.default_rng(0), 1.0)
    away = SE3.retract(POSE, np.array([0.0, np.pi, 0.0, 0.0, 0.0, 0.0]))
    assert np.isinf(squared_distances(CAMERA, away[None], sights)).all()


@pytest.mark.parametrize(("wrong", "error"), [(False, 1e-6), (True, 0.02)])
def test_lines_fix_the_motion_and_few_points_its_length(wrong, error):
    rng = np.random.default_rng(1)
    sights = scene(4, 60, rng, 0.0, wrong)
    sights.px[10:20] = rng.uniform((0.0, 0.0), (640.0, 480.0), (10, 2))
    found = refined_on_all(CAMERA, START, sights)
    assert found is not None
    assert np.abs(SE3.log(SE3.between(POSE, found.world_from_camera))).max() < error
    assert found.inliers[:10].all() and found.inliers[20:].all()
    assert found.inliers[10:20].mean() < 0.3


def test_information_is_that_of_the_error():
    errors, predicted = [], []
    for seed in range(80):
        found = refined_on_all(CAMERA, START, scene(8, 60, np.random.default_rng(seed), 0.7))
        assert found is not None
        errors.append(SE3.log(SE3.between(POSE, found.world_from_camera)))
        predicted.append(np.linalg.inv(found.information))
    # Depths within a third of one another are less spread than the lines allow, and say a little more.
    nees = np.einsum("sa,sab,sb->s", errors, np.linalg.inv(predicted), errors)
    assert 3.0 < nees.mean() < 8.0


def test_lines_make_the_pose_of_few_points_more_exact():
    few, all_ = [], []
    for seed in range(20):
        both = scene(6, 80, np.random.default_rng(seed), 0.7)
        alone = Sights(*(getattr(both, name)[:6] for name in ("points", "spread", "px", "std_px")))
        for errors, sights in ((few, alone), (all_, both)):
            found = refined_on_all(CAMERA, START, sights)
            assert found is not None
            errors.append(np.linalg.norm(SE3.log(SE3.between(POSE, found.world_from_camera))))
    assert np.median(all_) < 0.5 * np.median(few)


def test_too_few_or_none_that_agree_fix_nothing():
    sights = scene(3, 0, np.random.default_rng(0), 0.0)
    assert refined_on_all(CAMERA, START, sights) is None
    other = scene(0, 30, np.random.default_rng(0), 0.0)
    other.px[:] += 400.0
    assert refined_on_all(CAMERA, START, other) is None
    assert (squared_distances(CAMERA, START[None], other) > GATE).all()
