"""Video files."""

from unittest import mock

import cv2
import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.sensors.readers import open_images
from tests.readers.images.folders import levels, write_camera, write_video


@pytest.mark.parametrize(
    ("name", "codec"), [("walk.avi", "MJPG"), ("000001.mp4", "mp4v"), ("walk.mkv", "MJPG")]
)
def test_a_small_video(tmp_path, name, codec):
    sequence = open_images(write_video(tmp_path / name, codec=codec))
    assert sequence.name == name.split(".")[0]
    assert len(sequence) == 12
    assert sequence.stamps_ns[:3].tolist() == [0, 40_000_000, 80_000_000]
    assert sequence.truth is None and sequence.baseline_m is None
    assert (sequence.camera.width, sequence.camera.height) == (64, 48)
    frames = list(sequence.frames())
    assert all(frame.image.shape == (48, 64) and frame.image.dtype == np.uint8 for frame in frames)
    np.testing.assert_allclose(levels(sequence), np.arange(12) * 10 + 5, atol=3)
    np.testing.assert_allclose(levels(sequence, 7), np.arange(7, 12) * 10 + 5, atol=3)
    assert [frame.stamp_ns for frame in sequence.frames(10)] == [400_000_000, 440_000_000]


def test_a_rate_of_the_camera_file_replaces_that_of_the_video(tmp_path):
    path = write_video(tmp_path / "walk.avi")
    camera = write_camera(tmp_path / "..", width=64, height=48, rate_hz=10)
    assert open_images(path, camera).stamps_ns[1] == 100_000_000


@pytest.mark.parametrize("name", ["walk.avi", "walk.mkv"])
def test_a_video_that_ends_in_mid_frame_keeps_what_was_read_and_says_so(tmp_path, name):
    path = write_video(tmp_path / name, count=60, size=(240, 320))
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 6 // 10])
    sequence = open_images(path)
    *kept, last = sequence.frames()
    assert 25 <= len(kept) <= 40
    assert all(frame.image is not None and frame.problem is None for frame in kept)
    assert last.image is None
    assert last.problem == f"{path}: the video ends after {len(kept)} of 60 images; those are kept."


def test_a_video_without_its_index_cannot_be_opened(tmp_path):
    path = write_video(tmp_path / "walk.mp4", codec="mp4v")
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(
        InputError, match=r"walk.mp4: OpenCV cannot open the video; convert it, or copy it again"
    ):
        open_images(path)


@pytest.mark.parametrize("content", [b"", b"some text\n" * 100])
def test_no_video(tmp_path, content):
    path = write_video(tmp_path / "walk.avi")
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"walk.avi: OpenCV cannot open the video"):
        open_images(path)


def test_without_a_calibration(tmp_path):
    path = write_video(tmp_path / "walk.avi")
    (tmp_path / "camera.yaml").unlink()
    with pytest.raises(InputError, match=r"camera.yaml: no such file; expected a camera.yaml with the keys"):
        open_images(path)


def test_a_calibration_of_another_size(tmp_path):
    path = write_video(tmp_path / "walk.avi")
    write_camera(tmp_path)
    with pytest.raises(
        InputError, match=r"width and height are 24x16, the images of .*walk.avi have 64x48 px"
    ):
        open_images(path)


class Capture:
    """A video with a header of any kind."""

    def __init__(self, images, **header):
        self.images, self.header = iter(images), header

    def isOpened(self):  # noqa: N802
        return True

    def get(self, name):
        return self.header["count"] if name == cv2.CAP_PROP_FRAME_COUNT else self.header["rate"]

    def grab(self):
        return next(self.images, None) is not None

    def read(self):
        image = next(self.images, None)
        return image is not None, image

    def release(self):
        self.images = iter(())


def sequence_of(tmp_path, images, **header):
    path = tmp_path / "walk.avi"
    path.write_bytes(b"")
    write_camera(tmp_path)
    with mock.patch.object(cv2, "VideoCapture", side_effect=lambda *_: Capture(images, **header)):
        sequence = open_images(path)
        return sequence, list(sequence.frames())


IMAGE = np.full((16, 24, 3), 70, np.uint8)


@pytest.mark.parametrize("count", [-1.0, 0.0, float("nan")])
def test_a_header_without_a_number_and_a_rate(tmp_path, count):
    sequence, frames = sequence_of(tmp_path, [IMAGE] * 5, count=count, rate=0.0)
    assert len(sequence) == 5 == len(frames)
    assert sequence.stamps_ns[:2].tolist() == [0, 33_333_333]


def test_a_size_that_changes_ends_the_video(tmp_path):
    _, frames = sequence_of(tmp_path, [IMAGE, IMAGE[:, :20], IMAGE], count=3.0, rate=25.0)
    assert [frame.image is None for frame in frames] == [False, True]
    assert "expected 24x16 px as in the camera file, found 20x16 px" in frames[1].problem


def test_grey_and_deep_images(tmp_path):
    _, frames = sequence_of(
        tmp_path, [IMAGE[..., :1], np.full((16, 24), 65535, np.uint16)], count=2.0, rate=25.0
    )
    assert [int(frame.image[0, 0]) for frame in frames] == [70, 255]


def test_no_image_of_the_video_can_be_decoded(tmp_path):
    with pytest.raises(InputError, match="not one image of the video can be decoded"):
        sequence_of(tmp_path, [], count=3.0, rate=25.0)
