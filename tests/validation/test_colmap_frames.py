"""COLMAP's pixels, poses and tangents in ours, against COLMAP itself and numeric derivatives of the installed build."""

from dataclasses import replace

import numpy as np
import pytest

from rbpf.lie import SE3
from rbpf.sensors.camera import Pinhole
from rbpf.validation.colmap.model import HALF_PX, from_colmap_pose, to_colmap_camera, to_colmap_pose
from tests.validation.camera_scenes import BENT, FISHEYE, PLAIN, WHOLE


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


def test_camera_models_are_the_simplest_that_fit():
    camera = Pinhole(640, 480, 500.0, 510.0, 320.0, 240.0)
    assert to_colmap_camera(camera).model_name == "PINHOLE"
    assert to_colmap_camera(replace(camera, distortion=(0.1, 0.0, 0.0, 0.0, 0.0))).model_name == "OPENCV"
    assert to_colmap_camera(replace(camera, distortion=(0.1, 0.0, 0.0, 0.0, 0.1))).model_name == "FULL_OPENCV"
    assert to_colmap_camera(FISHEYE).model_name == "OPENCV_FISHEYE"
