"""A bag that is replayed through the node's callbacks gives the poses of a run over the bag, in messages that ROS can send."""

import ast
from pathlib import Path

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from examples.ros2.adapter import LaserTracker, MonoTracker, StereoTracker, in_world, stamp_of
from rbpf import SE2, SE3, MonoConfig, StereoConfig
from rbpf.runs.recordings import LaserRecording, MonoRecording, StereoRecording, filter_recording
from rbpf.runs.trajectory import in_space
from rbpf.sensors.readers import open_images, open_stereo, read_laser_log
from rbpf.sensors.readers.images.bag import numbers_of, opened
from rbpf.systems.laser.config import LaserConfig
from rbpf.validation.simulation.laser import LaserWorld, simulate_laser
from tests.cli.sequences import render_desk, render_room
from tests.readers.images.bags import film_images, film_pairs, recorded

TYPES = get_typestore(Stores.LATEST)


def make(kind, **fields):
    return TYPES.types[kind](**fields)


def replayed(path, tracker, topics):
    """What is published as a bag is played; `topics` are the bag's for the tracker's."""
    said = []
    with opened(path) as bag:
        queue = [(raw.stamp_ns, k, raw, topic) for k, topic in enumerate(topics) for raw in bag.messages(topic)]
        for *_, raw, topic in sorted(queue, key=lambda item: item[:2]):
            said += tracker.callbacks[topics[topic]](bag.message(raw))
    for _, message in said:
        assert len(TYPES.serialize_cdr(message, message.__msgtype__)) > 20
    return said


def require_poses(said, recording, config):
    """The same as a run says, frame by frame; and its whole path, with what it revised later, in the end."""
    tracked = []
    run = filter_recording(recording, config, listeners=[lambda _, frame: tracked.append(frame)])
    told = [message for topic, message in said if topic == "rbpf/odometry"]
    assert [stamp_of(message) for message in told] == run.log.stamps_ns.tolist()
    poses = np.array([numbers_of(message.pose.pose) for message in told])
    expected = in_space(run.log.stamps_ns, np.array([frame.pose for frame in tracked])).world_from_body
    np.testing.assert_array_equal(poses, expected)
    covs = np.array([message.pose.covariance for message in told])
    np.testing.assert_array_equal(covs, [in_world(p, frame.cov) for p, frame in zip(poses, tracked, strict=True)])
    return poses, run


@pytest.mark.slow
def test_one_camera(tmp_path):
    desk, path = render_desk(tmp_path / "desk"), tmp_path / "drive_mcap"
    with recorded(path) as bag:
        film_images(bag, open_images(desk))
    config = MonoConfig(particles=20)
    topics = {"/cam0/camera_info": "camera_info", "/cam0/image_raw": "image"}
    tracker = MonoTracker(make, config=config)
    said = replayed(path, tracker, topics)
    _, run = require_poses(said, MonoRecording(path), config)
    path_told = [numbers_of(stamped.pose) for stamped in tracker.messages.poses]
    np.testing.assert_array_equal(path_told, run.log.poses)
    (cloud,) = [message for topic, message in said if topic == "rbpf/map"][-1:]
    assert cloud.point_step * cloud.width == len(cloud.data)
    moved = [message.transforms[0] for topic, message in said if topic == "/tf"]
    assert {(one.header.frame_id, one.child_frame_id) for one in moved} == {("map", "camera")}


@pytest.mark.slow
def test_two_cameras(tmp_path):
    room, path = render_room(tmp_path / "room"), tmp_path / "drive.bag"
    with recorded(path) as bag:
        film_pairs(bag, open_stereo(room), image="image_rect")
    config = StereoConfig(particles=20)
    sides = {side: f"/{side}" for side in ("left", "right")}
    topics = {f"{name}/camera_info": f"{side}/camera_info" for side, name in sides.items()}
    topics |= {f"{name}/image_rect": f"{side}/image" for side, name in sides.items()}
    said = replayed(path, StereoTracker(make, config=config), topics)
    require_poses(said, StereoRecording(path), config)


@pytest.mark.slow
def test_a_scanner(tmp_path):
    simulate_laser(LaserWorld(scans=20), tmp_path / "log", seed=0)
    log, path = read_laser_log(tmp_path / "log" / "robot.clf"), tmp_path / "drive_db3"
    step, reach = log.scanner.angles[1] - log.scanner.angles[0], (0.1, log.scanner.max_range_m)
    with recorded(path) as bag:
        for stamp, ranges, odometry in zip(log.stamps_ns.tolist(), log.ranges, log.odometry, strict=True):
            pose = in_space(np.zeros(1, np.int64), odometry[None]).world_from_body[0]
            bag.pose("/odom", stamp - 30_000_000, pose, "nav_msgs/msg/Odometry", child="base")
            bag.scan("/scan", stamp, ranges, start=log.scanner.angles[0], step=step, reach=reach)
    config = LaserConfig(particles=4)
    tracker = LaserTracker(make, config=config)
    said = replayed(path, tracker, {"/scan": "scan", "/odom": "odom"})
    poses, _ = require_poses(said, LaserRecording(path), config)
    # The transform leads from the map to odom, and by it and the odometry to the pose.
    (last,) = [message for topic, message in said if topic == "/tf"][-1:]
    odom_from_base = in_space(np.zeros(1, np.int64), tracker.at[None]).world_from_body[0]
    found = SE3.compose(numbers_of(last.transforms[0].transform), odom_from_base)
    np.testing.assert_allclose(SE3.log(SE3.between(found, poses[-1])), 0.0, atol=1e-9)
    (grid,) = [message for topic, message in said if topic == "rbpf/map"][-1:]
    assert grid.info.width * grid.info.height == len(grid.data) and {-1, 100} & set(grid.data.tolist())


@pytest.mark.parametrize("space", [SE2, SE3])
def test_a_covariance_is_told_along_the_axes_of_the_world(space):
    """Against the spread of perturbed poses; in the order of ROS the position comes first."""
    rng = np.random.default_rng(0)
    pose = space.exp(rng.normal(size=space.dim))
    root = 1e-4 * rng.normal(size=(space.dim, space.dim))
    drawn = space.retract(pose, rng.normal(size=(200_000, space.dim)) @ root.T)
    in_world_poses = in_space(np.zeros(len(drawn), np.int64), drawn).world_from_body
    centre = in_space(np.zeros(1, np.int64), pose[None]).world_from_body[0]
    turned = SE3.log(SE3.compose(in_world_poses, SE3.inverse(centre)))[:, :3]
    errors = np.column_stack([in_world_poses[:, 4:] - centre[4:], turned])
    told = in_world(centre, root @ root.T).reshape(6, 6)
    np.testing.assert_allclose(told, np.cov(errors.T), atol=0.03 * told.max())


def test_what_needs_ros_is_a_page_long():
    page = Path(__file__).resolve().parents[2] / "examples" / "ros2" / "node.py"
    text = page.read_text(encoding="utf-8")
    assert len(text.splitlines()) < 80 and ast.parse(text)
    others = (page.parent / "adapter.py").read_text(encoding="utf-8")
    assert "rclpy" in text and "import rclpy" not in others
