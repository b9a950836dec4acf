"""Small ROS bags, written by the library's own writers."""

from contextlib import contextmanager

import numpy as np
from rosbags import rosbag1, rosbag2
from rosbags.rosbag2.enums import StoragePlugin
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from tests.readers.images.folders import grey

KINDS = ("walk.bag", "walk_db3", "walk_mcap")
"""A bag of ROS 1, and folders of ROS 2 with a database and with an MCAP file."""

STAMPS_NS = (1_700_000_000_000_000_001, 1_700_000_000_100_000_002, 1_700_000_000_200_000_003)
SIZE = (16, 24)
K = (20.0, 0.0, 11.5, 0.0, 21.0, 7.5, 0.0, 0.0, 1.0)


class Recorder:
    """Writes messages into a bag of either kind."""

    def __init__(self, writer, types, ros1):
        self.writer, self.types, self.ros1, self.connections = writer, types, ros1, {}

    def add(self, topic, stamp, kind, received=None, **fields):
        """A message with a header; `received` is the time of the bag, by default that of the header."""
        header = self.header(stamp, fields.pop("frame", "cam"))
        message = self.types.types[kind](header=header, **fields)
        self.add_raw(topic, stamp if received is None else received, kind, self.bytes(message, kind))

    def add_raw(self, topic, received, kind, data):
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, kind, typestore=self.types)
        self.writer.write(self.connections[topic], received, data)

    def bytes(self, message, kind):
        return bytes((self.types.serialize_ros1 if self.ros1 else self.types.serialize_cdr)(message, kind))

    def header(self, stamp, frame):
        number = {"seq": 0} if self.ros1 else {}
        time = self.make("builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
        return self.make("std_msgs/msg/Header", stamp=time, frame_id=frame, **number)

    def make(self, kind, **fields):
        return self.types.types[kind](**fields)

    def image(self, topic, stamp, image, encoding="mono8", padding=0, **changes):
        """An image (H, W) or (H, W, C), its rows followed by some bytes."""
        rows = image.reshape(len(image), -1).view(np.uint8)
        rows = np.pad(rows, ((0, 0), (0, padding)))
        fields = {"height": image.shape[0], "width": image.shape[1], "encoding": encoding, "is_bigendian": 0}
        fields |= {"step": rows.shape[1], "data": rows.reshape(-1)} | changes
        self.add(topic, stamp, "sensor_msgs/msg/Image", **fields)

    def compressed(self, topic, stamp, data, format="png"):
        """Bytes of a file."""
        self.add(topic, stamp, "sensor_msgs/msg/CompressedImage", format=format, data=np.frombuffer(data, np.uint8))

    def info(self, topic, stamp=STAMPS_NS[0], size=SIZE, **changes):
        """A camera; its matrices are by rows."""
        k = changes.get("k", K)
        given = {"d": (0.1, 0.01, 0.001, 0.002, 0.0), "k": k, "r": np.eye(3).reshape(-1), "binning": 1,
                 "p": (*k[:3], 0.0, *k[3:6], 0.0, *k[6:], 0.0), "model": "plumb_bob"} | changes  # fmt: skip
        roi = self.make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        matrices = {name.upper() if self.ros1 else name: np.array(given[name], float) for name in "dkrp"}
        self.add(
            topic, stamp, "sensor_msgs/msg/CameraInfo", height=size[0], width=size[1], roi=roi,
            distortion_model=given["model"], binning_x=given["binning"], binning_y=given["binning"], **matrices,
        )  # fmt: skip

    def scan(self, topic, stamp, ranges, start=-1.0, step=0.5, reach=(0.1, 20.0)):
        """Ranges of a scanner in the frame `laser`."""
        self.add(
            topic, stamp, "sensor_msgs/msg/LaserScan", frame="laser", angle_min=start, angle_max=1.0,
            angle_increment=step, time_increment=0.0, scan_time=0.1, range_min=reach[0], range_max=reach[1],
            ranges=np.array(ranges, np.float32), intensities=np.zeros(0, np.float32),
        )  # fmt: skip

    def transform(self, topic, stamp, parent, child, pose):
        """A pose (7,) in the tree of transforms."""
        named = {"header": self.header(stamp, parent), "child_frame_id": child}
        one = self.make("geometry_msgs/msg/TransformStamped", transform=self.turn_and_place(pose)[2], **named)
        kind = "tf2_msgs/msg/TFMessage"
        self.add_raw(topic, stamp, kind, self.bytes(self.make(kind, transforms=[one]), kind))

    def turn_and_place(self, pose):
        """A pose (7,) as a quaternion, a vector and a transform."""
        qx, qy, qz, qw, x, y, z = map(float, pose)
        turn = self.make("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw)
        place = self.make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)
        return turn, place, self.make("geometry_msgs/msg/Transform", translation=place, rotation=turn)

    def pose(self, topic, stamp, pose, kind="geometry_msgs/msg/PoseStamped", child="cam", received=None):
        """A pose (7,), by any of the messages that hold one."""
        turn, place, transform = self.turn_and_place(pose)
        if kind == "geometry_msgs/msg/TransformStamped":
            return self.add(topic, stamp, kind, received, frame="world", child_frame_id=child, transform=transform)
        point = self.make("geometry_msgs/msg/Point", x=place.x, y=place.y, z=place.z)
        told = self.make("geometry_msgs/msg/Pose", position=point, orientation=turn)
        more = {}
        if kind != "geometry_msgs/msg/PoseStamped":
            told = self.make("geometry_msgs/msg/PoseWithCovariance", pose=told, covariance=np.zeros(36))
        if kind == "nav_msgs/msg/Odometry":
            still = self.make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
            twist = self.make("geometry_msgs/msg/Twist", linear=still, angular=still)
            twist = self.make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36))
            more = {"child_frame_id": child, "twist": twist}
        return self.add(topic, stamp, kind, received, frame="world", pose=told, **more)


