"""Images of one camera: what each format means, and what all of them refuse."""

import logging
import re
import subprocess
from dataclasses import replace

import cv2
import imageio_ffmpeg
import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.sensors.readers import ImageSequence, Part, open_images, open_stereo
from rbpf.sensors.readers.images.calibration import read_calibration
from tests.readers.images.folders import (
    CAM0,
    CAMERA,
    EUROC_NS,
    P0,
    P1,
    SIZE,
    levels,
    matrix_row,
    sensor_yaml,
    write_asl_truth,
    write_camera,
    write_euroc,
    write_images,
    write_kitti,
    write_plain,
    write_seven_scenes,
    write_tum,
    write_video,
)
from tests.readers.small import write

PATH = SE3.from_ypr(np.array([[1.0, 2, 3], [2, 2, 3], [3, 3, 3]]), [0.1, 0.2, 0.3], 0.4, [1, -1, 2])
ROAD = SE3.from_ypr(np.array([[0.0, 0, 0], [0, 0, 1], [0.1, 0, 2]]), [0.0, 0.1, 0.2], 0.0, 0.0)
PHOTOS = "# K fx fy cx cy width height\nK 20 21 11.5 7.5 24 16\nb.jpg 1 2 3 0 0 0 1\na.jpg 4 5 6 0 0 1 0\n"


def write_photos(folder):
    write_images(folder / "images", ["a.jpg", "b.jpg"])
    return write(folder, {"cameras.txt": PHOTOS})


def write_small_scenes(folder):
    write_camera(write_seven_scenes(folder, size=SIZE))
    return folder


def write_clip(folder):
    folder.mkdir(parents=True, exist_ok=True)
    return write_video(folder / "walk.avi", size=SIZE)


FORMATS = {
    "plain": (write_plain, [0, 33_333_333, 66_666_667]),
    "TUM": (write_tum, [1_500_000_000, 1_600_000_000, 1_700_000_000]),
    "EuRoC": (write_euroc, list(EUROC_NS)),
    "KITTI": (write_kitti, [0, 100_000_000, 200_000_000]),
    "7-Scenes": (write_small_scenes, [0, 33_333_333, 133_333_333]),
    "photos": (write_photos, [0, 1_000_000_000]),
    "video": (write_clip, [0, 40_000_000, 80_000_000]),
}
every_format = pytest.mark.parametrize("name", FORMATS)


@every_format
def test_a_small_sequence(tmp_path, name):
    make, stamps = FORMATS[name]
    sequence = open_images(make(tmp_path / "desk"))
    assert sequence.name == ("walk" if name == "video" else "desk")
    assert sequence.stamps_ns.dtype == np.int64 and sequence.stamps_ns[:3].tolist() == stamps
    camera = sequence.camera
    assert (camera.width, camera.height, camera.cx, camera.cy) == (24, 16, 11.5, 7.5)
    assert (camera.fx, camera.fy) == (20.0, 21.0) and sequence.baseline_m is None
    expected = [20, 10] if name == "photos" else np.arange(5, 125, 10) if name == "video" else [10, 20, 30]
    np.testing.assert_allclose(levels(sequence), expected, atol=3 if name == "video" else 0)
    assert all(frame.right is None and frame.problem is None for frame in sequence.frames())


@every_format
def test_a_given_calibration_replaces_the_sequences_own_and_must_fit(tmp_path, name):
    path = FORMATS[name][0](tmp_path / "desk")
    given = open_images(path, write_camera(tmp_path, fx=33.0)).camera
    assert given.fx == 33.0 and given.distortion == (0.0,) * 5
    with pytest.raises(InputError, match=r"width and height are 48x16, the images of .* have 24x16 px"):
        open_images(path, write_camera(tmp_path, width=48))


S = "mav0/cam0/"
DATA = S + "data.csv"
TRUTH = "mav0/state_groundtruth_estimate0/data.csv"
POSE = "frame-000001.pose.txt"


def camera_yaml(**changes):
    entries = {**CAMERA, **changes}
    return "".join(f"{key}: {value}\n" for key, value in entries.items() if value is not None)


