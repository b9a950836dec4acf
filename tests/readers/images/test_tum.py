"""TUM RGB-D sequences: a small one, and whatever can be wrong with one."""

import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.sensors.readers import open_images
from tests.readers.images.folders import CAMERA, levels, write_camera, write_tum


def test_a_small_sequence(tmp_path):
    sequence = open_images(write_tum(tmp_path / "desk"))
    assert sequence.name == "desk"
    assert len(sequence) == 3
    assert sequence.stamps_ns.dtype == np.int64
    assert sequence.stamps_ns.tolist() == [1_500_000_000, 1_600_000_000, 1_700_000_000]
    assert (sequence.camera.fx, sequence.camera.cy) == (CAMERA["fx"], CAMERA["cy"])
    assert sequence.baseline_m is None
    assert levels(sequence) == [10, 20, 30]


def test_the_truth_keeps_its_own_times_and_its_gaps(tmp_path):
    truth = open_images(write_tum(tmp_path)).truth
    assert truth.stamps_ns.tolist() == [1_500_000_000, 1_700_000_000]
    np.testing.assert_array_equal(truth.world_from_camera, [[0, 0, 0, 1, 1, 2, 3], [0, 0, 1, 0, 1, 2, 4]])
    assert truth.landmarks == {}


def test_a_quaternion_of_few_digits_is_scaled_to_length_one(tmp_path):
    rounded = "1.5 1 2 3 0.4564 0.1000 0.3652 0.8049"
    truth = open_images(write_tum(tmp_path, truth=[rounded])).truth
    assert np.linalg.norm(truth.world_from_camera[0, :4]) == pytest.approx(1.0, abs=1e-15)


def test_without_truth(tmp_path):
    (write_tum(tmp_path) / "groundtruth.txt").unlink()
    assert open_images(tmp_path).truth is None


def test_ends_of_lines_of_another_system_comments_and_blank_lines(tmp_path):
    write_tum(tmp_path)
    for name in ("rgb.txt", "groundtruth.txt", "camera.yaml"):
        text = (tmp_path / name).read_text()
        (tmp_path / name).write_bytes(("# a comment\n\n" + text).replace("\n", "\r\n").encode())
    sequence = open_images(str(tmp_path))
    assert levels(sequence) == [10, 20, 30]
    assert len(sequence.truth.stamps_ns) == 2


def test_a_time_keeps_all_its_digits(tmp_path):
    write_tum(tmp_path, ["1305031102.175304123", "1305031102.2"], ["1.3050311021754e+09 0 0 0 0 0 0 1"])
    sequence = open_images(tmp_path)
    assert sequence.stamps_ns.tolist() == [1305031102175304123, 1305031102200000000]
    assert sequence.truth.stamps_ns.tolist() == [1305031102175400000]


def test_equal_times_are_kept(tmp_path):
    write_tum(tmp_path, ["1.5", "1.50", "1.6"])
    assert open_images(tmp_path).stamps_ns.tolist() == [1_500_000_000, 1_500_000_000, 1_600_000_000]


@pytest.mark.parametrize("name", ["rgb.txt", "groundtruth.txt"])
def test_time_that_runs_backwards_is_named_with_file_and_line(tmp_path, name):
    rows = {"rgb.txt": "{} rgb/1.5.png", "groundtruth.txt": "{} 0 0 0 0 0 0 1"}
    write_tum(tmp_path)
    (tmp_path / name).write_text(
        "# first\n" + "".join(rows[name].format(t) + "\n" for t in ("1.5", "1.7", "1.6"))
    )
    with pytest.raises(InputError, match=rf"{name}, line 4: time runs backwards from 1.7 to 1.6"):
        open_images(tmp_path)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("rgb.txt", "# nothing\n", "rgb.txt: expected lines that begin with a time, found none"),
        ("rgb.txt", "", "rgb.txt: the file is empty"),
        ("rgb.txt", "1.5\n", "rgb.txt, line 1: expected a time and the file of an image"),
        (
            "rgb.txt",
            "1.5 rgb/1.5.png\nsoon rgb/1.6.png\n",
            "rgb.txt, line 2: expected the time to be a finite number",
        ),
        (
            "rgb.txt",
            "1305031102175304123 rgb/1.5.png\n",
            "rgb.txt, line 1: expected the time in seconds, within 4e.09",
        ),
        ("rgb.txt", "1.5 rgb/1.5.png\n1.6 rgb/1.", "rgb.txt, line 2: the file ends inside this line"),
        ("groundtruth.txt", "1.5 1 2 3 0 0 1\n", "groundtruth.txt, line 1: expected 7 columns .* found 6"),
        (
            "groundtruth.txt",
            "1.5 1 2 3 0 0 nan 1\n",
            "groundtruth.txt, line 1: expected qz to be a finite number",
        ),
        (
            "groundtruth.txt",
            "#\n1.5 1 2 3 0 0 1 1\n",
            "groundtruth.txt, line 2: expected a quaternion of length 1",
        ),
        (
            "groundtruth.txt",
            "99 1 2 3 0 0 0 1\n",
            "groundtruth.txt: the poses are at 99.000 .* which is another clock",
        ),
        (
            "groundtruth.txt",
            "0 1 2 3 0 0 0 1\n",
            "groundtruth.txt: the poses are at 0.000 .* which is another clock",
        ),
    ],
)
def test_a_malformed_file(tmp_path, name, text, message):
    write_tum(tmp_path)
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=message):
        open_images(tmp_path)


def test_without_a_calibration(tmp_path):
    (write_tum(tmp_path) / "camera.yaml").unlink()
    with pytest.raises(
        InputError, match=r"camera.yaml: no such file; expected a camera.yaml with the keys fx, fy"
    ):
        open_images(tmp_path)


def test_a_given_calibration_replaces_that_of_the_folder(tmp_path):
    folder = write_tum(tmp_path / "desk")
    assert open_images(folder, write_camera(tmp_path, fx=33.0)).camera.fx == 33.0
