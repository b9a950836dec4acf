"""ROS bags."""

import numpy as np
import pytest
from rosbags.rosbag1 import Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.sensors.readers import Topics, open_images, open_stereo
from rbpf.sensors.readers.images import bag as bag_reader
from tests.readers.images.bags import KINDS, SIZE, STAMPS_NS, K, recorded, write_bag, write_pair
from tests.readers.images.folders import grey, levels, write_camera, write_plain


def packed(writer, ros1=Writer.CompressionFormat.LZ4):
    if isinstance(writer, Writer):
        writer.set_compression(ros1)
    else:
        writer.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
    return writer


def tightly(writer):
    """Each image in a packed chunk of its own."""
    writer.chunk_threshold = 300
    return packed(writer, Writer.CompressionFormat.BZ2)


@pytest.mark.parametrize("kind", KINDS)
def test_a_small_bag(tmp_path, kind):
    """As it is and packed."""
    for folder, prepare in (("plain", lambda writer: writer), ("packed", packed)):
        (tmp_path / folder).mkdir()
        sequence = open_images(write_bag(tmp_path / folder / kind, prepare=prepare))
        assert sequence.name == kind.removesuffix(".bag")
        assert sequence.stamps_ns.tolist() == list(STAMPS_NS)
        assert sequence.camera.params.tolist() == [20.0, 21.0, 11.5, 7.5, 0.1, 0.01, 0.001, 0.002, 0.0, 0.0]
        assert (sequence.camera.height, sequence.camera.width) == SIZE
        assert sequence.truth is None and sequence.baseline_m is None
        assert levels(sequence) == [10, 20, 30] and levels(sequence, 2) == [30]


@pytest.mark.parametrize("name", ["walk_db3/walk_db3.db3", "walk_mcap/walk_mcap.mcap"])
def test_a_single_file_of_ros_2_needs_no_folder(tmp_path, name):
    write_bag(tmp_path / name.split("/")[0])
    assert levels(open_images(tmp_path / name)) == [10, 20, 30]
    folder = (tmp_path / name).parent.rename(tmp_path / "walk.bag")  # called like a file of ROS 1
    assert levels(open_images(folder)) == [10, 20, 30]


def test_a_folder_of_images_with_a_description_is_no_bag_and_has_no_topics(tmp_path):
    write_plain(tmp_path)
    (tmp_path / "metadata.yaml").write_text("camera: mine\n")
    assert levels(open_images(tmp_path)) == [10, 20, 30]
    with pytest.raises(InputError, match="image topic /cam is given, but only ROS bags have topics"):
        open_images(tmp_path, topics=Topics(("/cam",)))


def test_a_chunk_that_unpacks_to_more_than_there_can_be_is_refused(tmp_path, monkeypatch):
    path = tmp_path / "walk.bag"
    with recorded(path, tightly) as bag:
        bag.info("/camera_info")
        bag.image("/image_raw", 1, np.zeros((400, 600), np.uint8))
    monkeypatch.setattr(bag_reader, "MOST_BYTES", 2 * path.stat().st_size)
    with pytest.raises(InputError, match="a chunk is cut off, or larger than"):
        open_images(path)


def test_the_same_grey_values_from_every_encoding(tmp_path):
    """A grey picture in all the ways in which a message may hold it; a Bayer pattern of one level is that level."""
    level = np.full(SIZE, 77, np.uint8)
    deep, colour = level.astype(np.uint16) * 257, np.repeat(level[..., None], 3, axis=2)
    bayer = [f"bayer_{pattern}8" for pattern in ("rggb", "bggr", "gbrg", "grbg")]
    pictures = {"mono8": level, "mono16": deep, "bgr8": colour, "rgb8": colour} | dict.fromkeys(bayer, level)
    pictures |= dict.fromkeys(("bgra8", "rgba8"), np.repeat(level[..., None], 4, axis=2))
    for name, picture in pictures.items():
        with recorded(tmp_path / f"{name}.bag") as bag:
            bag.info("/camera_info")
            bag.image("/image_raw", STAMPS_NS[0], picture, name, padding=6)
        (frame,) = open_images(tmp_path / f"{name}.bag").frames()
        np.testing.assert_array_equal(frame.image, level, name)