def mounted(matrix):
    """The description of EuRoC's camera with another mount."""
    return re.sub(r"data: .*", f"data: {np.asarray(matrix).ravel().tolist()}", sensor_yaml(CAM0))


REFUSED = [
    *((name, "camera.yaml", None, "no such file; expected a camera.yaml with") for name in ("TUM", "plain", "video")),
    ("EuRoC", S + "sensor.yaml", None, "sensor.yaml: no such file; expected an EuRoC sequence"),
    ("KITTI", "calib.txt", None, "calib.txt: no such file; expected a KITTI odometry sequence"),
    ("KITTI", "times.txt", None, "times.txt: no such file; expected a KITTI odometry sequence"),
    ("plain", "camera.yaml", camera_yaml(fx=None), "line 1: expected the keys fx, fy, cx, cy, width, height, found no fx"),
    ("plain", "camera.yaml", camera_yaml(fx=-1), "line 1: expected fx to be positive, found -1"),
    ("plain", "camera.yaml", camera_yaml(width=24.5), "line 5: expected width to be a whole number, found 24.5"),
    ("plain", "camera.yaml", camera_yaml(distorsion=[0]), "line 7: expected the keys fx, .*; also known: .*; found .dis"),
    ("plain", "camera.yaml", camera_yaml(distortion=[0, 0]), "line 7: expected distortion to be a list of 4 or 5, found 2"),
    ("plain", "camera.yaml", camera_yaml(model="omni"), "line 7: expected model to be pinhole or fisheye, found 'omni'"),
    ("plain", "camera.yaml", camera_yaml(model="fisheye", distortion=[0] * 5), "line 8: .* to be a list of 4, found 5"),
    ("plain", "camera.yaml", camera_yaml(baseline_m=-1), "line 7: expected baseline_m to be positive, found -1"),
    ("plain", "times.txt", "0.5\n1\n", "times.txt: expected 3 times, one per image, found 2"),
    ("plain", "camera.yaml", "fx: 1\nfx: 2\n", "line 2: fx occurs twice"),
    ("plain", "camera.yaml", "- 1\n", "line 1: expected the keys fx, .*, found no mapping"),
    ("plain", "camera.yaml", "[" * 1500, "more than 20 nested"),
    ("TUM", "rgb.txt", "# nothing\n", "rgb.txt: expected lines that begin with a time, found none"),
    ("TUM", "rgb.txt", "1305031102175304123 a.png\n", "rgb.txt, line 1: expected the time in seconds, within 4e.09"),
    ("TUM", "rgb.txt", "0 a.png\n33 b.png\n", "rgb.txt: the images are 33 s apart: write times in seconds; if they"),
    ("TUM", "rgb.txt", "1.5 a.png\n1.6 b.", "rgb.txt, line 2: the file ends inside this line"),
    ("TUM", "rgb.txt", "#\n1.5 a\n1.7 b\n1.6 c\n", "rgb.txt, line 4: time runs backwards from 1.7 to 1.6"),
    ("TUM", "groundtruth.txt", "1.5 1 2 3 0 0 1\n", "groundtruth.txt, line 1: expected 7 columns .* found 6"),
    ("TUM", "groundtruth.txt", "#\n1.5 1 2 3 0 0 1 1\n", "line 2: expected a quaternion of length 1"),
    ("TUM", "groundtruth.txt", "99 1 2 3 0 0 0 1\n", "groundtruth.txt: the poses are at 99.000 .* which is another clock"),
    ("EuRoC", DATA, "12,12.png\n13,13.png\n", "data.csv: times are 1 apart, too little: write"),
    ("EuRoC", DATA, "12,12.png\n", "data.csv: none of 1 images can be read; the first is .*12.png: no such file"),
    ("EuRoC", TRUTH, "0,1,2,3,1,0,0,0\n", "the poses are at 0.000 .* which is another clock"),
    ("EuRoC", "mav0/vicon0/data.csv", f"{EUROC_NS[0]},1,2,3,1,0,0,0\n", "vicon0/sensor.yaml: no such file; .* T_BS"),
    ("EuRoC", S + "sensor.yaml", sensor_yaml(CAM0).replace("T_BS", "T_SB"), "expected the keys T_BS, .*, found no T_BS"),
    ("EuRoC", S + "sensor.yaml", sensor_yaml(CAM0, camera_model="omni"), "expected camera_model to be pinhole, found 'o"),
    ("EuRoC", S + "sensor.yaml", sensor_yaml(CAM0, distortion_model="fov"), "radial-tangential or radtan or equidistant"),
    ("EuRoC", S + "sensor.yaml", mounted(np.diag([1, 1, -1, 1])), "expected a rotation"),
    ("EuRoC", S + "sensor.yaml", mounted(np.diag([1, 1, 1, 2])), "expected the last row of the matrix to be 0 0 0 1"),
    ("EuRoC", S + "sensor.yaml", mounted(np.eye(4)[:3]), "expected data to be a list of 16, found 12"),
    ("KITTI", "calib.txt", P1, "calib.txt: expected a line `P0:` and 12 numbers, found none"),
    ("KITTI", "calib.txt", P0.replace("20 0", "20 1"), "calib.txt, line 1: expected P0 to be fx 0 cx"),
    ("KITTI", "calib.txt", P0.replace("11.5", "600") + P1, r"the centre of projection \(600, 7.5\) px lies outside"),
    ("KITTI", "times.txt", "0\n0.1\n", "image_0: found image 2 but 2 times in times.txt"),
    ("KITTI", "poses.txt", matrix_row(ROAD[0]), "poses.txt: expected 3 poses, one per time in times.txt, found 1"),
    ("KITTI", "poses.txt", matrix_row(ROAD[0]) + 2 * f"{' 7' * 12}\n", "poses.txt, line 2: expected a rotation"),
    ("7-Scenes", POSE, "1 2 3\n", f"{POSE}: expected 16 numbers, found 3"),
    ("7-Scenes", POSE, "1 " * 16, f"{POSE}: expected a rotation"),
    ("7-Scenes", "frame-000001.color.jpg", "none", "found frame-000001.color.jpg and .*, expected one image of each"),
    ("photos", "cameras.txt", "a.jpg 4 5 6 0 0 1 0\n", "expected one line `K fx fy cx cy width height`, found 0"),
    ("photos", "cameras.txt", PHOTOS.replace("24 16", "48 32"), "line 2: width and height are 48x32, the images of"),
    ("photos", "cameras.txt", PHOTOS.replace("0 0 1 0", "0 0 2 0"), "line 4: expected a quaternion of length 1"),
    ("photos", "cameras.txt", "K 20 21 11.5 7.5 24 16\n", "cameras.txt: expected rows of tx, .* found none"),
    ("video", "walk.avi", "", "walk.avi: OpenCV cannot open the video"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "file", "content", "words"), REFUSED)
