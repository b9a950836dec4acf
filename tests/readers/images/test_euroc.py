"""EuRoC sequences in the ASL layout, of one camera."""

import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.sensors.readers import open_images
from tests.readers.images.folders import (
    CAM0,
    EUROC_NS,
    levels,
    sensor_yaml,
    write_asl_truth,
    write_camera,
    write_euroc,
)

WORLD_FROM_BODY = SE3.from_ypr(
    np.array([[1.0, 2, 3], [2, 2, 3], [3, 3, 3]]), [0.1, 0.2, 0.3], 0.4, [1, -1, 2]
)


def test_a_small_sequence(tmp_path):
    sequence = open_images(write_euroc(tmp_path / "V1_01"))
    assert sequence.name == "V1_01" == open_images(tmp_path / "V1_01" / "mav0").name
    assert sequence.stamps_ns.tolist() == list(EUROC_NS)
    assert sequence.camera.distortion == (-0.1, 0.01, 0.001, -0.002, 0.0)
    assert (sequence.camera.fx, sequence.camera.fy) == (20.0, 21.0)
    assert sequence.baseline_m is None and sequence.truth is None
    assert levels(sequence) == [10, 20, 30]
    assert all(frame.right is None and frame.problem is None for frame in sequence.frames())


def test_a_fisheye_lens(tmp_path):
    camera = open_images(write_euroc(tmp_path, distortion_model="equidistant")).camera
    assert camera.distortion_model == "equidistant"
    assert camera.distortion == (-0.1, 0.01, 0.001, -0.002)


def test_without_the_folder_mav0(tmp_path):
    write_euroc(tmp_path)
    (tmp_path / "mav0").rename(tmp_path / "flight")
    assert open_images(tmp_path / "flight").name == "flight"


@pytest.mark.parametrize("mounted", [None, SE3.identity()])
def test_the_estimated_state_becomes_the_pose_of_the_camera(tmp_path, mounted):
    folder = write_euroc(tmp_path) / "mav0" / "state_groundtruth_estimate0"
    write_asl_truth(folder, WORLD_FROM_BODY, EUROC_NS, mounted, extra=",0.1,0.2,0.3,0,0,0,0,0,0")
    truth = open_images(tmp_path).truth
    expected = SE3.matrix(WORLD_FROM_BODY) @ SE3.matrix(CAM0)
    np.testing.assert_allclose(SE3.matrix(truth.world_from_camera), expected, atol=1e-12)
    assert truth.stamps_ns.tolist() == list(EUROC_NS)


def test_a_marker_is_not_the_body(tmp_path):
    marker = SE3.from_ypr(np.array([0.07, -0.1, 0.2]), 1.0, 0.5, -2.0)
    world_from_marker = SE3.compose(WORLD_FROM_BODY, marker)
    write_asl_truth(write_euroc(tmp_path) / "mav0" / "vicon0", world_from_marker, EUROC_NS, marker)
    expected = SE3.matrix(WORLD_FROM_BODY) @ SE3.matrix(CAM0)
    np.testing.assert_allclose(
        SE3.matrix(open_images(tmp_path).truth.world_from_camera), expected, atol=1e-12
    )


def test_where_a_marker_sits_must_be_known(tmp_path):
    write_asl_truth(write_euroc(tmp_path) / "mav0" / "vicon0", WORLD_FROM_BODY, EUROC_NS)
    with pytest.raises(
        InputError, match=r"vicon0/sensor.yaml: no such file; expected a sensor.yaml with T_BS"
    ):
        open_images(tmp_path)


def test_the_estimated_state_comes_before_the_marker(tmp_path):
    mav = write_euroc(tmp_path) / "mav0"
    write_asl_truth(mav / "vicon0", WORLD_FROM_BODY, EUROC_NS, SE3.identity())
    write_asl_truth(mav / "state_groundtruth_estimate0", WORLD_FROM_BODY[1:], EUROC_NS[1:])
    assert len(open_images(tmp_path).truth.stamps_ns) == 2