def test_compressed_pictures_are_those_of_the_same_files(tmp_path):
    folder = write_plain(tmp_path / "images")
    with recorded(tmp_path / "walk.bag") as bag:
        bag.info("/cam/camera_info", d=(0.0,) * 5)
        for i, file in enumerate(sorted(folder.glob("*.png"))):
            bag.compressed("/cam/image_raw/compressed", STAMPS_NS[i], file.read_bytes())
    both = zip(open_images(folder).frames(), open_images(tmp_path / "walk.bag").frames(), strict=True)
    for plain, packed in both:
        np.testing.assert_array_equal(plain.image, packed.image)


SPOILT = {
    "encoding": ({"encoding": "32FC1"}, "the encoding '32FC1' is none of mono8"),
    "rows": ({"height": 15}, "expected 15 rows of 24 bytes, found 384 bytes"),
    "step": ({"step": 12}, "24x16 px in rows of 12 bytes"),
    "size": ({"height": 8, "width": 48, "step": 48}, "expected 24x16 px"),
    "huge": ({"height": 2**31, "width": 2**31, "step": 2**31}, "found 384 bytes"),
}


@pytest.mark.parametrize("name", SPOILT)
def test_one_bad_picture_is_a_frame_that_says_so(tmp_path, name):
    changes, problem = SPOILT[name]
    with recorded(tmp_path / "walk.bag") as bag:
        bag.info("/camera_info")
        for i, stamp in enumerate(STAMPS_NS):
            bag.image("/image_raw", stamp, grey(10 * i, SIZE), **(changes if i == 1 else {}))
    frames = list(open_images(tmp_path / "walk.bag").frames())
    assert [frame.image is None for frame in frames] == [False, True, False]
    assert frames[1].stamp_ns == STAMPS_NS[1]
    assert problem in frames[1].problem and "/image_raw, image 1" in frames[1].problem


def test_messages_that_are_cut_off(tmp_path):
    """One of which only the header is whole is a lost frame; one that is too short for a header is none."""
    stamped = bytes([0, 1, 0, 0]) + (0).to_bytes(4, "little") + (3).to_bytes(4, "little")
    with recorded(tmp_path / "walk_db3") as bag:
        bag.info("/camera_info")
        bag.image("/image_raw", 1, grey(10, SIZE))
        bag.add_raw("/image_raw", 3, "sensor_msgs/msg/Image", stamped + b"\xff" * 40)
        bag.add_raw("/image_raw", 4, "sensor_msgs/msg/Image", stamped[:6])
    whole, cut = open_images(tmp_path / "walk_db3").frames()
    assert whole.problem is None and cut.stamp_ns == 3 and "a message is damaged" in cut.problem


def test_a_bag_that_is_damaged_further_on_is_read_until_there(tmp_path, caplog):
    """The last chunk is spoilt."""
    path = tmp_path / "walk.bag"
    with recorded(path, tightly) as bag:
        bag.info("/camera_info")
        for i, stamp in enumerate(STAMPS_NS):
            bag.image("/image_raw", stamp, grey(10 + 10 * i, SIZE))
    whole = path.read_bytes()
    place = whole.rindex(b"BZh9") + 20
    path.write_bytes(whole[:place] + bytes(20) + whole[place + 20 :])
    assert levels(open_images(path)) == [10, 20]
    assert "The 2 images before it are kept" in caplog.text


def test_times_that_run_backwards(tmp_path):
    """The headers' times; the bag's own are in order."""
    with recorded(tmp_path / "walk_mcap") as bag:
        bag.info("/camera_info")
        for received, stamp in enumerate((5, 7, 6)):
            fields = {"height": 1, "width": 1, "encoding": "mono8", "is_bigendian": 0, "step": 1}
            bag.add("/image_raw", stamp, "sensor_msgs/msg/Image", received, data=np.zeros(1, np.uint8), **fields)
    with pytest.raises(InputError, match="/image_raw: the stamp of image 2 is before the one it follows"):
        open_images(tmp_path / "walk_mcap", write_camera(tmp_path))