def test_a_bad_file_is_named(tmp_path, name, file, content, words):
    path = FORMATS[name][0](tmp_path / "desk")
    (tmp_path / "desk" / file).parent.mkdir(exist_ok=True)
    if content is None:
        (tmp_path / "desk" / file).unlink()
    else:
        write(tmp_path / "desk", {file: content})
    with pytest.raises(InputError, match=words):
        open_images(path)


def test_what_a_camera_file_may_say(tmp_path):
    write_plain(tmp_path, distortion=[0.1, -0.2, 0.001, 0.002], rate_hz=8)
    sequence = open_images(tmp_path)
    assert sequence.camera.distortion == (0.1, -0.2, 0.001, 0.002, 0.0)
    assert sequence.stamps_ns.tolist() == [0, 125_000_000, 250_000_000]
    write_camera(tmp_path, model="pinhole", distortion=[0.1, -0.2, 0.001, 0.002, 0.3])
    assert open_images(tmp_path).camera.distortion == (0.1, -0.2, 0.001, 0.002, 0.3)
    write_camera(tmp_path, model="fisheye", distortion=[0.1, -0.2, 0.001, 0.002])
    camera = open_images(tmp_path).camera
    assert (camera.distortion_model, camera.distortion) == ("equidistant", (0.1, -0.2, 0.001, 0.002))
    path = write_camera(tmp_path, model="fisheye")
    assert open_images(tmp_path).camera == replace(camera, distortion=(0.0,) * 4)
    # The first line as OpenCV writes it.
    path.write_text("%YAML:1.0\n---\n" + path.read_text())
    assert open_images(tmp_path).camera.fx == 20.0


