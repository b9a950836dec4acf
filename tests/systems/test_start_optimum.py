"""The optimum of a camera's first frames: its derivatives, its minimum, and what is drawn around it."""

import numpy as np
import pytest

from rbpf.lie import SE3
from rbpf.sensors.camera import Pinhole
from rbpf.systems.mono.start_optimum import (
    SCALE_STD,
    Expected,
    Linearised,
    Structure,
    Window,
    optimum,
    tangents,
)

CAMERA = Pinhole(640, 480, 500.0, 510.0, 320.0, 240.0, distortion=(0.05, -0.02, 0.001, 0.0, 0.0))
EXPECTED = Expected((0.8, 0.6), np.repeat([0.5, 0.5], 3), np.repeat([3.0, 1.5], 3))
FRAMES, FEATURES = 7, 14


def scene(seed: int = 0, noise_px: float = 0.5) -> tuple[Window, Structure]:
    """A camera that goes sideways before features at 0.7 to 2.5 m; the truth, scaled as the optimum holds it."""
    rng = np.random.default_rng(seed)
    inverse = rng.uniform(0.4, 1.4, FEATURES)
    inverse *= 0.8 / inverse.mean()
    direction = np.append(rng.uniform(-0.4, 0.4, (FEATURES, 2)), np.ones((FEATURES, 1)), axis=1)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    moved = np.linspace(0.0, 1.0, FRAMES)[:, None] * [0.05, -0.1, 0.02, 0.15, 0.05, 0.03]
    path = SE3.retract(SE3.identity(), moved)
    frame, feature = np.divmod(np.arange(FRAMES * FEATURES), FEATURES)
    place = direction[feature] / inverse[feature, None]
    px = CAMERA.project(SE3.inverse_transform(path[frame], place))
    px += rng.normal(scale=noise_px, size=px.shape)
    stamps = np.arange(FRAMES) * 33_000_000
    return Window(CAMERA, stamps, frame, feature, px, noise_px), Structure(path, direction, inverse)


def start_of(truth: Structure) -> Structure:
    """A camera that has not moved, and features that are all equally far."""
    still = np.broadcast_to(SE3.identity(), truth.path.shape).copy()
    return Structure(still, truth.direction, np.full(FEATURES, 0.8))


def test_the_vector_is_the_slope_of_the_cost():
    """By central differences, at a place where every residual and every loss takes part."""
    window, truth = scene(noise_px=2.0)
    step = np.random.default_rng(1).normal(scale=2e-3, size=6 * (FRAMES - 1) + 3 * FEATURES)
    at = truth.moved(step)
    _, vector = Linearised(window, EXPECTED, at).normal_equations()
    numeric = np.empty_like(vector)
    for k in range(vector.size):
        nudge = np.zeros(vector.size)
        nudge[k] = 1e-6
        ahead, behind = (Linearised(window, EXPECTED, at.moved(s * nudge)).cost for s in (1.0, -1.0))
        numeric[k] = (behind - ahead) / 2e-6
    # To first order in a step's velocity, which is what the logarithm's derivative leaves out.
    np.testing.assert_allclose(vector, numeric, rtol=0.0, atol=1e-3 * np.abs(vector).max())


def test_a_camera_that_seems_to_stand_still_is_found_to_have_moved():
    window, truth = scene()
    best = optimum(window, EXPECTED, start_of(truth))
    assert best.cost <= Linearised(window, EXPECTED, truth).cost
    assert best.structure.inverse.mean() == pytest.approx(0.8, abs=0.8 * 5.0 * SCALE_STD)
    off = SE3.local(best.structure.path[1:], truth.path[1:]).ravel()
    cov = np.linalg.inv(best.information)[: off.size, : off.size]
    assert off @ np.linalg.solve(cov, off) / off.size < 1.6
    assert np.abs(best.structure.inverse - truth.inverse).max() < 0.1


def test_errors_are_as_large_as_the_information_says():
    """Normalised squared errors of the poses and of the inverse distances over forty windows."""
    of_poses, of_features = [], []
    for seed in range(40):
        window, truth = scene(seed, noise_px=0.2)
        best = optimum(window, EXPECTED, truth)
        off = SE3.local(best.structure.path[1:], truth.path[1:]).ravel()
        cov = np.linalg.inv(best.information)[: off.size, : off.size]
        of_poses.append(off @ np.linalg.solve(cov, off) / off.size)
        of_features.append(np.square((best.structure.inverse - truth.inverse) / best.std_inverse()).mean())
    # Cauchy's loss takes some of the information, and the walk's prior is wider than this motion.
    assert 0.3 < np.mean(of_poses) < 1.3
    assert 0.3 < np.mean(of_features) < 1.5


def test_paths_are_drawn_with_the_covariance_of_the_optimum():
    window, truth = scene()
    best = optimum(window, EXPECTED, truth)
    paths = best.paths(4000, np.random.default_rng(2))
    assert (paths[:, 0] == truth.path[0]).all()
    drawn = SE3.local(best.structure.path[-1], paths[:, -1])
    last = slice(6 * (FRAMES - 2), 6 * (FRAMES - 1))
    cov = np.linalg.inv(best.information)
    std = np.sqrt(np.diag(cov)[last])
    np.testing.assert_allclose(drawn.std(axis=0), std, rtol=0.06)
    np.testing.assert_allclose(np.corrcoef(drawn.T), (cov[last, last] / std / std[:, None]), atol=0.06)
    features = cov.shape[0] - 3 * FEATURES + 2 + 3 * np.arange(FEATURES)
    np.testing.assert_allclose(best.std_inverse(), np.sqrt(np.diag(cov)[features]), rtol=1e-6)


def test_a_wrong_match_moves_little():
    window, truth = scene()
    right = optimum(window, EXPECTED, truth).structure.path[-1, 4:]
    window.px[5] += [40.0, -25.0]
    wrong = optimum(window, EXPECTED, truth).structure.path[-1, 4:]
    assert np.linalg.norm(wrong - right) < 0.01


def test_what_is_behind_the_camera_does_not_stop_it():
    window, truth = scene()
    turned = truth.path.copy()
    turned[3:] = SE3.retract(turned[3:], np.array([0.0, np.pi, 0.0, 0.0, 0.0, 0.0]))
    started = Linearised(window, EXPECTED, Structure(turned, truth.direction, truth.inverse))
    found = optimum(window, EXPECTED, started.at)
    assert np.isfinite(found.cost) and found.cost < started.cost


def test_tangents_are_across():
    direction = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.6, 0.0, 0.8]])
    frames = np.concatenate([direction[..., None], tangents(direction)], axis=-1)
    np.testing.assert_allclose(np.swapaxes(frames, 1, 2) @ frames, np.tile(np.eye(3), (3, 1, 1)), atol=1e-12)
