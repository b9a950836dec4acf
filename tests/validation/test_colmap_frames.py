"""COLMAP's pixels, poses and tangents in ours, against COLMAP itself and numeric derivatives of the installed build."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from rbpf.lie import SE3
from rbpf.sensors.camera import Pinhole
from rbpf.validation.colmap.adjust import adjust_by_colmap, with_held
from rbpf.validation.colmap.frames import (
    HALF_PX,
    from_colmap_covariance,
    from_colmap_pose,
    tangent_slope,
    to_colmap_camera,
    to_colmap_pose,
)
from rbpf.validation.gtsam.camera_data import CameraEstimate, sightings_of
from tests.validation.camera_scenes import BENT, FISHEYE, PLAIN, WHOLE, scene


@pytest.mark.parametrize("camera", [PLAIN, BENT, WHOLE, FISHEYE], ids=["plain", "four", "five", "fisheye"])
def test_colmap_projects_as_we_do_but_for_half_a_pixel(camera):
    points = np.random.default_rng(0).uniform([-0.6, -0.5, 1.0], [0.6, 0.5, 2.0], (50, 3))
    theirs = to_colmap_camera(camera).img_from_cam(points)
    assert theirs - HALF_PX == pytest.approx(camera.project(points), abs=1e-9)


def test_a_pose_survives_both_ways_and_means_the_same():
    pose = SE3.exp(np.array([0.4, -1.2, 0.7, 3.0, -2.0, 0.5]))
    theirs = to_colmap_pose(pose)
    point = np.array([0.3, 4.0, -1.0])
    assert theirs * point == pytest.approx(SE3.inverse_transform(pose, point))
    assert SE3.local(pose, from_colmap_pose(theirs)) == pytest.approx(np.zeros(6), abs=1e-12)


def plus(world_from_camera, delta):
    """COLMAP's perturbation of the inverse, written down once more: quaternion by half the angle, t by addition."""
    inverse = SE3.inverse(world_from_camera)
    turn = pycolmap.Rotation3d(2.0 * delta[:3]) * pycolmap.Rotation3d(inverse[:4])
    return from_colmap_pose(pycolmap.Rigid3d(turn, inverse[4:] + delta[3:]))


def test_the_slope_between_the_tangents_is_that_of_numeric_derivatives():
    pose, step = SE3.exp(np.array([0.4, -1.2, 0.7, 3.0, -2.0, 0.5])), 1e-5
    columns = [
        (SE3.local(pose, plus(pose, step * e)) - SE3.local(pose, plus(pose, -step * e))) / (2 * step)
        for e in np.eye(6)
    ]
    assert tangent_slope(pose) == pytest.approx(np.stack(columns, axis=-1), abs=1e-8)


def test_covariances_of_the_installed_build_have_that_tangent():
    """The inverse of a numeric Hessian over our own tangents, beside what COLMAP returns."""
    log = scene(frames=3, points=12, known=5, camera=PLAIN)
    frames = [replace(f, cov_z=np.tile(np.eye(2), (len(f.z), 1, 1))) for f in log.frames]
    names = log.known.names.tolist()
    log = with_held(replace(log, frames=frames), {name: log.truth.landmarks[name] for name in names})
    table = sightings_of(log).determined(set(names))
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
    slope = np.stack(
        [(residuals(step * e) - residuals(-step * e)) / (2 * step) for e in np.eye(size)], axis=-1
    )
    assert np.abs(slope.T @ residuals(np.zeros(size))).max() < 1e-3, "not an optimum"
    cov = np.linalg.inv(slope.T @ slope)
    for frame in range(3):
        block = cov[6 * frame : 6 * frame + 6, 6 * frame : 6 * frame + 6]
        assert found.cov_poses[frame] == pytest.approx(block, rel=1e-4, abs=1e-4 * np.abs(block).max())
    for row, name in enumerate(free):
        at = 18 + 3 * row
        block = cov[at : at + 3, at : at + 3]
        assert found.cov_landmarks[name] == pytest.approx(block, rel=1e-3, abs=1e-4 * np.abs(block).max())


def test_a_covariance_is_turned_as_its_slope_says():
    pose, cov = SE3.exp(np.array([0.1, 0.2, 0.3, 1.0, 2.0, 3.0])), np.diag(np.arange(1.0, 7.0))
    slope = tangent_slope(pose)
    assert from_colmap_covariance(cov, pose) == pytest.approx(slope @ cov @ slope.T)
    assert from_colmap_covariance(cov, pose)[0, 0] == pytest.approx(4.0)


def test_camera_models_are_the_simplest_that_fit():
    camera = Pinhole(640, 480, 500.0, 510.0, 320.0, 240.0)
    assert to_colmap_camera(camera).model_name == "PINHOLE"
    assert to_colmap_camera(replace(camera, distortion=(0.1, 0.0, 0.0, 0.0, 0.0))).model_name == "OPENCV"
    assert to_colmap_camera(replace(camera, distortion=(0.1, 0.0, 0.0, 0.0, 0.1))).model_name == "FULL_OPENCV"
    assert to_colmap_camera(FISHEYE).model_name == "OPENCV_FISHEYE"