def test_several_topics_of_images_have_to_be_named(tmp_path):
    path = write_pair(tmp_path / "walk.bag")
    with pytest.raises(
        InputError, match=r"image topics are /left/image_rect, /right/image_rect; name one of them with --image-topic"
    ):
        open_images(path)
    assert levels(open_images(path, topics=Topics(("/right/image_rect",)))) == [110, 120, 130]


def test_a_bag_without_images(tmp_path):
    with recorded(tmp_path / "walk.bag") as bag:
        bag.info("/camera_info")
    with pytest.raises(InputError, match="the bag has no topic of images"):
        open_images(tmp_path / "walk.bag")


def test_names_of_topics_are_what_config_yaml_says():
    with pytest.raises(InputError, match="expected an image topic, or two as LEFT,RIGHT"):
        Topics.parse("/a,")
    assert (
        Topics.parse("/a, /b", "/t")
        == Topics(("/a", "/b"), "/t")
        == Topics.parse(*Topics.parse("/a,/b", "/t").entries().values())
    )
    assert Topics.parse() == Topics() and Topics().entries() == {}


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
    "fish": ({"d": (0.1, 0.2, 0.0, 0.0), "model": "equidistant"}, (0.1, 0.2, 0.0, 0.0)),
    "fish of another name": ({"d": (0.1, 0.2, 0.0, 0.0), "model": "fisheye"}, (0.1, 0.2, 0.0, 0.0)),
}


@pytest.mark.parametrize("name", CAMERAS)
def test_lenses(tmp_path, name):
    changes, distortion = CAMERAS[name]
    camera = open_images(write_bag(tmp_path / "walk.bag", **changes)).camera
    assert camera.distortion == distortion
    assert (camera.distortion_model == "equidistant") == ("fish" in name)