def test_images_in_a_folder_are_ordered_by_the_numbers_in_their_names(tmp_path):
    assert levels(open_images(write_plain(tmp_path / "shelf", ["2.png", "10.png", "9.png"]))) == [10, 30, 20]
    write_images(tmp_path / "images", ["a.jpg", "b.png"])
    write(write_camera(tmp_path).parent, {"README.md": "about\n"})
    assert len(open_images(tmp_path)) == 2
    for image in (tmp_path / "images").iterdir():
        image.unlink()
    with pytest.raises(InputError, match="expected images in it or in its images/, found none"):
        open_images(tmp_path)


def test_stamps_and_truth_of_a_folder(tmp_path, caplog):
    with caplog.at_level(logging.INFO):
        assert open_images(write_plain(tmp_path)).truth is None
    assert "no times.txt and no rate_hz" in caplog.text
    write(tmp_path, {"camera.yaml": camera_yaml(rate_hz=1e-4)})
    assert open_images(tmp_path).stamps_ns[1] == 10**13
    write(tmp_path, {"times.txt": "# s\n0.5\n0.5\n1\n", "groundtruth.txt": "0.7 1 2 3 0 0 0 1\n"})
    sequence = open_images(tmp_path)
    assert sequence.stamps_ns.tolist() == [500_000_000, 500_000_000, 1_000_000_000]
    assert sequence.truth.stamps_ns.tolist() == [700_000_000]


def test_the_truth_of_tum_keeps_its_own_times_and_its_gaps(tmp_path):
    truth = open_images(write_tum(tmp_path)).truth
    assert truth.stamps_ns.tolist() == [1_500_000_000, 1_700_000_000] and truth.landmarks == {}
    np.testing.assert_array_equal(truth.poses, [[0, 0, 0, 1, 1, 2, 3], [0, 0, 1, 0, 1, 2, 4]])
    # A quaternion of few digits is scaled to length 1.
    truth = open_images(write_tum(tmp_path, truth=["1.5 1 2 3 0.4564 0.1000 0.3652 0.8049"])).truth
    assert np.linalg.norm(truth.poses[0, :4]) == pytest.approx(1.0, abs=1e-15)
    (tmp_path / "groundtruth.txt").unlink()
    assert open_images(tmp_path).truth is None


def test_lenses_and_folders_of_euroc(tmp_path):
    assert open_images(write_euroc(tmp_path)).camera.distortion == (-0.1, 0.01, 0.001, -0.002, 0.0)
    camera = open_images(write_euroc(tmp_path, distortion_model="equidistant")).camera
    assert (camera.distortion_model, camera.distortion) == ("equidistant", (-0.1, 0.01, 0.001, -0.002))
    assert open_images(tmp_path / "mav0").name == tmp_path.name
    (tmp_path / "mav0").rename(tmp_path / "flight")
    assert open_images(tmp_path / "flight").name == "flight"
    (tmp_path / "mav0").mkdir()
    with pytest.raises(InputError, match=r"cam0/sensor.yaml: no such file; expected an EuRoC sequence"):
        open_images(tmp_path)


@pytest.mark.parametrize("mounted", [None, SE3.identity()])
def test_the_estimated_state_of_euroc_becomes_the_pose_of_the_camera(tmp_path, mounted):
    mav = write_euroc(tmp_path / "a") / "mav0"
    write_asl_truth(mav / "vicon0", PATH[1:], EUROC_NS[1:], SE3.identity())
    write_asl_truth(mav / "state_groundtruth_estimate0", PATH, EUROC_NS, mounted, extra=",0.1,0.2,0,0,0,0")
    truth = open_images(tmp_path / "a").truth
    np.testing.assert_allclose(SE3.matrix(truth.poses), SE3.matrix(PATH) @ SE3.matrix(CAM0), atol=1e-12)
    assert truth.stamps_ns.tolist() == list(EUROC_NS)
    # A calibration that is given leaves the truth of the camera.
    given = open_images(tmp_path / "a", write_camera(tmp_path, fx=25.0)).truth
    np.testing.assert_array_equal(truth.poses, given.poses)


