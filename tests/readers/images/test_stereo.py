"""Recordings of two cameras."""

import logging

import cv2
import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.readers import open_images, open_stereo
from rbpf.sensors.readers.images.rectification import OUTSIDE, rectification
from tests.readers.images import folders


def levels(sequence):
    return [
        tuple(None if image is None else int(image[0, 0]) for image in (frame.image, frame.right))
        for frame in sequence.frames()
    ]


def test_a_euroc_pair(tmp_path):
    poses = SE3.from_ypr(np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 1]]), [0, 0.1, 0.2], 0.0, 0.0)
    folders.write_rectified(tmp_path)
    folders.write_asl_truth(tmp_path / "mav0" / "state_groundtruth_estimate0", poses, folders.EUROC_NS)
    sequence = open_stereo(tmp_path)
    assert len(sequence) == 3 and sequence.notes == () and sequence.name == tmp_path.name
    assert sequence.rig.baseline_m == pytest.approx(0.11) and sequence.rig.camera.fx == 20.0
    assert sequence.stamps_ns.tolist() == list(folders.EUROC_NS)
    assert levels(sequence) == [(10, 100), (20, 110), (30, 120)]
    assert all(frame.problem is None for frame in sequence.frames())
    expected = SE3.compose(poses, folders.CAM0)
    np.testing.assert_allclose(SE3.local(sequence.truth.poses, expected), 0.0, atol=1e-9)
    assert [frame.stamp_ns for frame in sequence.frames(1)] == list(folders.EUROC_NS[1:])


def test_images_without_a_partner_are_left_out_and_named(tmp_path, caplog):
    late = (folders.EUROC_NS[0] + 3_000_000, folders.EUROC_NS[2] - 1_000_000, folders.EUROC_NS[2] + 40_000_000)
    folders.write_rectified(tmp_path, right=late)
    with caplog.at_level(logging.WARNING):
        sequence = open_stereo(tmp_path)
    assert sequence.stamps_ns.tolist() == [folders.EUROC_NS[0], folders.EUROC_NS[2]]
    assert levels(sequence) == [(10, 100), (30, 110)]
    assert "1 of 3 left images have no partner" in sequence.notes[0] and "1 of 3 right" in sequence.notes[1]
    assert "1 of 3 left images have no partner within 0.005 s and are left out" in caplog.text
    assert len(open_stereo(tmp_path, tolerance_s=0.002)) == 1


def test_two_clocks_are_refused(tmp_path):
    folders.write_rectified(tmp_path, right=tuple(stamp + 10_000_000 for stamp in folders.EUROC_NS))
    with pytest.raises(InputError, match=r"within 0.005 s, the nearest two are 0.010000 s apart"):
        open_stereo(tmp_path)
    assert len(open_stereo(tmp_path, tolerance_s=0.011)) == 3


@pytest.mark.parametrize(("camera", "damage"), [("cam0", "missing"), ("cam1", "empty"), ("cam1", "size")])
def test_a_pair_of_which_one_image_cannot_be_read_is_survived(tmp_path, camera, damage):
    folders.write_rectified(tmp_path)
    file = tmp_path / "mav0" / camera / "data" / f"{folders.EUROC_NS[1]}.png"
    if damage == "missing":
        file.unlink()
    elif damage == "empty":
        file.write_bytes(b"")
    else:
        folders.write_image(file, np.zeros((16, 30), np.uint8))
    frames = list(open_stereo(tmp_path).frames())
    assert len(frames) == 3 and frames[0].problem is None and frames[2].problem is None
    assert camera in frames[1].problem
    assert (frames[1].image is None) == (camera == "cam0")
    assert (frames[1].right is None) == (camera == "cam1")


def test_a_kitti_pair_whose_folders_may_be_of_different_length(tmp_path):
    sequence = open_stereo(folders.write_kitti(tmp_path))
    assert sequence.notes == () and sequence.rig.baseline_m == pytest.approx(0.54)
    (tmp_path / "image_1" / "000002.png").unlink()
    sequence = open_stereo(tmp_path)
    assert levels(sequence) == [(10, 100), (20, 110), (30, None)]
    assert len(sequence.notes) == 1 and "image_1: 2 images for 3 times" in sequence.notes[0]


