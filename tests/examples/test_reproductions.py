"""The parts that reproduce the paper's figures, each against a case that can be worked out."""

import numpy as np
import pytest

from examples.studies.e06.depth_curves import Passing, shape_of
from examples.studies.e06.loop import AWAY, find_closure, started_until
from examples.studies.e06.plane import fit_plane
from examples.studies.s05.record import Best, Paths, Record, errors
from rbpf.lie import SE3
from rbpf.sensors.camera import Pinhole

cv2 = pytest.importorskip("cv2")

CAMERA = Pinhole(640, 480, 525.0, 525.0, 319.5, 239.5)


def sighting(rows, found, started=0):
    """A frame in which features were looked for."""
    k = len(rows)
    px = np.where(np.array(found, dtype=bool)[:, None], 5.0, np.nan) if k else np.zeros((0, 2))
    line = np.full((k, 2, 2), np.nan)
    return {
        "features": np.array(rows, dtype=int),
        "px": px,
        "line": line,
        "started": np.arange(started),
        "started_px": np.zeros((started, 2)),
    }


def test_a_plane_is_fitted_whatever_its_pose():
    rng = np.random.default_rng(0)
    corners = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 1.0], [0.0, 1.0]])
    inside = rng.uniform(0.0, 1.0, (200, 2)) * [2.0, 1.0]
    flat = np.concatenate([corners, inside])
    height = 0.004 * rng.standard_normal(len(flat))
    height[:4] = 0.0
    points = SE3.transform(SE3.exp([0.4, -0.8, 0.3, 3.0, -1.0, 2.0]), np.column_stack([flat, height]))
    plane = fit_plane(points)
    assert plane.rms_m == pytest.approx(np.std(height), rel=0.02)
    assert plane.worst_m == pytest.approx(np.abs(height).max(), rel=0.1)
    assert plane.area_m2 == pytest.approx(2.0, rel=1e-3)


def test_a_loop_is_closed_when_the_start_is_found_again():
    out = [sighting([50, 51], [True, True])] * (AWAY + 5)
    frames = [sighting([], [], 4), sighting([0, 1, 2], [True, True, False]), sighting([3], [True]), *out]
    back = [sighting([1, 60], [False, True]), sighting([1, 2], [True, False]), sighting([3], [True])]
    closure = find_closure(frames + back, 4)
    assert (closure.first, closure.again) == (4, 2)
    assert (closure.left, closure.back) == (2, 3 + len(out) + 1)
    assert find_closure(frames, 4).back == -1
    assert find_closure([*frames[:3], *out[: AWAY - 3], *back], 4).again == 0
    assert started_until(frames, 15) == 4


def test_a_gaussian_curve_is_called_one_and_a_gamma_curve_is_not():
    grid = np.linspace(1e-3, 40.0, 20_000)
    bell = shape_of(grid, -0.5 * ((grid[None] - 20.0) / 2.0) ** 2)
    assert bell.divergence[0] == pytest.approx(0.0, abs=1e-6)
    assert (bell.mean[0], bell.std[0]) == pytest.approx((20.0, 2.0), rel=1e-6)
    k = 4.0
    gamma = shape_of(grid, ((k - 1.0) * np.log(grid) - grid)[None])
    assert gamma.skewness[0] == pytest.approx(2.0 / np.sqrt(k), rel=1e-3)
    assert gamma.divergence[0] > 0.05


def test_the_likelihood_of_depth_has_its_peak_at_the_truth():
    poses = np.tile(SE3.identity(), (5, 1))
    poses[:, 4] = 0.05 * np.arange(1, 6)
    passing, first = Passing(CAMERA, poses, 1.0), np.array([300.0, 250.0])
    z = CAMERA.project(SE3.inverse_transform(poses, 1.7 * np.append(CAMERA.unproject(first[None])[0], 1.0)[None]))
    rho = np.linspace(0.1, 2.0, 1901)
    curves = passing.log_likelihoods(first, rho, z.reshape(1, -1))
    assert 1.0 / rho[curves[-1, 0].argmax()] == pytest.approx(1.7, rel=2e-3)


def path(count: int, rng: np.random.Generator, noise: float) -> np.ndarray:
    steps = np.zeros((count, 6))
    steps[:, 1], steps[:, 5] = 0.1, 0.2
    poses = [SE3.identity()]
    for step in steps[1:] + noise * rng.standard_normal((count - 1, 6)):
        poses.append(SE3.compose(poses[-1], SE3.exp(step)))
    return np.array(poses)


@pytest.fixture
def scene():
    """Ten landmarks seen from a true path, without noise, some names not asked for; a path that is 5 % too long."""
    rng = np.random.default_rng(3)
    true = path(12, rng, 0.0)
    places = rng.uniform([-3.0, -1.0, 1.0], [3.0, 1.0, 6.0], (10, 3))
    names, record = np.arange(10) * 3 + 1, Record(due=(4,))
    for t in range(12):
        seen = rng.permutation(10)[:6]
        record.observations.append((names[seen], t, SE3.inverse_transform(true[t], places[seen])))
    return true, places, names, record


def test_errors_of_maps_and_paths(scene):
    """A rigid motion of everything is an error that alignment removes; a wrong scale is one that it does not."""
    true, places, names, record = scene
    moved = SE3.compose(SE3.exp(np.array([0.0, 0.05, 0.0, 0.1, 0.0, 0.0])), true)
    longer = true.copy()
    longer[:, 4:] *= 1.05
    updated = np.ones(len(true), dtype=bool)
    best = Best(names, places, true, np.zeros((1, 3)))
    found = errors(record, Paths(true, moved, longer, true), best, updated)
    for name in ("path, best particle", "map, best particle", "map, wheels"):
        assert found[name] == pytest.approx(0.0, abs=1e-12)
    assert found["map, filter"] > 0.1 and found["map, filter, aligned"] < 1e-9
    assert found["path, filter"] > 0.1 and found["path, filter, aligned"] < 1e-9
    assert found["map, odometry"] > found["map, odometry, aligned"] > 0.005
    length = np.linalg.norm(true[-1, 4:])
    assert found["end, odometry"] == pytest.approx(0.05 * length)
