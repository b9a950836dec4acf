"""Pairs of cameras that are rectified: rows agree, focal lengths of wide ones, what is not seen."""

import cv2
import numpy as np
import pytest

from rbpf.lie import SE3
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.readers.images.rectification import OUTSIDE, Rectification

LEFT = Pinhole(160, 120, 110.0, 112.0, 80.0, 58.0, (-0.2, 0.05, 1e-3, -5e-4, 0.0))
RIGHT = Pinhole(160, 120, 108.0, 111.0, 78.0, 61.0, (-0.18, 0.04, 0.0, 1e-3, 0.0))
APART = SE3.from_ypr(np.array([0.12, 0.005, -0.004]), 0.02, -0.03, 0.015)


WIDE_LEFT = Pinhole(160, 120, 66.0, 67.0, 80.0, 58.0, (-0.03, 0.02, -0.012, 0.002), "equidistant")
WIDE_RIGHT = Pinhole(160, 120, 65.0, 65.5, 78.0, 61.0, (0.0, 0.0, 0.0, 0.0), "equidistant")


@pytest.mark.parametrize(
    ("left", "right"),
    [(LEFT, RIGHT), (WIDE_LEFT, WIDE_RIGHT), (LEFT, WIDE_RIGHT)],
    ids=["narrow", "wide", "mixed"],
)
def test_rectified_cameras_see_a_point_on_one_row(left, right):
    done = Rectification.between(left, right, APART, "here")
    assert done.rig.baseline_m == pytest.approx(np.linalg.norm(SE3.translation(APART)), rel=1e-9)
    points = np.random.default_rng(0).uniform([-0.4, -0.3, 1.5], [0.4, 0.3, 4.0], (200, 3))
    rectified = done.rig.project(SE3.inverse_transform(done.left_from_rectified, points))
    inside = done.rig.inside(rectified, 2.0)
    inside &= left.visible(points) & right.visible(SE3.inverse_transform(APART, points))
    assert inside.sum() > 100
    for camera, maps, where, column in (
        (left, done.maps[0], points, 0),
        (right, done.maps[1], SE3.inverse_transform(APART, points), 2),
    ):
        # The map at the rectified place names the place in the image as it was taken.
        place = rectified[inside][:, [column, 1]].astype(np.float32)
        given = np.column_stack(
            [cv2.remap(part, place[:, :1], place[:, 1:], cv2.INTER_LINEAR)[:, 0] for part in maps]
        )
        np.testing.assert_allclose(given, camera.project(where[inside]), atol=0.1)


def test_a_wide_pair_keeps_the_focal_length_of_its_middle():
    done = Rectification.between(WIDE_LEFT, WIDE_RIGHT, APART, "here")
    assert done.rig.camera == Pinhole(160, 120, 65.875, 65.875, 79.0, 59.5)
    assert done.rig.baseline_m == pytest.approx(np.linalg.norm(SE3.translation(APART)), rel=1e-12)


def test_what_a_wide_pair_does_not_see_is_black():
    turned = SE3.from_ypr(SE3.translation(APART), 0.0, 0.8, 0.0)
    done = Rectification.between(WIDE_LEFT, WIDE_RIGHT, turned, "here")
    columns, rows = done.maps[1]
    np.testing.assert_array_equal(columns == OUTSIDE, rows == OUTSIDE)
    assert 0.02 < (columns == OUTSIDE).mean() < 0.5
    white = np.full((120, 160), 255, np.uint8)
    image = cv2.remap(white, columns, rows, cv2.INTER_LINEAR)
    assert (image[columns == OUTSIDE] == 0).all() and image[60, 80] == 255
