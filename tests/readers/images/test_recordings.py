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
    start = SE3.identity() if sequence.truth is None else sequence.truth.poses[0]
    px = sequence.camera.project(SE3.inverse_transform(np.tile(start, (8, 1)), points.positions))
    assert np.abs(px - points.px).max() < tolerance_px