def widened(folder, images):
    """The right images wider than the left ones."""
    folders.write_images(folder / images, [path.name for path in sorted((folder / images).iterdir())], 100, (16, 30))
    return folder


def without(folder, file):
    (folder / "mav0" / file).unlink()
    return folder


def kitti_shifted(tx):
    return lambda folder: folders.write_kitti(folder, calib=folders.P0 + f"P1: 20 0 11.5 {tx} 0 21 7.5 0 0 0 1 0\n")


@pytest.mark.parametrize(
    ("make", "words"),
    [
        *(
            (lambda folder, file=file: without(folders.write_rectified(folder), file), file)
            for file in ("cam0/sensor.yaml", "cam1/sensor.yaml", "cam1/data.csv")
        ),
        (
            lambda folder: widened(folders.write_kitti(folder), "image_1"),
            "left and right images have 24x16 and 30x16 px",
        ),
        (lambda folder: folders.write_kitti(folder, right=False, calib=folders.P0), "image_1: no such folder"),
        (kitti_shifted(0.0), "calib.txt.*2.*a baseline of zero"),
        (kitti_shifted(10.8), "calib.txt.*2.*shifted to the right"),
        (lambda folder: folders.write_rectified(folder, baseline=0.0), "puts cam1 where cam0 is, a baseline of zero"),
        (lambda folder: folders.write_rectified(folder, baseline=-0.11), r"is at \(-0.11, .* expected it to the right"),
        (lambda folder: folders.write_rectified(folder, resolution=[26, 16]), "cam0 has 24x16 and cam1 26x16 px"),
        (lambda folder: widened(folders.write_rectified(folder), "mav0/cam1/data"), "cam1 have 30x16 px"),
        (folders.write_plain, r"expected a ROS bag.*; or an EuRoC sequence .* cam0 and cam1.*; or a KITTI"),
        (lambda folder: folder / "none", "no such file or folder; expected a stereo sequence"),
    ],
)
def test_what_is_no_pair_is_refused(tmp_path, make, words):
    with pytest.raises(InputError, match=words):
        open_stereo(make(tmp_path))


def test_a_given_calibration(tmp_path):
    folders.write_rectified(tmp_path / "a")
    sequence = open_stereo(tmp_path / "a", folders.write_camera(tmp_path, fx=22.0))
    assert sequence.rig.camera.fx == 22.0 and sequence.rig.baseline_m == pytest.approx(0.11)
    assert open_stereo(tmp_path / "a", folders.write_camera(tmp_path, fx=22.0, baseline_m=0.2)).rig.baseline_m == 0.2
    folders.write_kitti(tmp_path / "b")
    assert open_stereo(tmp_path / "b", folders.write_camera(tmp_path, baseline_m=0.2)).rig.baseline_m == 0.2
    bent = folders.write_camera(tmp_path, distortion=[0.1, 0, 0, 0])
    with pytest.raises(InputError, match="rectify the images"):
        open_stereo(tmp_path / "a", bent)
    with pytest.raises(InputError, match=r"has equidistant distortion \(0.0, 0.0, 0.0, 0.0\): rectify the images"):
        open_stereo(tmp_path / "a", folders.write_camera(tmp_path, model="fisheye"))


