"""KITTI odometry sequences."""

import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.sensors.readers import open_images, open_stereo
from tests.readers.images.folders import P0, P1, levels, matrix_row, write_camera, write_images, write_kitti

POSES = SE3.from_ypr(np.array([[0.0, 0, 0], [0, 0, 1], [0.1, 0, 2]]), [0.0, 0.1, 0.2], 0.0, 0.0)


def test_a_small_sequence(tmp_path):
    sequence = open_images(write_kitti(tmp_path / "00"))
    assert sequence.name == "00"
    assert sequence.stamps_ns.tolist() == [0, 100_000_000, 200_000_000]
    camera = sequence.camera
    assert (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy) == (
        24,
        16,
        20,
        21,
        11.5,
        7.5,
    )
    assert sequence.baseline_m is None and sequence.truth is None
    assert levels(sequence) == [10, 20, 30]
    assert all(frame.right is None for frame in sequence.frames())
    assert levels(open_images(write_kitti(tmp_path / "01", right=False, calib=P0))) == [10, 20, 30]


@pytest.mark.parametrize("place", ["poses.txt", "../../poses/00.txt"])
def test_the_truth_beside_the_images_or_as_distributed(tmp_path, place):
    folder = write_kitti(tmp_path / "sequences" / "00")
    (tmp_path / "poses").mkdir()
    (folder / place).write_text("".join(map(matrix_row, POSES)))
    sequence = open_images(folder)
    np.testing.assert_allclose(sequence.truth.world_from_camera, POSES, atol=1e-12)
    np.testing.assert_array_equal(sequence.truth.stamps_ns, sequence.stamps_ns)


def test_the_colour_pair_has_its_own_place(tmp_path):
    write_kitti(tmp_path)
    for number in (0, 1):
        (tmp_path / f"image_{number}").rename(tmp_path / f"image_{number + 2}")
    p2, p3 = "P2: 20 0 11.5 1.2 0 21 7.5 2.1 0 0 1 0.3\n", "P3: 20 0 11.5 -9.6 0 21 7.5 2.1 0 0 1 0.3\n"
    (tmp_path / "calib.txt").write_text(P0 + P1 + "\n" + p2 + p3 + "Tr: 1 2 3\n")
    (tmp_path / "poses.txt").write_text("".join(map(matrix_row, POSES)))
    sequence = open_stereo(tmp_path)
    shift = -np.linalg.solve([[20, 0, 11.5], [0, 21, 7.5], [0, 0, 1]], [1.2, 2.1, 0.3])
    assert sequence.baseline_m == pytest.approx(0.54)
    expected = SE3.transform(POSES, np.tile(shift, (3, 1)))
    np.testing.assert_allclose(sequence.truth.world_from_camera[:, 4:], expected, atol=1e-12)


def test_a_missing_image_is_a_lost_frame(tmp_path):
    (write_kitti(tmp_path) / "image_0" / "000001.png").unlink()
    assert levels(open_images(tmp_path)) == [10, None, 30]


def test_a_given_calibration(tmp_path):
    sequence = open_images(write_kitti(tmp_path / "00"), write_camera(tmp_path, fx=19.0))
    assert sequence.camera.fx == 19.0
    assert open_stereo(tmp_path / "00", write_camera(tmp_path)).baseline_m == pytest.approx(0.54)


@pytest.mark.parametrize(
    ("calib", "message"),
    [
        (P1, "calib.txt: expected a line `P0:` and 12 numbers, found none"),
        (P0, "calib.txt: expected a line `P1:` and 12 numbers, found none"),
        ("P0: 1 2 3\n", "calib.txt, line 1: expected P0: and 12 numbers, found 3"),
        (
            P0 + P1.replace("-10.8", "left"),
            "calib.txt, line 2: expected P1 to be a finite number, found 'left'",
        ),
        (P0 + P1.replace("-10.8", "10.8"), "calib.txt, line 2: expected P1 to be P0 shifted to the right"),
        (P0 + P1.replace("11.5", "11.6"), "calib.txt, line 2: expected P1 to be P0 shifted to the right"),
        (P0.replace("20 0", "20 1"), "calib.txt, line 1: expected P0 to be fx 0 cx"),
        (P0.replace("20 0", "-20 0"), "calib.txt, line 1: expected P0 to be fx 0 cx"),
        (P0.replace("11.5", "600") + P1, r"calib.txt: the centre of projection \(600, 7.5\) px lies outside"),
    ],
)
def test_a_calibration_that_does_not_fit(tmp_path, calib, message):
    with pytest.raises(InputError, match=message):
        open_stereo(write_kitti(tmp_path, calib=calib))


def test_a_given_calibration_of_another_size(tmp_path):
    with pytest.raises(InputError, match=r"width and height are 48x16, the images of .* have 24x16 px"):
        open_images(write_kitti(tmp_path / "00"), write_camera(tmp_path, width=48))


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("times.txt", "0\n0.1\n", "image_0: found image 2 but 2 times in times.txt"),
        ("times.txt", "0\n0.2\n0.1\n", "times.txt, line 3: time runs backwards from 0.2 to 0.1"),
        (
            "poses.txt",
            matrix_row(POSES[0]),
            "poses.txt: expected 3 poses, one per time in times.txt, found 1",
        ),
        ("poses.txt", "1 2 3\n", "poses.txt, line 1: expected 12 columns"),
        (
            "poses.txt",
            matrix_row(POSES[0]) + 2 * "1 2 3 4 5 6 7 8 9 10 11 12\n",
            "poses.txt, line 2: expected a rotat",
        ),
    ],
)
def test_a_malformed_file(tmp_path, name, text, message):
    (write_kitti(tmp_path) / name).write_text(text)
    with pytest.raises(InputError, match=message):
        open_images(tmp_path)


@pytest.mark.parametrize("name", ["calib.txt", "times.txt"])
def test_a_missing_file(tmp_path, name):
    (write_kitti(tmp_path) / name).unlink()
    with pytest.raises(InputError, match=f"{name}: no such file; expected a KITTI odometry sequence"):
        open_images(tmp_path)


def test_files_that_are_no_numbered_image_are_passed_over(tmp_path):
    write_images(write_kitti(tmp_path) / "image_0", ["preview.png"])
    assert len(open_images(tmp_path)) == 3
