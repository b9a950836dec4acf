"""GTSAM and COLMAP adjust the same problem to the same optimum and covariances, and both agree with the truth."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from examples.studies.point_worlds import MONO, DeskWorld, Measuring, simulate_features
from examples.studies.two_optimisers import adjust_by_both, adjust_by_colmap, tangent_slope, with_held
from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.validation.colmap.model import from_colmap_pose
from rbpf.validation.gtsam.observations import CameraEstimate, observation_table
from tests.validation.camera_scenes import BENT, FISHEYE, PLAIN, STEREO, WHOLE, scene

POSES, COVARIANCES = 1e-4, 0.05


def isotropic(log, std=1.0):
    cov = std**2 * np.eye(2)
    frames = [replace(f, cov_z=np.tile(cov, (len(f.z), 1, 1))) for f in log.frames]
    return replace(log, frames=frames)


def nees(errors, covs):
    return np.einsum("ki,ki->k", errors, np.linalg.solve(covs, errors[..., None])[..., 0])


@pytest.mark.parametrize("camera", [BENT, WHOLE, FISHEYE], ids=["four", "five", "fisheye"])
@pytest.mark.parametrize("std", [1.0, 0.4])
def test_small_scenes_have_one_optimum(camera, std):
    log = isotropic(scene(camera=camera, frames=6, points=16, known=5), std)
    found = adjust_by_both(log, log.truth.world_from_camera)
    assert np.abs(found.pose_differences).max() < POSES
    assert found.landmark_differences_m.max() < POSES
    assert found.pose_covariance_errors.max() < COVARIANCES
    assert found.landmark_covariance_errors.max() < COVARIANCES
    assert found.colmap.error == pytest.approx(found.gtsam.error, rel=1e-6)
    assert found.as_dict()["held"] == 5


def test_without_known_points_landmarks_far_apart_are_held():
    log = isotropic(scene(frames=6, points=16, known=0))
    found = adjust_by_both(log, log.truth.world_from_camera)
    assert len(found.log.known.names) == 4
    assert np.abs(found.pose_differences).max() < POSES
    assert found.pose_covariance_errors.max() < COVARIANCES


@pytest.mark.slow
def test_on_a_simulated_desk_both_agree_with_the_truth_within_their_sigma():
    log = simulate_features(DeskWorld(frames=60), Measuring(known=6, known_std_m=0.0), MONO, 0)
    found = adjust_by_both(log, log.truth.world_from_camera)
    assert np.abs(found.pose_differences).max() < POSES
    assert found.pose_covariance_errors.max() < COVARIANCES
    assert found.landmark_covariance_errors.max() < COVARIANCES
    for one in (found.gtsam, found.colmap):
        errors = SE3.local(one.world_from_camera, log.truth.world_from_camera)
        assert 0.5 < nees(errors, one.cov_poses).mean() / 6 < 2.0
        free = [name for name in found.colmap.landmarks if np.trace(one.cov_landmarks[name]) > 1e-12]
        away = np.array([one.landmarks[name] - log.truth.landmarks[name] for name in free])
        covs = np.array([one.cov_landmarks[name] for name in free])
        assert 0.5 < nees(away, covs).mean() / 3 < 2.0


def test_what_colmap_cannot_adjust_is_refused():
    log = isotropic(scene(frames=4, points=12, known=5))
    truth = log.truth
    start = CameraEstimate(truth.world_from_camera, truth.landmarks)
    with pytest.raises(InputError, match="no priors on points"):
        adjust_by_colmap(log, start)
    with pytest.raises(InputError, match="no priors on points"):
        adjust_by_colmap(replace(log, known=None), start)
    names = log.known.names.tolist()
    with pytest.raises(InputError, match="gauge of small scene is not observable"):
        with_held(log, {name: truth.landmarks[name] for name in names[:2]})
    line = {name: np.array([float(i), 2.0 * i, 0.0]) for i, name in enumerate(names)}
    with pytest.raises(InputError, match="not on a line"):
        with_held(log, line)
    held = {name: truth.landmarks[name] for name in names}
    uneven = [replace(f, cov_z=np.tile(np.diag([1.0, 2.0]), (len(f.z), 1, 1))) for f in log.frames]
    with pytest.raises(InputError, match="equally certain"):
        adjust_by_colmap(with_held(replace(log, frames=uneven), held), start)
    pair = scene(camera=STEREO, frames=4, points=12, known=5)
    with pytest.raises(InputError, match="is a stereo log"):
        adjust_by_colmap(pair, CameraEstimate(pair.truth.world_from_camera, pair.truth.landmarks))


def plus(world_from_camera, delta):
    """COLMAP's perturbation of the inverse, written down once more: quaternion by half the angle, t by addition."""
    inverse = SE3.inverse(world_from_camera)
    turn = pycolmap.Rotation3d(2.0 * delta[:3]) * pycolmap.Rotation3d(inverse[:4])
    return from_colmap_pose(pycolmap.Rigid3d(turn, inverse[4:] + delta[3:]))


def test_the_slope_between_the_tangents_is_that_of_numeric_derivatives():
    pose, step = SE3.exp(np.array([0.4, -1.2, 0.7, 3.0, -2.0, 0.5])), 1e-5
    columns = [
        (SE3.local(pose, plus(pose, step * e)) - SE3.local(pose, plus(pose, -step * e))) / (2 * step) for e in np.eye(6)
    ]
    assert tangent_slope(pose) == pytest.approx(np.stack(columns, axis=-1), abs=1e-8)


def test_covariances_of_the_installed_build_have_that_tangent():
    """The inverse of a numeric Hessian over our own tangents, beside what COLMAP returns."""
    log = scene(frames=3, points=12, known=5, camera=PLAIN)
    frames = [replace(f, cov_z=np.tile(np.eye(2), (len(f.z), 1, 1))) for f in log.frames]
    names = log.known.names.tolist()
    log = with_held(replace(log, frames=frames), {name: log.truth.landmarks[name] for name in names})
    table = observation_table(log).determined(set(names))
    found = adjust_by_colmap(log, CameraEstimate(log.truth.world_from_camera, log.truth.landmarks))
    free = [name for name in table.names.tolist() if name not in names]

    def residuals(x):
        path = SE3.retract(found.world_from_camera, x[:18].reshape(3, 6))
        moved = found.landmarks | dict(
            zip(free, np.array([found.landmarks[n] for n in free]) + x[18:].reshape(-1, 3), strict=True)
        )
        points = np.array([moved[name] for name in table.names.tolist()])
        local = SE3.inverse_transform(path[table.steps], points[table.index])
        return (log.camera.project(local) - table.z).ravel()

    size, step = 18 + 3 * len(free), 1e-5
    slope = np.stack([(residuals(step * e) - residuals(-step * e)) / (2 * step) for e in np.eye(size)], axis=-1)
    assert np.abs(slope.T @ residuals(np.zeros(size))).max() < 1e-3, "not an optimum"
    cov = np.linalg.inv(slope.T @ slope)
    for frame in range(3):
        block = cov[6 * frame : 6 * frame + 6, 6 * frame : 6 * frame + 6]
        assert found.cov_poses[frame] == pytest.approx(block, rel=1e-4, abs=1e-4 * np.abs(block).max())
    for row, name in enumerate(free):
        at = 18 + 3 * row
        block = cov[at : at + 3, at : at + 3]
        assert found.cov_landmarks[name] == pytest.approx(block, rel=1e-3, abs=1e-4 * np.abs(block).max())
