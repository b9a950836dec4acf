"""COLMAP's pixels, poses and tangents in ours, against COLMAP itself and numeric derivatives of the installed build."""

import numpy as np
import pytest

from rbpf.lie import SE3
from rbpf.validation.colmap.model import HALF_PX, from_colmap_pose, to_colmap_camera, to_colmap_pose
from tests.validation.camera_scenes import BENT, FISHEYE, PLAIN, WHOLE


@pytest.mark.parametrize(
    ("camera", "model"), [(PLAIN, "PINHOLE"), (BENT, "OPENCV"), (WHOLE, "FULL_OPENCV"), (FISHEYE, "OPENCV_FISHEYE")]
)
def test_the_simplest_model_that_fits_projects_as_we_do_but_for_half_a_pixel(camera, model):
    points = np.random.default_rng(0).uniform([-0.6, -0.5, 1.0], [0.6, 0.5, 2.0], (50, 3))
    theirs = to_colmap_camera(camera)
    assert theirs.model_name == model
    assert theirs.img_from_cam(points) - HALF_PX == pytest.approx(camera.project(points), abs=1e-9)


def test_a_pose_survives_both_ways_and_means_the_same():
    pose = SE3.exp(np.array([0.4, -1.2, 0.7, 3.0, -2.0, 0.5]))
    theirs = to_colmap_pose(pose)
    point = np.array([0.3, 4.0, -1.0])
    assert theirs * point == pytest.approx(SE3.inverse_transform(pose, point))
    assert SE3.local(pose, from_colmap_pose(theirs)) == pytest.approx(np.zeros(6), abs=1e-12)
