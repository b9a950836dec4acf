"""Converts ROS 2 messages to the systems' frames, and their results to messages, without ROS itself.

A tracker has one callback per topic, which takes a message and returns messages to publish, as (topic, message).
Messages are read only by their fields and created by `make(kind, **fields)`: with `rclpy` in node.py, with the types
of `rosbags` in the tests.
"""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from rbpf import SE2, SE3, MonoConfig, MonoSlam, RectifiedStereo, StereoConfig, StereoSlam, System, Tracked
from rbpf.runs.trajectory import in_space
from rbpf.sensors.laser import Scanner
from rbpf.sensors.readers.images.bag import CameraInfo, image_of, numbers_of
from rbpf.systems.laser.config import LaserConfig
from rbpf.systems.laser.slam import LaserSlam

Make = Callable[..., Any]  #: Takes a message's type, such as "nav_msgs/msg/Odometry", and its fields by name.
Published = list[tuple[str, Any]]
MAP_EVERY = 20  #: Frames between published maps and paths.


def stamp_of(message: Any) -> int:
    """The stamp of a message's header [ns]."""
    return int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec)


class Messages:
    """A system's results as messages in the frame `world`."""

    def __init__(self, make: Make, world: str = "map") -> None:
        self.make, self.world = make, world
        self.poses: list[Any] = []

    def header(self, stamp_ns: int, frame: str) -> Any:
        seconds, nanoseconds = divmod(stamp_ns, 10**9)
        stamp = self.make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame)

    def vector(self, values: Any, kind: str = "Vector3") -> Any:
        x, y, z = (float(value) for value in values)
        return self.make(f"geometry_msgs/msg/{kind}", x=x, y=y, z=z)

    def rotation(self, pose: np.ndarray) -> Any:
        x, y, z, w = (float(value) for value in pose[:4])
        return self.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def pose(self, pose: np.ndarray) -> Any:
        """The message of a pose (7,)."""
        position, orientation = self.vector(pose[4:], "Point"), self.rotation(pose)
        return self.make("geometry_msgs/msg/Pose", position=position, orientation=orientation)

    def stamped(self, stamp_ns: int, pose: np.ndarray) -> Any:
        header = self.header(stamp_ns, self.world)
        return self.make("geometry_msgs/msg/PoseStamped", header=header, pose=self.pose(pose))

    def odometry(self, stamp_ns: int, pose: np.ndarray, cov: np.ndarray, body: str) -> Any:
        """The pose (7,) of a body with its covariance (d, d), which in ROS is along the world's axes, position first."""
        told = self.make("geometry_msgs/msg/PoseWithCovariance", pose=self.pose(pose), covariance=in_world(pose, cov))
        still = self.vector((0.0, 0.0, 0.0))
        twist = self.make("geometry_msgs/msg/Twist", linear=still, angular=still)
        unknown = self.make(
            "geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.diag([-1.0] * 6).ravel()
        )
        header = self.header(stamp_ns, self.world)
        return self.make("nav_msgs/msg/Odometry", header=header, child_frame_id=body, pose=told, twist=unknown)

    def transform(self, stamp_ns: int, world_from_child: np.ndarray, child: str) -> Any:
        moved = self.make(
            "geometry_msgs/msg/Transform",
            translation=self.vector(world_from_child[4:]),
            rotation=self.rotation(world_from_child),
        )
        header = self.header(stamp_ns, self.world)
        one = self.make("geometry_msgs/msg/TransformStamped", header=header, child_frame_id=child, transform=moved)
        return self.make("tf2_msgs/msg/TFMessage", transforms=[one])

    def path(self, stamp_ns: int) -> Any:
        return self.make("nav_msgs/msg/Path", header=self.header(stamp_ns, self.world), poses=list(self.poses))

    def cloud(self, stamp_ns: int, points: np.ndarray) -> Any:
        """The message of points (M, 3)."""
        fields = [
            self.make("sensor_msgs/msg/PointField", name=name, offset=4 * k, datatype=7, count=1)
            for k, name in enumerate("xyz")
        ]
        data = np.frombuffer(points.astype("<f4").tobytes(), dtype=np.uint8)
        return self.make(
            "sensor_msgs/msg/PointCloud2", header=self.header(stamp_ns, self.world), height=1, width=len(points),
            fields=fields, is_bigendian=False, point_step=12, row_step=12 * len(points), data=data, is_dense=True,
        )  # fmt: skip

    def grid(self, stamp_ns: int, log_odds: np.ndarray, cell_m: float, corner: np.ndarray) -> Any:
        """The message of a grid: occupancy from 0 to 100 per cent, -1 for cells without any beam."""
        percent = np.where(log_odds == 0.0, -1, np.round(100.0 / (1.0 + np.exp(-log_odds)))).astype(np.int8)
        corner_pose = np.array([0.0, 0.0, 0.0, 1.0, *corner, 0.0])
        header, (rows, columns) = self.header(stamp_ns, self.world), log_odds.shape
        info = self.make(
            "nav_msgs/msg/MapMetaData", map_load_time=header.stamp, resolution=float(cell_m), width=columns, height=rows,
            origin=self.pose(corner_pose),
        )  # fmt: skip
        return self.make("nav_msgs/msg/OccupancyGrid", header=header, info=info, data=percent.ravel())


