"""The second camera of an EuRoC sequence."""

import logging

import numpy as np
import pytest

from rbpf.lie import SE3
from rbpf.sensors.readers.images import open_images
from tests.readers.images.folders import (
    CAM0,
    EUROC_NS,
    levels,
    sensor_yaml,
    write_camera,
    write_image,
    write_rectified,
)

STRAIGHT = {"distortion_coefficients": [0.0, 0.0, 0.0, 0.0]}


def right_levels(sequence):
    return [None if frame.right is None else int(frame.right[0, 0]) for frame in sequence.frames()]


def test_a_rectified_pair(tmp_path):
    sequence = open_images(write_rectified(tmp_path))
    assert sequence.baseline_m == pytest.approx(0.11, abs=1e-12)
    assert levels(sequence) == [10, 20, 30]
    assert right_levels(sequence) == [100, 110, 120]
    assert all(frame.problem is None for frame in sequence.frames())


def test_images_are_paired_by_their_times(tmp_path):
    sequence = open_images(write_rectified(tmp_path, right=(EUROC_NS[0], EUROC_NS[2])))
    assert levels(sequence) == [10, 20, 30]
    assert right_levels(sequence) == [100, None, 110]
    problems = [frame.problem for frame in sequence.frames()]
    assert problems == [None, "The second camera has no image of this time.", None]


def test_a_right_image_that_cannot_be_read_leaves_the_left_one(tmp_path):
    write_rectified(tmp_path)
    write_image(tmp_path / "mav0" / "cam1" / "data" / f"{EUROC_NS[1]}.png", np.zeros((16, 30), np.uint8))
    frame = list(open_images(tmp_path).frames())[1]
    assert frame.image is not None and frame.right is None
    assert "cam1" in frame.problem and "expected 24x16 px" in frame.problem


@pytest.mark.parametrize(
    "changes",
    [
        {"distortion_coefficients": [0.1, 0.0, 0.0, 0.0]},
        {"distortion_model": "equidistant"},
        {"intrinsics": [20.5, 21.0, 11.5, 7.5]},
        {"resolution": [26, 16]},
    ],
)
def test_cameras_that_differ_are_read_as_one(tmp_path, caplog, changes):
    with caplog.at_level(logging.INFO):
        sequence = open_images(write_rectified(tmp_path, **changes))
    assert sequence.baseline_m is None
    assert right_levels(sequence) == [None, None, None]
    assert [frame.problem for frame in sequence.frames()] == [None, None, None]
    assert "cam1: left out, as the two cameras are not rectified" in caplog.text


@pytest.mark.parametrize(
    "left_from_right",
    [
        [0, 0, 0, 1, -0.11, 0, 0],
        [0, 0, 0, 1, 0.11, 0.01, 0],
        [0, 0.01, 0, 0.99995, 0.11, 0, 0],
    ],
)
def test_cameras_that_are_not_side_by_side_are_read_as_one(tmp_path, left_from_right):
    write_rectified(tmp_path)
    mount = SE3.compose(CAM0, SE3.normalise(np.array(left_from_right, float)))
    (tmp_path / "mav0" / "cam1" / "sensor.yaml").write_text(sensor_yaml(mount, **STRAIGHT))
    assert open_images(tmp_path).baseline_m is None


def test_a_given_calibration_may_bring_its_baseline(tmp_path):
    write_rectified(tmp_path / "a")
    assert open_images(tmp_path / "a", write_camera(tmp_path, baseline_m=0.12)).baseline_m == 0.12
    (tmp_path / "a" / "mav0" / "cam1").rename(tmp_path / "a" / "mav0" / "cam2")
    assert open_images(tmp_path / "a", write_camera(tmp_path, baseline_m=0.12)).baseline_m is None


def test_a_given_calibration_with_distortion_makes_it_one_camera(tmp_path):
    write_rectified(tmp_path / "a")
    assert open_images(tmp_path / "a", write_camera(tmp_path)).baseline_m == pytest.approx(0.11)
    bent = write_camera(tmp_path, distortion=[0.1, 0, 0, 0])
    assert open_images(tmp_path / "a", bent).baseline_m is None
    fisheye = write_camera(tmp_path, model="fisheye")
    assert open_images(tmp_path / "a", fisheye).baseline_m is None
