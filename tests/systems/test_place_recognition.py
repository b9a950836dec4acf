"""Whether a place is one that was seen before is a matter of evidence: where it may be, and how well everything fits."""

import numpy as np
import pytest

from examples.studies.point_worlds import MONO, Measuring, RoomWorld, simulate_features
from rbpf.core.particles import Estimate
from rbpf.lie import SE3
from rbpf.runs.recordings import filter_features
from rbpf.systems.mono.config import MonoConfig, SearchConfig
from rbpf.systems.mono.place_recognition import RISK, WRONG, log_likelihood, log_odds
from rbpf.systems.mono.relocalisation import CORNER_PX
from rbpf.systems.mono.slam import MonoSlam
from rbpf.systems.system import TrackingState
from tests.systems.mono_logs import errors, nees
from tests.systems.plane_sequences import CAMERA, Pictures, known_points, texture

HERE = SE3.exp(np.array([0.02, 0.05, -0.03, 0.1, 0.05, -0.1]))
COV = 1e-4 * np.eye(3)


def seen(count: int, wrong: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (M, 3) with covariances, and where a camera sees them, the last ones anywhere."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-1.0, -0.7, 2.0], [1.0, 0.7, 4.0], (count, 3))
    px = CAMERA.project(SE3.inverse_transform(HERE, points)) + CORNER_PX * rng.normal(size=(count, 2))
    px[count - wrong :] = rng.uniform(0.0, [CAMERA.width, CAMERA.height], (wrong, 2))
    return points, np.tile(COV, (count, 1, 1)), px


def prior(off_m: float, std_m: float = 1.0) -> Estimate:
    return Estimate(
        SE3.compose(HERE, SE3.exp(np.array([0.1, -0.05, 0.1, off_m, 0.0, 0.0]))), np.diag([0.01] * 3 + [std_m**2] * 3)
    )


def test_the_likelihood_is_the_integral_over_the_pose():
    """By importance sampling."""
    (points, cov, px), here = seen(9, 2), prior(0.5, 0.5)
    found, mode = log_likelihood(CAMERA, HERE, points, cov, px, here)
    rng, std = np.random.default_rng(1), np.repeat([0.02, 0.06], 3)
    away = std * rng.standard_normal((100_000, 6))
    poses = SE3.retract(mode, away)
    off = SE3.local(here.mean, poses)
    total = (
        -0.5 * np.square(off / np.sqrt(np.diagonal(here.cov))).sum(axis=1) - 0.5 * np.log(np.diagonal(here.cov)).sum()
    )
    total += 0.5 * np.square(away / std).sum(axis=1) + np.log(std).sum()
    for point, place in zip(points, px, strict=True):
        near = SE3.inverse_transform(poses, np.broadcast_to(point, (len(poses), 3)))
        by_point = CAMERA.jacobian(near) @ np.swapaxes(SE3.rotation(poses), 1, 2)
        spread = by_point @ COV @ np.swapaxes(by_point, 1, 2) + CORNER_PX**2 * np.eye(2)
        miss = place - CAMERA.project(near)
        squared = np.einsum("ni,nij,nj->n", miss, np.linalg.inv(spread), miss)
        density = np.exp(-0.5 * squared) / (2.0 * np.pi * np.sqrt(np.linalg.det(spread)))
        total += np.log((1.0 - WRONG) * CAMERA.width * CAMERA.height * density + WRONG)
    np.testing.assert_allclose(found, np.logaddexp.reduce(total) - np.log(len(total)), atol=0.2)


@pytest.mark.parametrize("count", [20, 200])
def test_it_is_no_matter_of_counts(count):
    """However many matches fit: a camera 8 m from there, known to a metre, sees a place that looks alike."""
    size, enough = np.array([15.0, 15.0, 3.0]), -np.log(RISK)
    assert log_odds(CAMERA, HERE, *seen(count, count // 2), prior(1.0), size)[0] > enough
    assert log_odds(CAMERA, HERE, *seen(count, count // 2), prior(8.0), size)[0] < -enough
    assert log_odds(CAMERA, HERE, *seen(count, count), prior(1.0), size)[0] < -enough


@pytest.mark.slow
def test_a_lost_camera_is_found_in_an_old_sub_map():
    """It has left the first wall of a gallery when the light goes out, and is back there when it comes on again."""
    away, dark, end = 90, 130, 150
    frames = np.arange(end)
    side = np.where(
        frames < away, 2.4 * np.sin(np.pi / 2 * frames / away) ** 2, np.maximum(2.4 - 0.055 * (frames - away), 0.2)
    )
    shake = [
        0.03 * np.sin(0.2 * frames),
        0.0 * side,
        0.05 * np.sin(0.13 * frames),
        side,
        0.1 * np.sin(0.09 * frames),
        -0.05 * side,
    ]
    poses = SE3.retract(SE3.identity(), np.stack(shake, axis=-1))
    search = SearchConfig(measurements=15, min_in_view=20)
    config = MonoConfig(map="joint", particles=30, settled_frames=4, submap=24, search=search)
    slam, held = MonoSlam(CAMERA, config, known_points()), 0
    for frame in Pictures(
        texture(), poses, lambda t, image: np.zeros_like(image) if away <= t < dark else image
    ).frames(0):
        found = slam.take(frame)
        held = max(held, len(slam.joint.old.maps) if slam.joint else 0)
        if found.state == TrackingState.LOST and slam.attempt is not None:
            assert slam.attempt.agreeing < config.relocalisation.min_inliers  # the present sub-map does not know it
    error = SE3.local(found.pose, poses[-1])
    assert found.state == TrackingState.TRACKED and held > 3
    assert np.linalg.norm(error[3:]) < 0.05 and error @ np.linalg.solve(found.cov, error) < 20.0


@pytest.mark.slow
def test_a_loop_is_closed_a_metre_off():
    """Of features with names, once round a room: at once as exact as the map, and as sure as it should be."""
    log = simulate_features(RoomWorld(frames=310, laps=1.0075, points=3000), Measuring(measurements=12), MONO, 0)
    run = filter_features(log, MonoConfig(submap=60))
    off = np.linalg.norm(errors(run)[:, 3:], axis=1)
    assert off[280] > 0.9 and off[290:300].mean() < 0.1 and nees(run)[290:300].mean() < 6.0 * 6.0