WRONG = {
    "fisheye": ({"model": "equidistant", "d": (0.1,) * 5}, "the lens is 'equidistant' with 5 coefficients, expected"),
    "rational": ({"model": "rational_polynomial", "d": (0.1,) * 8}, "the lens is 'rational_polynomial'"),
    "uncalibrated": ({"k": (0.0,) * 9}, "the camera is not calibrated"),
    "nan": ({"k": (np.nan, *K[1:])}, "the camera is not calibrated"),
    "binned": ({"binning": 2}, "the images are binned"),
    "size": ({"size": (48, 64)}, "width and height are 64x48, the images of .*image_raw have 24x16 px"),
    "no size": ({"size": (0, 0)}, "/cam0/camera_info: .*width"),
    "times never set": ({"stamps": (0, 0, 0)}, "all 3 images have the time 0, their headers have not been set"),
    "topic": (Topics(("/nothing",)), "/nothing is no topic of images; the bag's image topics are /cam0/image_raw"),
    "poses for images": (Topics(("/truth",)), "/truth is no topic of images"),
    "truth": (Topics(truth="/nothing"), "expected poses in the topic /nothing, found /truth with poses"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_cameras_times_and_topics_that_are_refused(tmp_path, name):
    wrong, problem = WRONG[name]
    changes, topics = ({}, wrong) if isinstance(wrong, Topics) else (wrong, Topics())
    with pytest.raises(InputError, match=problem):
        open_images(write_bag(tmp_path / "walk.bag", **changes), topics=topics)


def test_a_rectified_image_has_the_camera_of_the_projection(tmp_path):
    with recorded(tmp_path / "walk.bag") as bag:
        bag.info("/cam/camera_info", p=(30.0, 0, 12.0, 0, 0, 31.0, 8.0, 0, 0, 0, 1, 0))
        bag.image("/cam/image_rect_color", 1, grey(10, SIZE))
    assert open_images(tmp_path / "walk.bag").camera.params.tolist() == [30, 31, 12, 8, 0, 0, 0, 0, 0, 0]


def test_without_a_camera_one_has_to_be_given(tmp_path):
    with recorded(tmp_path / "walk.bag") as bag:
        bag.image("/cam/image_raw", 1, grey(10, SIZE))
    with pytest.raises(InputError, match="expected the camera of /cam/image_raw in /cam/camera_info, found no"):
        open_images(tmp_path / "walk.bag")
    assert open_images(tmp_path / "walk.bag", write_camera(tmp_path, fx=22.0)).camera.fx == 22.0


@pytest.mark.parametrize(
    ("kind", "names"), list(zip(KINDS, [("/left", "/right"), ("/cam0", "/cam1")] * 2, strict=False))
)
def test_a_rectified_pair_of_which_all_right_images_come_last(tmp_path, kind, names):
    sequence = open_stereo(write_pair(tmp_path / kind, names))
    assert (sequence.rig.baseline_m, sequence.notes) == (pytest.approx(0.12), ())
    assert sequence.rig.camera.params.tolist() == [20.0, 21.0, 11.5, 7.5, 0, 0, 0, 0, 0, 0]
    assert sequence.stamps_ns.tolist() == list(STAMPS_NS)
    assert [int(frame.right[0, 0]) for frame in sequence.frames(1)] == [120, 130]
    assert levels(sequence) == [10, 20, 30]


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
    np.testing.assert_allclose(SE3.log(sequence.truth.poses[0])[:3], 0.0, atol=1e-6)


@pytest.mark.parametrize(
    ("bag", "topics", "problem"),
    [
        ({"baseline": 0.0}, Topics(), "P puts the right camera 0 m to the right of the left one"),
        ({}, Topics(("/right/image_rect", "/left/image_rect")), "P puts the right camera -0.12 m .*exchange"),
        ({}, Topics(("/left/image_rect",)), "name two of them with --image-topic LEFT,RIGHT"),
        ({}, Topics(("/left/image_rect", "/up")), "/up is no topic of images"),
        ({"image": "image_raw", "r": np.ones(9)}, Topics(), "R is no rotation"),
        ({"image": ("image_rect", "image_raw")}, Topics(), "one is rectified and the other is not"),
        ({"size": (8, 8)}, Topics(), "width and height are 8x8"),
    ],
)  # fmt: skip
def test_pairs_that_are_refused(tmp_path, bag, topics, problem):
    with pytest.raises(InputError, match=problem):
        open_stereo(write_pair(tmp_path / "walk.bag", **bag), topics=topics)


def test_a_camera_file_needs_the_baseline(tmp_path):
    path = write_pair(tmp_path / "walk.bag", baseline=0.0)
    with pytest.raises(InputError, match=r"camera.yaml: expected baseline_m"):
        open_stereo(path, write_camera(tmp_path))
    assert open_stereo(path, write_camera(tmp_path, baseline_m=0.2)).rig.baseline_m == 0.2


@pytest.mark.parametrize(("kind", "message"), list(zip([*KINDS, KINDS[0]], POSES, strict=True)))
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
    np.testing.assert_allclose(SE3.between(truth.poses, poses), np.tile(SE3.identity(), (3, 1)), atol=1e-12)


@pytest.mark.parametrize(
    ("stamps", "pose", "problem"),
    [
        ((1, 2, 0), (0, 0, 0, 1, 0, 0, 0), "the stamp of pose 2 is before the one it follows"),
        ((1,), (0, 0, 0, 2, 0, 0, 0), "pose 0: expected a quaternion of length 1, found one of length 2"),
        ((1,), (0, 0, 0, np.nan, 0, 0, 0), "pose 0: expected a quaternion of length 1, found one of length nan"),
        ((10**12,), (0, 0, 0, 1, 0, 0, 0), "which is another clock"),
    ],
)
def test_truths_that_are_refused(tmp_path, stamps, pose, problem):
    with recorded(tmp_path / "walk_db3") as bag:
        bag.info("/camera_info")
        bag.image("/image_raw", 1, grey(10, SIZE))
        for i, stamp in enumerate(stamps):
            bag.pose("/truth", stamp, pose, received=i)
    with pytest.raises(InputError, match=problem):
        open_images(tmp_path / "walk_db3", topics=TRUTH)
