"""Cameras, pairs and truth of ROS bags."""

import logging

import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.sensors.readers import Topics, open_images, open_stereo
from tests.readers.images.bags import KINDS, SIZE, STAMPS_NS, K, recorded, write_bag, write_pair
from tests.readers.images.folders import grey, levels, write_camera

POSES = (
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
    "nav_msgs/msg/Odometry",
)
TRUTH = Topics(truth="/truth")

# The camera.

CAMERAS = {
    "four": ({"d": (0.1, 0.2, 0.3, 0.4)}, (0.1, 0.2, 0.3, 0.4, 0.0)),
    "none": ({"d": (), "model": ""}, (0.0,) * 5),
    "zero": ({"d": (0.0,) * 8, "model": "rational_polynomial"}, (0.0,) * 5),
    "rational": (
        {"d": (0.1, 0.2, 0.3, 0.4, 0.5, 0.0, 0.0, 0.0), "model": "rational_polynomial"},
        (0.1, 0.2, 0.3, 0.4, 0.5),
    ),
}


@pytest.mark.parametrize("name", CAMERAS)
def test_lenses(tmp_path, name):
    changes, distortion = CAMERAS[name]
    assert open_images(write_bag(tmp_path / "walk.bag", **changes)).camera.distortion == distortion


@pytest.mark.parametrize("model", ["equidistant", "fisheye"])
def test_a_fisheye_lens(tmp_path, model):
    camera = open_images(write_bag(tmp_path / "walk.bag", model=model, d=(0.1, 0.2, 0.0, 0.0))).camera
    assert (camera.distortion_model, camera.distortion) == ("equidistant", (0.1, 0.2, 0.0, 0.0))