def test_a_given_calibration_leaves_the_truth_of_the_camera(tmp_path):
    write_asl_truth(
        write_euroc(tmp_path / "a") / "mav0" / "state_groundtruth_estimate0", WORLD_FROM_BODY, EUROC_NS
    )
    own, given = open_images(tmp_path / "a"), open_images(tmp_path / "a", write_camera(tmp_path, fx=25.0))
    assert given.camera.fx == 25.0 and given.camera.distortion == (0.0,) * 5
    np.testing.assert_array_equal(own.truth.world_from_camera, given.truth.world_from_camera)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"camera_model": "omni"}, "expected camera_model to be pinhole, found 'omni'"),
        (
            {"distortion_model": "fov"},
            "expected distortion_model to be radial-tangential or radtan or equidistant, found 'fov'",
        ),
        (
            {"distortion_model": "equidistant", "distortion_coefficients": [0.0] * 5},
            "expected distortion_coefficients to be a list of 4, found 5",
        ),
        ({"intrinsics": [20.0, 21.0, 11.5]}, "expected intrinsics to be a list of 4, found 3"),
        ({"resolution": [48, 32]}, "width and height are 48x32, the images of .*cam0 have 24x16 px"),
        ({"resolution": [24.5, 16]}, r"expected resolution\[0\] to be a whole number"),
    ],
)
def test_a_camera_that_does_not_fit(tmp_path, changes, message):
    write_euroc(tmp_path, **changes)
    with pytest.raises(InputError, match=rf"cam0/sensor.yaml.*{message}"):
        open_images(tmp_path)


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (np.diag([1.0, 1.0, 2.0, 1.0]), "expected a rotation"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), "expected a rotation"),
        (np.diag([1.0, 1.0, 1.0, 2.0]), "expected the last row of the matrix to be 0 0 0 1"),
        (np.eye(4)[:3], "expected data to be a list of 16, found 12"),
    ],
)
def test_a_mount_that_is_no_rigid_motion(tmp_path, matrix, message):
    file = write_euroc(tmp_path) / "mav0" / "cam0" / "sensor.yaml"
    own = SE3.matrix(CAM0).reshape(-1).tolist()
    assert str(own) in file.read_text()
    file.write_text(file.read_text().replace(str(own), str(matrix.reshape(-1).tolist())))
    with pytest.raises(InputError, match=message):
        open_images(tmp_path)


def test_a_mount_is_needed(tmp_path):
    file = write_euroc(tmp_path) / "mav0" / "cam0" / "sensor.yaml"
    file.write_text(sensor_yaml(CAM0).replace("T_BS", "T_SB"))
    with pytest.raises(InputError, match=r"expected the keys T_BS, .*, found no T_BS"):
        open_images(tmp_path)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("12,12.png\n11,11.png\n", "data.csv, line 2: time runs backwards from 12 to 11"),
        ("timestamp,filename\n", "data.csv, line 1: expected a time in whole nanoseconds, found 'timestamp'"),
        ("1.5,12.png\n", "data.csv, line 1: expected a time in whole nanoseconds, found '1.5'"),
        ("9999999999999999999,12.png\n", "data.csv, line 1: expected a time in whole nanoseconds"),
        ("12\n", "data.csv, line 1: expected a time and the file of an image"),
        ("12,12.png\n", "data.csv: none of 1 images can be read; the first is .*12.png: no such image"),
    ],
)
def test_a_malformed_list(tmp_path, rows, message):
    (write_euroc(tmp_path) / "mav0" / "cam0" / "data.csv").write_text(rows)
    with pytest.raises(InputError, match=message):
        open_images(tmp_path)


def test_truth_of_another_clock(tmp_path):
    folder = write_euroc(tmp_path) / "mav0" / "state_groundtruth_estimate0"
    write_asl_truth(folder, WORLD_FROM_BODY, [0, 1, 2])
    with pytest.raises(InputError, match=r"the poses are at 0.000 .* which is another clock"):
        open_images(tmp_path)
    (folder / "data.csv").write_text(f"{EUROC_NS[0]},1,2,3,1,0,0\n")
    with pytest.raises(InputError, match=r"data.csv, line 1: expected 7 columns .* found 6"):
        open_images(tmp_path)


def test_an_empty_folder_of_a_flight(tmp_path):
    (tmp_path / "mav0").mkdir()
    with pytest.raises(InputError, match=r"cam0/sensor.yaml: no such file; expected an EuRoC sequence"):
        open_images(tmp_path)