def test_a_marker_is_not_the_body(tmp_path):
    marker = SE3.from_ypr(np.array([0.07, -0.1, 0.2]), 1.0, 0.5, -2.0)
    world_from_marker = SE3.compose(PATH, marker)
    write_asl_truth(write_euroc(tmp_path) / "mav0" / "vicon0", world_from_marker, EUROC_NS, marker)
    found = SE3.matrix(open_images(tmp_path).truth.poses)
    np.testing.assert_allclose(found, SE3.matrix(PATH) @ SE3.matrix(CAM0), atol=1e-12)


@pytest.mark.parametrize("place", ["poses.txt", "../../poses/00.txt"])
def test_the_truth_of_kitti_beside_the_images_or_as_distributed(tmp_path, place):
    folder = write_kitti(tmp_path / "sequences" / "00", right=False, calib=P0)
    (tmp_path / "poses").mkdir()
    (folder / place).write_text("".join(map(matrix_row, ROAD)))
    sequence = open_images(folder)
    np.testing.assert_allclose(sequence.truth.poses, ROAD, atol=1e-12)
    np.testing.assert_array_equal(sequence.truth.stamps_ns, sequence.stamps_ns)


def test_the_colour_pair_has_its_own_place(tmp_path):
    write_kitti(tmp_path)
    for number in (0, 1):
        (tmp_path / f"image_{number}").rename(tmp_path / f"image_{number + 2}")
    p2, p3 = "P2: 20 0 11.5 1.2 0 21 7.5 2.1 0 0 1 0.3\n", "P3: 20 0 11.5 -9.6 0 21 7.5 2.1 0 0 1 0.3\n"
    (tmp_path / "calib.txt").write_text(P0 + P1 + "\n" + p2 + p3 + "Tr: 1 2 3\n")
    (tmp_path / "poses.txt").write_text("".join(map(matrix_row, ROAD)))
    sequence = open_stereo(tmp_path)
    shift = -np.linalg.solve([[20, 0, 11.5], [0, 21, 7.5], [0, 0, 1]], [1.2, 2.1, 0.3])
    assert sequence.baseline_m == pytest.approx(0.54)
    expected = SE3.transform(ROAD, np.tile(shift, (3, 1)))
    np.testing.assert_allclose(sequence.truth.poses[:, 4:], expected, atol=1e-12)


def test_a_missing_image_of_kitti_is_a_lost_frame(tmp_path):
    write_images(write_kitti(tmp_path) / "image_0", ["preview.png"])
    (tmp_path / "image_0" / "000001.png").unlink()
    assert levels(open_images(tmp_path)) == [10, None, 30]


@pytest.mark.parametrize("text", [None, "nan " * 16, "inf 0 0 0\n" * 4])
def test_where_tracking_was_lost_the_truth_of_scenes_has_a_gap(tmp_path, text):
    write_small_scenes(tmp_path)
    truth = open_images(tmp_path).truth
    expected = SE3.from_ypr(np.array([[0.0, 2, 3], [1, 2, 3], [4, 2, 3]]), [0.0, 0.1, 0.4], 0.2, 0.3)
    np.testing.assert_allclose(truth.poses, expected, atol=1e-12)
    (tmp_path / POSE).unlink() if text is None else (tmp_path / POSE).write_text(text)
    sequence = open_images(tmp_path)
    assert len(sequence) == 3 and sequence.truth.stamps_ns.tolist() == [0, 133_333_333]
    for pose in tmp_path.glob("*.pose.txt"):
        pose.unlink()
    assert open_images(tmp_path).truth is None