def in_world(pose: np.ndarray, cov: np.ndarray) -> np.ndarray:
    """Converts a covariance in the right chart, [ω, v], to (36,) of PoseWithCovariance; in the plane the rest is 0."""
    whole = np.zeros((6, 6))
    rows = np.arange(6) if len(cov) == 6 else np.array([2, 3, 4])
    whole[np.ix_(rows, rows)] = cov
    turn, order = SE3.rotation(pose), [3, 4, 5, 0, 1, 2]
    turned = np.kron(np.eye(2), turn) @ whole @ np.kron(np.eye(2), turn).T
    return np.ascontiguousarray(turned[np.ix_(order, order)]).ravel()


class Tracker:
    """Common to all trackers: conversion of a tracked frame to messages."""

    def __init__(self, make: Make, body: str) -> None:
        self.messages, self.body = Messages(make), body
        self.system: System | None = None
        self.frames = 0

    def said(self, tracked: Tracked) -> Published:
        """Pose and transform of every frame; path and map of every `MAP_EVERY`-th."""
        stamp_ns, told = tracked.stamp_ns, self.messages
        pose = in_space(np.array([stamp_ns]), tracked.pose[None]).world_from_body[0]
        told.poses.append(told.stamped(stamp_ns, pose))
        if (revision := tracked.revision) is not None:  # earlier poses have been revised
            poses = in_space(revision.stamps_ns, revision.poses).world_from_body
            told.poses[-len(poses) :] = map(told.stamped, revision.stamps_ns.tolist(), poses)
        out = [
            ("rbpf/odometry", told.odometry(stamp_ns, pose, tracked.cov, self.body)),
            ("/tf", self.transform(stamp_ns, pose)),
        ]
        self.frames += 1
        if self.frames % MAP_EVERY == 1:
            out += [("rbpf/path", told.path(stamp_ns)), self.map(stamp_ns)]
        return out

    def transform(self, stamp_ns: int, pose: np.ndarray) -> Any:
        return self.messages.transform(stamp_ns, pose, self.body)

    def map(self, stamp_ns: int) -> tuple[str, Any]:
        assert self.system is not None
        return "rbpf/map", self.messages.cloud(stamp_ns, self.system.map().points().in_space()[0])


class MonoTracker(Tracker):
    """Topics `image` and `camera_info`; the first camera is the world, whose scale is arbitrary."""

    def __init__(
        self, make: Make, body: str = "camera", config: MonoConfig | None = None, rectified: bool = False
    ) -> None:
        super().__init__(make, body)
        self.config, self.rectified = config, rectified
        self.callbacks: Mapping[str, Callable[[Any], Published]] = {
            "camera_info": self.camera_info,
            "image": self.image,
        }

    def camera_info(self, message: Any) -> Published:
        if self.system is None:
            camera = CameraInfo.of(message, "camera_info", self.rectified).calibration.camera
            self.system = MonoSlam(camera, self.config)
        return []

    def image(self, message: Any) -> Published:
        if not isinstance(self.system, MonoSlam):
            return []  # no camera_info yet
        camera = self.system.camera
        image = image_of(message, "image", (camera.height, camera.width))
        return self.said(self.system.track(image, stamp_of(message)))


class StereoTracker(Tracker):
    """Rectified pairs: topics `left/image`, `left/camera_info`, and `right`; images with equal stamps are a pair."""

    def __init__(self, make: Make, body: str = "camera", config: StereoConfig | None = None) -> None:
        super().__init__(make, body)
        self.config = config
        self.infos: dict[str, CameraInfo] = {}
        self.waiting: dict[str, dict[int, np.ndarray]] = {"left": {}, "right": {}}
        self.callbacks: Mapping[str, Callable[[Any], Published]] = {
            f"{side}/{name}": (lambda message, side=side, take=take: take(side, message))
            for side in self.waiting
            for name, take in (("image", self.image), ("camera_info", self.camera_info))
        }

    def camera_info(self, side: str, message: Any) -> Published:
        self.infos.setdefault(side, CameraInfo.of(message, f"{side}/camera_info", True))
        if self.system is None and len(self.infos) == 2:
            left, right = self.infos["left"], self.infos["right"]
            rig = RectifiedStereo(left.calibration.camera, right.shift_m - left.shift_m)
            self.system = StereoSlam(rig, self.config)
        return []

    def image(self, side: str, message: Any) -> Published:
        stamp_ns, both = stamp_of(message), self.waiting
        both[side][stamp_ns] = image_of(message, f"{side}/image")
        if not isinstance(self.system, StereoSlam) or not all(stamp_ns in images for images in both.values()):
            return []
        left, right = both["left"].pop(stamp_ns), both["right"].pop(stamp_ns)
        for images in both.values():  # older images have lost their partner
            for old in [old for old in images if old < stamp_ns]:
                del images[old]
        return self.said(self.system.track(left, right, stamp_ns))