def test_a_pair_that_is_not_rectified_is_rectified(tmp_path):
    straight = {"distortion_coefficients": [0.1, 0.0, 0.0, 0.0]}
    folders.write_asl_camera(tmp_path / "mav0" / "cam0", folders.CAM0, **straight)
    mount = SE3.compose(folders.CAM0, SE3.from_ypr(np.array([0.11, 0.002, 0.0]), 0.0, 0.02, 0.0))
    folders.write_asl_camera(tmp_path / "mav0" / "cam1", mount, folders.EUROC_NS, 100, **straight)
    poses = SE3.from_ypr(np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 1]]), [0, 0.1, 0.2], 0.0, 0.0)
    folders.write_asl_truth(tmp_path / "mav0" / "state_groundtruth_estimate0", poses, folders.EUROC_NS)
    assert open_images(tmp_path).baseline_m is None
    sequence = open_stereo(tmp_path)
    assert "not rectified; their images are" in sequence.notes[0]
    assert sequence.rig.baseline_m == pytest.approx(np.hypot(0.11, 0.002))
    assert not any(sequence.rig.camera.distortion)
    assert sequence.camera == sequence.rig.camera
    frame = next(sequence.frames())
    assert frame.image.shape == frame.right.shape == (16, 24)
    # A rectified camera keeps its place and turns towards the baseline.
    turned = SE3.between(SE3.compose(poses, folders.CAM0), sequence.truth.poses)
    np.testing.assert_allclose(SE3.translation(turned), 0.0, atol=1e-9)
    direction = SE3.rotation(turned[0])[:, 0]
    np.testing.assert_allclose(direction, np.array([0.11, 0.002, 0.0]) / np.hypot(0.11, 0.002), atol=1e-6)


LEFT = Pinhole(160, 120, 110.0, 112.0, 80.0, 58.0, (-0.2, 0.05, 1e-3, -5e-4, 0.0))
RIGHT = Pinhole(160, 120, 108.0, 111.0, 78.0, 61.0, (-0.18, 0.04, 0.0, 1e-3, 0.0))
APART = SE3.from_ypr(np.array([0.12, 0.005, -0.004]), 0.02, -0.03, 0.015)


WIDE_LEFT = Pinhole(160, 120, 66.0, 67.0, 80.0, 58.0, (-0.03, 0.02, -0.012, 0.002), "equidistant")
WIDE_RIGHT = Pinhole(160, 120, 65.0, 65.5, 78.0, 61.0, (0.0, 0.0, 0.0, 0.0), "equidistant")


@pytest.mark.parametrize(
    ("left", "right"), [(LEFT, RIGHT), (WIDE_LEFT, WIDE_RIGHT), (LEFT, WIDE_RIGHT)], ids=["narrow", "wide", "mixed"]
)
def test_rectified_cameras_see_a_point_on_one_row(left, right):
    rig, left_from_rectified, both = rectification(left, right, APART, "here")
    assert rig.baseline_m == pytest.approx(np.linalg.norm(SE3.translation(APART)), rel=1e-9)
    points = np.random.default_rng(0).uniform([-0.4, -0.3, 1.5], [0.4, 0.3, 4.0], (200, 3))
    rectified = rig.project(SE3.inverse_transform(left_from_rectified, points))
    inside = rig.inside(rectified, 2.0)
    inside &= left.visible(points) & right.visible(SE3.inverse_transform(APART, points))
    assert inside.sum() > 100
    for camera, maps, where, column in (
        (left, both[0], points, 0),
        (right, both[1], SE3.inverse_transform(APART, points), 2),
    ):
        # The map at the rectified place names the place in the image as it was taken.
        place = rectified[inside][:, [column, 1]].astype(np.float32)
        given = np.column_stack([cv2.remap(part, place[:, :1], place[:, 1:], cv2.INTER_LINEAR)[:, 0] for part in maps])
        np.testing.assert_allclose(given, camera.project(where[inside]), atol=0.1)


def test_what_a_wide_pair_does_not_see_is_black():
    turned = SE3.from_ypr(SE3.translation(APART), 0.0, 0.8, 0.0)
    columns, rows = rectification(WIDE_LEFT, WIDE_RIGHT, turned, "here")[2][1]
    np.testing.assert_array_equal(columns == OUTSIDE, rows == OUTSIDE)
    assert 0.02 < (columns == OUTSIDE).mean() < 0.5
    image = cv2.remap(np.full((120, 160), 255, np.uint8), columns, rows, cv2.INTER_LINEAR)
    assert (image[columns == OUTSIDE] == 0).all() and image[60, 80] == 255
