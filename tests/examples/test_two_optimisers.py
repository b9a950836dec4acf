"""GTSAM and COLMAP adjust the same problem to the same optimum and covariances, and both agree with the truth."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from examples.studies.two_optimisers import adjust_by_both, adjust_by_colmap, tangent_slope, with_held
from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.validation.colmap.model import from_colmap_pose
from rbpf.validation.gtsam.observations import CameraEstimate
from tests.validation.camera_scenes import BENT, FISHEYE, STEREO, WHOLE, scene

POSES, COVARIANCES = 1e-4, 0.05


def isotropic(log, std=1.0):
    cov = std**2 * np.eye(2)
    frames = [replace(f, cov_z=np.tile(cov, (len(f.z), 1, 1))) for f in log.frames]
    return replace(log, frames=frames)


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
