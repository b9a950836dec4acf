"""Folders of images, and the camera file that all formats share."""

import logging
from dataclasses import replace

import pytest

from rbpf.errors import InputError
from rbpf.sensors.readers import open_images
from tests.readers.images.folders import SIZE, levels, write_camera, write_images, write_plain


def test_images_in_the_folder_itself_are_ordered_by_the_numbers_in_their_names(tmp_path):
    sequence = open_images(write_plain(tmp_path / "shelf", ["2.png", "10.png", "9.png"]))
    assert sequence.name == "shelf"
    assert levels(sequence) == [10, 30, 20]
    assert sequence.truth is None


def test_images_in_a_folder_of_their_own_beside_other_files(tmp_path):
    write_images(tmp_path / "images", ["a.jpg", "b.PNG".lower()])
    write_camera(tmp_path)
    (tmp_path / "README.md").write_text("about\n")
    assert len(open_images(tmp_path)) == 2


def test_stamps_without_a_rate_are_those_of_an_ordinary_video_and_this_is_said(tmp_path, caplog):
    with caplog.at_level(logging.INFO):
        sequence = open_images(write_plain(tmp_path))
    assert sequence.stamps_ns.tolist() == [0, 33_333_333, 66_666_667]
    assert "no times.txt and no rate_hz" in caplog.text


def test_stamps_of_a_rate(tmp_path):
    assert open_images(write_plain(tmp_path, rate_hz=8)).stamps_ns.tolist() == [0, 125_000_000, 250_000_000]


def test_stamps_and_truth_of_files(tmp_path):
    write_plain(tmp_path)
    (tmp_path / "times.txt").write_text("# s\n0.5\n0.5\n1\n")
    (tmp_path / "groundtruth.txt").write_text("0.7 1 2 3 0 0 0 1\n")
    sequence = open_images(tmp_path)
    assert sequence.stamps_ns.tolist() == [500_000_000, 500_000_000, 1_000_000_000]
    assert sequence.truth.stamps_ns.tolist() == [700_000_000]


def test_another_number_of_times_than_images(tmp_path):
    (write_plain(tmp_path) / "times.txt").write_text("0.5\n1\n")
    with pytest.raises(InputError, match=r"times.txt: expected 3 times, one per image, found 2"):
        open_images(tmp_path)


def test_a_folder_with_a_camera_and_no_images(tmp_path):
    write_camera(tmp_path)
    with pytest.raises(InputError, match="expected images in it or in its images/, found none"):
        open_images(tmp_path)


def test_distortion_of_four_or_five_numbers(tmp_path):
    write_plain(tmp_path, distortion=[0.1, -0.2, 0.001, 0.002])
    assert open_images(tmp_path).camera.distortion == (0.1, -0.2, 0.001, 0.002, 0.0)
    write_camera(tmp_path, model="pinhole", distortion=[0.1, -0.2, 0.001, 0.002, 0.3])
    assert open_images(tmp_path).camera.distortion == (0.1, -0.2, 0.001, 0.002, 0.3)


def test_a_fisheye_lens(tmp_path):
    write_plain(tmp_path, model="fisheye", distortion=[0.1, -0.2, 0.001, 0.002])
    camera = open_images(tmp_path).camera
    assert (camera.distortion_model, camera.distortion) == ("equidistant", (0.1, -0.2, 0.001, 0.002))
    write_camera(tmp_path, model="fisheye")
    assert open_images(tmp_path).camera == replace(camera, distortion=(0.0,) * 4)


def test_a_first_line_as_opencv_writes_it(tmp_path):
    path = write_camera(write_plain(tmp_path))
    path.write_text("%YAML:1.0\n---\n" + path.read_text())
    assert open_images(tmp_path).camera.fx == 20.0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"width": 48, "height": 32},
            "camera.yaml: width and height are 48x32, the images of .* have 24x16 px",
        ),
        ({"fx": None}, "camera.yaml, line 1: expected the keys fx, fy, cx, cy, width, height, found no fx"),
        ({"fx": -1}, "camera.yaml, line 1: expected fx to be positive, found -1"),
        ({"fy": "wide"}, "camera.yaml, line 2: expected fy to be a finite number, found 'wide'"),
        ({"cx": "[1, 2]"}, "camera.yaml, line 3: expected cx to be a single value"),
        ({"width": 24.5}, "camera.yaml, line 5: expected width to be a whole number, found 24.5"),
        (
            {"distorsion": "[0, 0, 0, 0]"},
            "camera.yaml, line 7: expected the keys fx, .*; also known: .*; found .distorsion.",
        ),
        (
            {"distortion": "[0, 0]"},
            "camera.yaml, line 7: expected distortion to be a list of 4 or 5, found 2",
        ),
        ({"distortion": 0}, "camera.yaml, line 7: expected distortion to be a list of 4 or 5, found no list"),
        (
            {"distortion": "[0, 0, .nan, 0]"},
            r"camera.yaml, line 7: expected distortion\[2\] to be a finite number",
        ),
        ({"model": "omni"}, "camera.yaml, line 7: expected model to be pinhole or fisheye, found 'omni'"),
        (
            {"model": "fisheye", "distortion": "[0, 0, 0, 0, 0]"},
            "camera.yaml, line 8: expected distortion to be a list of 4, found 5",
        ),
        ({"baseline_m": -1}, "camera.yaml, line 7: expected baseline_m to be positive, found -1"),
        ({"rate_hz": 0}, "camera.yaml, line 7: expected rate_hz to be positive, found 0"),
    ],
)
def test_a_calibration_that_does_not_fit(tmp_path, changes, message):
    write_plain(tmp_path, **changes)
    with pytest.raises(InputError, match=message):
        open_images(tmp_path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("fx: 1\nfx: 2\n", "line 2: fx comes a second time"),
        ("- 1\n", "line 1: expected the keys fx, .*, found no mapping"),
        ("a: [1\nb: 2\n", "line 2: expected YAML, found a syntax error"),
        ("# only\n", "found only comments"),
        ("[" * 1500, "expected YAML, found something else"),
    ],
)
def test_a_camera_file_that_is_none(tmp_path, text, message):
    (write_plain(tmp_path) / "camera.yaml").write_text(text)
    with pytest.raises(InputError, match=message):
        open_images(tmp_path)


def test_the_size_expected_is_that_of_the_images(tmp_path):
    sequence = open_images(write_plain(tmp_path))
    assert (sequence.camera.height, sequence.camera.width) == SIZE
