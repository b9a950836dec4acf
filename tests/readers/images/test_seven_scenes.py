"""7-Scenes sequences."""

import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.sensors.readers import open_images
from tests.readers.images.folders import levels, write_camera, write_seven_scenes


def test_a_small_sequence(tmp_path):
    sequence = open_images(write_seven_scenes(tmp_path / "seq-01"))
    assert sequence.name == "seq-01"
    assert sequence.stamps_ns.tolist() == [0, 33_333_333, 133_333_333]
    camera = sequence.camera
    assert (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy) == (
        640,
        480,
        525,
        525,
        320,
        240,
    )
    expected = SE3.from_ypr(np.array([[0.0, 2, 3], [1, 2, 3], [4, 2, 3]]), [0.0, 0.1, 0.4], 0.2, 0.3)
    np.testing.assert_allclose(sequence.truth.world_from_camera, expected, atol=1e-12)
    np.testing.assert_array_equal(sequence.truth.stamps_ns, sequence.stamps_ns)
    assert levels(sequence) == [10, 20, 30]


@pytest.mark.parametrize("text", [None, "nan " * 16, "inf 0 0 0\n" * 4])
def test_where_tracking_was_lost_the_truth_has_a_gap(tmp_path, text):
    pose = write_seven_scenes(tmp_path) / "frame-000001.pose.txt"
    pose.unlink() if text is None else pose.write_text(text)
    sequence = open_images(tmp_path)
    assert len(sequence) == 3
    assert sequence.truth.stamps_ns.tolist() == [0, 133_333_333]


def test_without_poses(tmp_path):
    for pose in write_seven_scenes(tmp_path).glob("*.pose.txt"):
        pose.unlink()
    assert open_images(tmp_path).truth is None


def test_a_calibration_of_its_own(tmp_path):
    write_seven_scenes(tmp_path, size=(16, 24))
    with pytest.raises(
        InputError, match="the nominal camera of 7-Scenes: width and height are 640x480, the images"
    ):
        open_images(tmp_path)
    write_camera(tmp_path)
    assert open_images(tmp_path).camera.fx == 20.0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 2 3\n", "frame-000001.pose.txt: expected 16 numbers, found 3"),
        ("one " * 16, "frame-000001.pose.txt: expected 16 numbers, found 'one one"),
        ("1 " * 16, "frame-000001.pose.txt: expected a rotation"),
        ("", "frame-000001.pose.txt: the file is empty; expected a 4 x 4 matrix"),
    ],
)
def test_a_malformed_pose(tmp_path, text, message):
    (write_seven_scenes(tmp_path) / "frame-000001.pose.txt").write_text(text)
    with pytest.raises(InputError, match=message):
        open_images(tmp_path)


def test_two_images_of_one_number(tmp_path):
    image = write_seven_scenes(tmp_path) / "frame-000001.color.png"
    (tmp_path / "frame-000001.color.jpg").write_bytes(image.read_bytes())
    with pytest.raises(
        InputError, match=r"found frame-000001.color.jpg and frame-000001.color.png, expected one"
    ):
        open_images(tmp_path)


def test_no_image_of_a_known_kind(tmp_path):
    (tmp_path / "frame-000000.color.txt").write_text("something\n")
    with pytest.raises(InputError, match="expected images, found none"):
        open_images(tmp_path)