@contextmanager
def recorded(path, prepare=lambda writer: writer):
    """A bag to write to; the name says of which kind."""
    if path.suffix == ".bag":
        writer, store = rosbag1.Writer(path), Stores.ROS1_NOETIC
    else:
        plugin = StoragePlugin.MCAP if path.name.endswith("mcap") else StoragePlugin.SQLITE3
        writer, store = rosbag2.Writer(path, version=9, storage_plugin=plugin), Stores.LATEST
    with prepare(writer):
        types = get_typestore(store)
        if path.suffix == ".bag":
            definition = "geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"
            types.register(get_types_from_msg(*definition))
        yield Recorder(writer, types, path.suffix == ".bag")


def write_bag(path, stamps=STAMPS_NS, prepare=lambda writer: writer, **camera):
    """Three grey images, a camera, and poses."""
    with recorded(path, prepare) as bag:
        bag.info("/cam0/camera_info", **camera)
        for i, stamp in enumerate(stamps):
            bag.image("/cam0/image_raw", stamp, grey(10 + 10 * i, SIZE))
            bag.pose("/truth", stamp, [0.0, 0.0, 0.0, 1.0, 0.1 * i, 0.0, 0.0])
    return path


def write_pair(path, names=("/left", "/right"), image="image_rect", baseline=0.12, **camera):
    """Three pairs, all right images after all left ones; the topic's last part is one name, or one for each side."""
    left, right = (image, image) if isinstance(image, str) else image
    with recorded(path) as bag:
        for side, name in enumerate(names):
            shift = -K[0] * baseline * side
            p = (*K[:3], shift, *K[3:6], 0.0, *K[6:], 0.0)
            bag.info(f"{name}/camera_info", p=p, **camera)
            for i, stamp in enumerate(STAMPS_NS):
                bag.image(f"{name}/{right if side else left}", stamp, grey(10 + 100 * side + 10 * i, SIZE))
    return path


def film(bag, name, camera, shots, shift=0.0, image="image_raw"):
    """A camera without distortion, and its images; each shot is what `Recorder.image` takes."""
    k = (camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0)
    p = (*k[:3], shift, *k[3:6], 0.0, *k[6:], 0.0)
    bag.info(f"{name}/camera_info", stamp=0, size=(camera.height, camera.width), k=k, p=p, d=(0.0,) * 5)
    for shot in shots:
        bag.image(f"{name}/{image}", **shot)


def film_images(bag, sequence, spoil=lambda k, shot: shot):
    """One camera's images and truth, from another recording."""
    shots = [spoil(k, {"stamp": f.stamp_ns, "image": f.image}) for k, f in enumerate(sequence.frames())]
    film(bag, "/cam0", sequence.camera, shots)
    for stamp, pose in zip(sequence.truth.stamps_ns.tolist(), sequence.truth.poses, strict=True):
        bag.pose("/truth", stamp, pose)


def film_pairs(bag, sequence, image="image_raw"):
    """Two cameras' images, from another recording."""
    camera, shift = sequence.rig.camera, -sequence.rig.baseline_m * sequence.rig.camera.fx
    frames = list(sequence.frames())
    film(bag, "/left", camera, [{"stamp": f.stamp_ns, "image": f.image} for f in frames], 0.0, image)
    film(bag, "/right", camera, [{"stamp": f.stamp_ns, "image": f.right} for f in frames], shift, image)


def write_scans(path, turned=(0.0, 0.0, 0.0, 1.0), by_topic=False, **scanner):
    """Three scans, the odometry a little beside them, and a scanner 0.2 m ahead of the robot's middle."""
    with recorded(path) as bag:
        bag.transform("/tf_static", STAMPS_NS[0], "base", "laser", (*turned, 0.2, 0.0, 0.3))
        for i, stamp in enumerate((STAMPS_NS[0] - 50_000_000, *STAMPS_NS)):
            pose = [0.0, 0.0, np.sin(0.05 * i), np.cos(0.05 * i), float(i), 0.0, 0.0]
            if by_topic:
                bag.pose("/odom", stamp + 50_000_000, pose, "nav_msgs/msg/Odometry", child="base")
            else:
                bag.transform("/tf", stamp + 50_000_000, "odom", "base", pose)
        for stamp in STAMPS_NS:
            bag.scan("/scan", stamp, [1.0, 0.05, np.nan, np.inf, 25.0], **scanner)
    return path