def test_scenes_without_a_calibration_have_the_nominal_camera(tmp_path):
    camera = open_images(write_seven_scenes(tmp_path / "seq-01")).camera
    assert (camera.width, camera.height, camera.fx, camera.fy) == (640, 480, 525, 525)
    (write_small_scenes(tmp_path) / "camera.yaml").unlink()
    with pytest.raises(InputError, match="the nominal camera of 7-Scenes: width and height are 640x480"):
        open_images(tmp_path)


def test_poses_of_photos_in_the_order_of_their_lines(tmp_path):
    truth = open_images(write_photos(tmp_path)).truth
    assert truth.stamps_ns.tolist() == [0, 1_000_000_000]
    assert truth.poses.tolist() == [[0, 0, 0, 1, 1, 2, 3], [0, 0, 1, 0, 4, 5, 6]]


@pytest.mark.parametrize(("name", "codec"), [("000001.mp4", "mp4v"), ("walk.mkv", "MJPG")])
def test_a_video_from_any_image_on(tmp_path, name, codec):
    sequence = open_images(write_video(tmp_path / name, codec=codec))
    assert sequence.name == name.split(".")[0] and len(sequence) == 12
    np.testing.assert_allclose(levels(sequence), np.arange(12) * 10 + 5, atol=3)
    np.testing.assert_allclose(levels(sequence, 7), np.arange(7, 12) * 10 + 5, atol=3)
    assert [frame.stamp_ns for frame in sequence.frames(10)] == [400_000_000, 440_000_000]
    camera = write_camera(tmp_path / "..", width=64, height=48, rate_hz=10)
    assert open_images(tmp_path / name, camera).stamps_ns[1] == 100_000_000