class LaserTracker(Tracker):
    """Topics `scan` and `odom`; a scan waits for later odometry. The transform is from the map to `odom`."""

    def __init__(
        self, make: Make, body: str = "base_link", config: LaserConfig | None = None, mount: np.ndarray | None = None
    ) -> None:
        super().__init__(make, body)
        self.config, self.mount = config, SE2.identity() if mount is None else mount  #: robot_from_sensor (3,).
        self.scans: list[Any] = []
        self.odometry: list[tuple[int, np.ndarray]] = []
        self.callbacks: Mapping[str, Callable[[Any], Published]] = {"scan": self.scan, "odom": self.odom}

    def scan(self, message: Any) -> Published:
        self.scans.append(message)
        return self.take()

    def odom(self, message: Any) -> Published:
        pose = SE3.normalise(numbers_of(message.pose.pose))
        yaw, _, _ = SE3.ypr(pose)
        self.odometry.append((stamp_of(message), np.array([float(yaw), *SE3.translation(pose)[:2]])))
        return self.take()

    def take(self) -> Published:
        """Tracks the scans that precede the latest odometry."""
        out: Published = []
        while self.scans and self.odometry and stamp_of(self.scans[0]) <= self.odometry[-1][0]:
            message = self.scans.pop(0)
            stamp_ns = stamp_of(message)
            while len(self.odometry) > 2 and self.odometry[1][0] < stamp_ns:
                self.odometry.pop(0)
            (before_ns, before), (after_ns, after) = self.odometry[0], self.odometry[min(1, len(self.odometry) - 1)]
            if before_ns <= stamp_ns:
                fraction = (stamp_ns - before_ns) / max(after_ns - before_ns, 1)
                self.at = SE2.normalise(SE2.interpolate(before, after, np.array(fraction)))
                out += self.said(self.slam(message).track(self.ranges(message), self.at, stamp_ns))
        return out

    def slam(self, message: Any) -> LaserSlam:
        if self.system is None:
            angles = float(message.angle_min) + float(message.angle_increment) * np.arange(len(message.ranges))
            self.turned = angles[0] > angles[-1]
            reach = max(float(message.range_min), 0.0), float(message.range_max)
            scanner = Scanner(angles[::-1].copy() if self.turned else angles, *reach, self.mount)
            self.system = LaserSlam(scanner, self.config)
        assert isinstance(self.system, LaserSlam)
        return self.system

    def ranges(self, message: Any) -> np.ndarray:
        """Ranges (B,): infinite without a return, NaN for invalid readings."""
        ranges = np.asarray(message.ranges, dtype=float)
        valid = (ranges > 0.0) & (ranges >= message.range_min)
        ranges = np.where(valid, np.where(ranges >= message.range_max, np.inf, ranges), np.nan)
        return ranges[::-1].copy() if self.turned else ranges

    def transform(self, stamp_ns: int, pose: np.ndarray) -> Any:
        odom_from_body = in_space(np.array([stamp_ns]), self.at[None]).world_from_body[0]
        return self.messages.transform(stamp_ns, SE3.compose(pose, SE3.inverse(odom_from_body)), "odom")

    def map(self, stamp_ns: int) -> tuple[str, Any]:
        assert isinstance(self.system, LaserSlam)
        picture = self.system.picture()
        return "rbpf/map", self.messages.grid(stamp_ns, picture.log_odds, picture.cell_m, picture.corner)


TRACKERS: Mapping[str, type[Any]] = {"mono": MonoTracker, "stereo": StereoTracker, "laser": LaserTracker}
KINDS = {
    "image": "sensor_msgs/msg/Image", "camera_info": "sensor_msgs/msg/CameraInfo", "scan": "sensor_msgs/msg/LaserScan",
    "odom": "nav_msgs/msg/Odometry", "rbpf/odometry": "nav_msgs/msg/Odometry", "rbpf/path": "nav_msgs/msg/Path",
    "/tf": "tf2_msgs/msg/TFMessage",
}  # fmt: skip
"""Message type of each topic, by its last part; a map is a PointCloud2, or an OccupancyGrid for a laser scanner."""