WRONG = {
    "fisheye": ({"model": "equidistant", "d": (0.1,) * 5}, "the lens is 'equidistant' with 5 coefficients, expected"),
    "rational": ({"model": "rational_polynomial", "d": (0.1,) * 8}, "the lens is 'rational_polynomial'"),
    "another": ({"model": "fov", "d": (0.9,)}, "the lens is 'fov' with 1 coefficients"),
    "nameless": ({"model": "", "d": (0.1,) * 4}, "the lens is '' with 4 coefficients"),
    "uncalibrated": ({"k": (0.0,) * 9}, "the camera is not calibrated"),
    "nan": ({"k": (np.nan, *K[1:])}, "the camera is not calibrated"),
    "binned": ({"binning": 2}, "the images are binned"),
    "size": ({"size": (48, 64)}, "width and height are 64x48, the images of .*image_raw have 24x16 px"),
    "no size": ({"size": (0, 0)}, "/cam0/camera_info: .*width"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
@pytest.mark.parametrize("kind", KINDS[:2])
def test_cameras_that_are_refused(tmp_path, kind, name):
    changes, problem = WRONG[name]
    with pytest.raises(InputError, match=problem):
        open_images(write_bag(tmp_path / kind, **changes))


def test_a_rectified_image_has_the_camera_of_the_projection(tmp_path):
    with recorded(tmp_path / "walk.bag") as bag:
        bag.info("/cam/camera_info", p=(30.0, 0, 12.0, 0, 0, 31.0, 8.0, 0, 0, 0, 1, 0))
        bag.image("/cam/image_rect_color", 1, grey(10, SIZE))
    assert open_images(tmp_path / "walk.bag").camera.params.tolist() == [30, 31, 12, 8, 0, 0, 0, 0, 0, 0]


def test_without_a_camera_one_has_to_be_given(tmp_path):
    with recorded(tmp_path / "walk.bag") as bag:
        bag.image("/cam/image_raw", 1, grey(10, SIZE))
    with pytest.raises(
        InputError, match="expected the camera of /cam/image_raw in /cam/camera_info, found no"
    ):
        open_images(tmp_path / "walk.bag")
    camera = write_camera(tmp_path, fx=22.0)
    assert open_images(tmp_path / "walk.bag", camera).camera.fx == 22.0


# Two cameras.


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("names", [("/left", "/right"), ("/cam0", "/cam1")])
def test_a_rectified_pair_of_which_all_right_images_come_last(tmp_path, kind, names):
    sequence = open_stereo(write_pair(tmp_path / kind, names))
    assert (sequence.rig.baseline_m, sequence.notes) == (pytest.approx(0.12), ())
    assert sequence.rig.camera.params.tolist() == [20.0, 21.0, 11.5, 7.5, 0, 0, 0, 0, 0, 0]
    assert sequence.stamps_ns.tolist() == list(STAMPS_NS)
    assert [int(frame.right[0, 0]) for frame in sequence.frames(1)] == [120, 130]
    assert levels(sequence) == [10, 20, 30]


def test_images_without_a_partner_are_left_out(tmp_path):
    sequence = open_stereo(write_pair(tmp_path / "walk.bag", skipped=(1,)))
    assert "1 of 3 left images have no partner" in sequence.notes[0]
    assert [(int(f.image[0, 0]), int(f.right[0, 0])) for f in sequence.frames()] == [(10, 110), (30, 130)]


def test_a_pair_that_has_to_be_rectified_is_where_its_cameras_say(tmp_path):
    """The right camera turned by 0.05 rad about its own axis y, as R says; the truth turns with the left one."""
    turn = SE3.exp(np.array([0.0, 0.05, 0.0, 0.0, 0.0, 0.0]))
    with recorded(tmp_path / "walk.bag") as bag:
        for side, name in enumerate(("/left", "/right")):
            shift = -0.12 * K[0] * side
            p, r = (*K[:3], shift, *K[3:6], 0.0, *K[6:], 0.0), SE3.rotation(turn)
            bag.info(f"{name}/camera_info", p=p, d=(0.0,) * 5, r=(r if side else np.eye(3)).reshape(-1))
            bag.image(f"{name}/image_raw", 1, grey(10, SIZE))
        bag.pose("/truth", 1, SE3.identity())
    sequence = open_stereo(tmp_path / "walk.bag", topics=TRUTH)
    assert sequence.rig.baseline_m == pytest.approx(0.12)
    assert "are not rectified; their images are, by the two CameraInfo" in sequence.notes[0]
    # The baseline lies along the left camera's rows: only the right one is turned.
    left = sequence.truth.world_from_camera[0]
    np.testing.assert_allclose(SE3.log(left)[:3], 0.0, atol=1e-6)


def test_an_ideal_pair_needs_no_rectification(tmp_path):
    with recorded(tmp_path / "walk.bag") as bag:
        for side, name in enumerate(("/left", "/right")):
            p = (*K[:3], -0.12 * K[0] * side, *K[3:6], 0.0, *K[6:], 0.0)
            bag.info(f"{name}/camera_info", p=p, d=(0.0,) * 5)
            bag.image(f"{name}/image_raw", 1, grey(10, SIZE))
    sequence = open_stereo(tmp_path / "walk.bag")
    assert sequence.notes == () and sequence.rig.baseline_m == pytest.approx(0.12)


@pytest.mark.parametrize(
    ("bag", "topics", "problem"),
    [
        ({"baseline": 0.0}, Topics(), "P puts the right camera 0 m to the right of the left one"),
        ({}, Topics(("/right/image_rect", "/left/image_rect")), "P puts the right camera -0.12 m .*exchange"),
        ({}, Topics(("/left/image_rect",)), "name two of them with --image-topic LEFT,RIGHT"),
        ({}, Topics(("/left/image_rect", "/up")), "/up is no topic of images"),
        ({"image": "image_raw", "r": np.ones(9)}, Topics(), "R is no rotation"),
        ({"size": (8, 8)}, Topics(), "width and height are 8x8"),
    ],
)  # fmt: skip
def test_pairs_that_are_refused(tmp_path, bag, topics, problem):
    with pytest.raises(InputError, match=problem):
        open_stereo(write_pair(tmp_path / "walk.bag", **bag), topics=topics)


def test_a_rectified_and_a_raw_topic_are_no_pair(tmp_path):
    with recorded(tmp_path / "walk.bag") as bag:
        for name, image in (("/left", "image_rect"), ("/right", "image_raw")):
            bag.info(f"{name}/camera_info")
            bag.image(f"{name}/{image}", 1, grey(10, SIZE))
    with pytest.raises(InputError, match="one is rectified and the other is not"):
        open_stereo(tmp_path / "walk.bag")


def test_a_folder_may_be_called_like_a_file_of_ros_1(tmp_path):
    folder = write_bag(tmp_path / "walk_db3").rename(tmp_path / "walk.bag")
    assert [int(frame.image[0, 0]) for frame in open_images(folder).frames()] == [10, 20, 30]


def test_one_topic_is_no_pair(tmp_path):
    with pytest.raises(InputError, match="the bag's image topics are /cam0/image_raw; name two"):
        open_stereo(write_bag(tmp_path / "walk.bag"))


def test_a_camera_file_needs_the_baseline(tmp_path):
    path = write_pair(tmp_path / "walk.bag", baseline=0.0)
    with pytest.raises(InputError, match=r"camera.yaml: expected baseline_m"):
        open_stereo(path, write_camera(tmp_path))
    assert open_stereo(path, write_camera(tmp_path, baseline_m=0.2)).rig.baseline_m == 0.2


# The truth.


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("message", POSES)
def test_truth_from_every_message_that_holds_a_pose(tmp_path, kind, message):
    poses = SE3.exp(np.linspace(0.0, 1.0, 18).reshape(3, 6))
    path = tmp_path / kind
    with recorded(path) as bag:
        bag.info("/camera_info")
        for stamp, pose in zip(STAMPS_NS, poses, strict=True):
            bag.image("/image_raw", stamp, grey(10, SIZE))
            bag.pose("/truth", stamp, pose, message)
    truth = open_images(path, topics=TRUTH).truth
    assert truth.stamps_ns.tolist() == list(STAMPS_NS)
    np.testing.assert_allclose(
        SE3.between(truth.world_from_camera, poses), np.tile(SE3.identity(), (3, 1)), atol=1e-12
    )


def test_poses_of_another_frame_are_said(tmp_path, caplog):
    with recorded(tmp_path / "walk.bag") as bag:
        bag.info("/camera_info")
        bag.image("/image_raw", 1, grey(10, SIZE))
        bag.pose("/truth", 1, SE3.identity(), "nav_msgs/msg/Odometry", child="base_link")
    with caplog.at_level(logging.WARNING):
        open_images(tmp_path / "walk.bag", topics=TRUTH)
    assert (
        "the poses of /truth are those of base_link and are taken as those of the camera cam" in caplog.text
    )


@pytest.mark.parametrize(
    ("stamps", "pose", "problem"),
    [
        ((1, 2, 0), (0, 0, 0, 1, 0, 0, 0), "the stamp of pose 2 is before the one it follows"),
        ((1,), (0, 0, 0, 2, 0, 0, 0), "pose 0 has a quaternion of length 2, expected 1"),
        ((1,), (0, 0, 0, np.nan, 0, 0, 0), "pose 0 has a quaternion of length nan"),
        ((10**12,), (0, 0, 0, 1, 0, 0, 0), "which is another clock"),
    ],
)
def test_truths_that_are_refused(tmp_path, stamps, pose, problem):
    with recorded(tmp_path / "walk_db3") as bag:
        bag.info("/camera_info")
        bag.image("/image_raw", 1, grey(10, SIZE))
        for i, stamp in enumerate(stamps):
            bag.add_raw("/truth", i, POSES[0], posed(bag, stamp, pose))
    with pytest.raises(InputError, match=problem):
        open_images(tmp_path / "walk_db3", topics=TRUTH)


def posed(bag, stamp, pose):
    """Bytes of a PoseStamped."""
    written = []
    bag.add_raw, kept = (lambda *message: written.append(message[-1])), bag.add_raw
    bag.pose("/truth", stamp, pose)
    bag.add_raw = kept
    return written[0]