def test_a_video_that_ends_in_mid_frame_keeps_what_was_read_and_says_so(tmp_path):
    path = write_video(tmp_path / "walk.mkv", count=60, size=(240, 320))
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 6 // 10])
    *kept, last = open_images(path).frames()
    assert 25 <= len(kept) <= 40
    assert all(frame.image is not None and frame.problem is None for frame in kept)
    assert last.image is None
    assert last.problem == f"{path}: the video ends after {len(kept)} of 60 images; those are kept."


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    """Makes a video of 20 dark images, the first pixels of which are bright, by FFmpeg with these options."""
    folder = tmp_path_factory.mktemp("filmed")
    image = np.full((48, 64), 40, np.uint8)
    image[:4, :4] = 255
    for t in range(20):
        cv2.imwrite(str(folder / f"{t:02d}.png"), image)

    def make(source, name, *options):
        command = [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", *source.split(), *options, str(folder / name)]
        subprocess.run(command, check=True)
        return folder / name

    h264 = ["-c:v", "libx264", "-pix_fmt", "yuv420p"]
    return make, f"-framerate 10 -i {folder}/%02d.png", h264


@pytest.mark.parametrize("name", ["uneven.mp4", "uneven.mkv"])
def test_images_that_are_not_evenly_spread_have_the_times_that_the_video_says(filmed, name):
    make, images, h264 = filmed
    uneven = ["-vf", "setpts='(N+N*N/10)/10/TB'", "-fps_mode", "vfr", "-enc_time_base", "1:1000"]
    path = make(images, name, *uneven, *h264)
    write_camera(path.parent, width=64, height=48)
    sequence = open_images(path)
    n = np.arange(20)
    # FFmpeg puts them on the images' grid of 0.1 s.
    np.testing.assert_allclose(sequence.stamps_ns * 1e-9, np.floor(n + n * n / 10) / 10, atol=1e-3)
    frames = list(sequence.frames(5))
    assert [frame.stamp_ns for frame in frames] == sequence.stamps_ns[5:].tolist()
    assert all(frame.problem is None for frame in frames)
    (given := path.parent / f"given-{name}").mkdir()
    evenly = write_camera(given, width=64, height=48, rate_hz=10)
    assert np.unique(np.diff(open_images(path, evenly).stamps_ns)).tolist() == [100_000_000]


def test_a_video_that_announces_no_number_is_counted(filmed):
    make, images, h264 = filmed
    path = make(images, "live.mkv", *h264, "-live", "1")
    write_camera(path.parent, width=64, height=48)
    assert cv2.VideoCapture(str(path)).get(cv2.CAP_PROP_FRAME_COUNT) <= 0
    assert len(open_images(path)) == 20 == len(list(open_images(path).frames()))


@pytest.mark.parametrize(("degrees", "corner"), [("-90", "upper right"), ("180", "lower right"), ("90", "lower left")])
def test_a_turned_video_is_turned_and_a_calibration_of_what_is_stored_with_it(filmed, degrees, corner):
    make, images, h264 = filmed
    upright = make(images, f"upright{degrees}.mp4", *h264)
    path = make(f"-display_rotation {degrees} -i {upright}", f"turned{degrees}.mp4", "-c", "copy")
    for name in ("stored", "shown"):
        (path.parent / name).mkdir(exist_ok=True)
    stored = write_camera(path.parent / "stored", width=64, height=48)
    camera, (first, *_) = open_images(path, stored).camera, open_images(path, stored).frames()
    rows = slice(-2, None) if "lower" in corner else slice(2)
    columns = slice(-2, None) if "right" in corner else slice(2)
    assert first.image.shape == (camera.height, camera.width) and first.image[rows, columns].min() > 200
    if degrees == "180":  # nothing tells whether the calibration is of the images as they are shown
        assert camera == read_calibration(stored).camera
        return
    assert camera == read_calibration(stored).camera.turned(1 if degrees == "-90" else 3)
    shown = write_camera(path.parent / "shown", width=48, height=64)
    assert open_images(path, shown).camera == read_calibration(shown).camera


def test_part_of_a_recording(tmp_path):
    """Images of 10, 20, … grey levels at 0, 0.1, … s, of which every second from 0.15 to 0.65 s, half as large."""
    folder = write_plain(tmp_path, [f"{k}.png" for k in range(10)], rate_hz=10)
    whole, part = open_images(folder), Part(0.15, 0.65, 2, whole_width := SIZE[1] // 2)
    sequence = open_images(folder, part=part)
    assert sequence.stamps_ns.tolist() == [200_000_000, 400_000_000, 600_000_000]
    assert levels(sequence) == [levels(whole)[k] for k in (2, 4, 6)] and levels(sequence, 2) == [levels(whole)[6]]
    frames = list(sequence.frames())
    assert [frame.stamp_ns for frame in frames] == sequence.stamps_ns.tolist()
    assert frames[0].image.shape == (sequence.camera.height, sequence.camera.width) == (SIZE[0] // 2, whole_width)
    assert sequence.camera == whole.camera.resized(whole_width, SIZE[0] // 2)
    assert Part.of({"rbpf": "1", **part.entries()}) == part and Part().entries() == {}
    # A pair is of the same cameras, as far apart, and its parts are as old.
    pair = write_kitti(tmp_path / "pair")
    assert open_stereo(pair, part=Part(every=2)).baseline_m == open_stereo(pair).baseline_m
    assert len(open_stereo(pair, part=Part(every=2))) == (len(open_stereo(pair)) + 1) // 2


@pytest.mark.parametrize(
    ("numbers", "said"),
    [
        ({"start_s": -1.0}, "start_s must be at least 0"),
        ({"start_s": 2.0, "end_s": 2.0}, "end is 2 s: expected more than the start, 2 s"),
        ({"every": 0}, "every must be a whole number, at least 1"),
        ({"resize_px": 10_000}, "are not made larger"),
        ({"start_s": 60.0}, "no image is left from 60 s on: the recording is 0.067 s long"),
    ],
)
def test_a_part_that_there_is_not_is_refused(tmp_path, numbers, said):
    with pytest.raises(InputError, match=said):
        open_images(write_plain(tmp_path), part=Part(**numbers))


@pytest.mark.parametrize(
    ("stamps", "words"),
    [
        (np.array([0, 5, 4]), "numbers in order .sort .*, got 4 at 2"),
        (np.zeros((3, 1), dtype=np.int64), "whole numbers"),
    ],
)
def test_stamps_that_are_none_or_run_backwards(stamps, words):
    """A sequence may be made by hand."""
    with pytest.raises(InputError, match=words):
        ImageSequence("by hand", None, stamps, None, None, None)
