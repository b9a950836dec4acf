"""The image recordings: every one opens, and its numbers are those of its description."""

import numpy as np
import pytest

from rbpf.lie import SE3
from rbpf.sensors.readers import open_images, open_stereo, read_known_points

pytestmark = pytest.mark.real_data


@pytest.mark.parametrize(
    ("folder", "count", "size", "baseline_m", "poses"),
    [
        ("mono_redkitchen_a", 500, (640, 480), None, 500),
        ("mono_robot_lateral", 360, (320, 240), None, 0),
        ("stereo_zed_room1", 105, (672, 376), 0.120006, 105),
        ("stereo_kitti_seq1", 51, (1226, 370), 0.53715, 51),
        ("photos_fountain_p11", 11, (768, 512), None, 11),
    ],
)
def test_a_recording(data_dir, folder, count, size, baseline_m, poses):
    sequence = (open_images if baseline_m is None else open_stereo)(data_dir / folder)
    assert sequence.name == folder
    assert len(sequence) == count
    assert (sequence.camera.width, sequence.camera.height) == size
    assert sequence.baseline_m == (None if baseline_m is None else pytest.approx(baseline_m, abs=1e-5))
    assert (0 if sequence.truth is None else len(sequence.truth.stamps_ns)) == poses
    seen = 0
    for frame, stamp in zip(sequence.frames(), sequence.stamps_ns, strict=True):
        assert frame.problem is None and frame.stamp_ns == stamp
        for image in (frame.image,) if baseline_m is None else (frame.image, frame.right):
            assert image.shape == size[::-1] and image.dtype == np.uint8 and image.std() > 5.0
        seen += 1
    assert seen == count


@pytest.mark.parametrize(
    ("folder", "tolerance_px"), [("mono_redkitchen_a", 3.0), ("stereo_zed_room1", 3.0), ("mono_robot_lateral", 1.0)]
)
def test_known_points_are_seen_where_the_table_says(data_dir, folder, tolerance_px):
    sequence = open_images(data_dir / folder)
    points = read_known_points(data_dir / folder / "known_points.csv")
    assert points.names.tolist() == [1, 2, 3, 4, 5, 6, 7, 8]
    start = SE3.identity() if sequence.truth is None else sequence.truth.world_from_camera[0]
    px = sequence.camera.project(SE3.inverse_transform(np.tile(start, (8, 1)), points.positions))
    assert np.abs(px - points.px).max() < tolerance_px


def test_the_truth_of_the_road_runs_along_the_optical_axis(data_dir):
    truth = open_images(data_dir / "stereo_kitti_seq1").truth
    steps = np.linalg.norm(np.diff(truth.world_from_camera[:, 4:], axis=0), axis=1)
    assert steps.sum() == pytest.approx(59.860, abs=1e-3)
    ahead = SE3.translation(SE3.between(truth.world_from_camera[:-1], truth.world_from_camera[1:]))
    assert (ahead[:, 2] > 0.99 * steps).all()


@pytest.mark.parametrize("folder", ["stereo_kitti_seq1", "stereo_zed_room1"])
def test_a_point_of_the_left_image_is_to_the_left_in_the_right_one(data_dir, folder):
    import cv2

    sequence = open_stereo(data_dir / folder)
    rig = sequence.rig
    frame = next(sequence.frames())
    corners = cv2.goodFeaturesToTrack(frame.image, 150, 0.02, 15)
    found, status, _ = cv2.calcOpticalFlowPyrLK(frame.image, frame.right, corners, None, winSize=(15, 15))
    shift = (corners - found)[status.ravel() == 1].reshape(-1, 2)
    level = shift[np.abs(shift[:, 1]) < 1.0]
    assert len(level) > 0.5 * len(corners)
    assert np.mean(level[:, 0] > 0.0) > 0.9
    depth = rig.camera.fx * rig.baseline_m / np.median(level[:, 0])
    assert 0.5 < depth < 60.0
