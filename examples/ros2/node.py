"""A ROS 2 node for mono, stereo or laser: `python examples/ros2/node.py mono --ros-args -r image:=/camera/image_raw …`.

It subscribes to the topics of the trackers in adapter.py, and publishes rbpf/odometry, rbpf/path, rbpf/map and the
transform. Only this file needs ROS.
"""

import sys
from array import array
from importlib import import_module
from typing import Any

import numpy as np
import rclpy
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data, qos_profile_system_default

from examples.ros2.adapter import KINDS, TRACKERS

MAPS = {"laser": "nav_msgs/msg/OccupancyGrid"}


def kind_of(name: str) -> Any:
    """The class of a message type such as nav_msgs/msg/Odometry."""
    package, _, message = name.split("/")
    return getattr(import_module(f"{package}.msg"), message)


def make(kind: str, **fields: Any) -> Any:
    """Creates a message; for bytes rclpy takes Python's own array."""
    codes = {"uint8": "B", "int8": "b"}
    given = {
        name: array(codes[value.dtype.name], value.tobytes())
        if isinstance(value, np.ndarray) and value.dtype.name in codes
        else value
        for name, value in fields.items()
    }
    return kind_of(kind)(**given)


class RbpfNode(Node):
    """Passes messages to a tracker, and publishes what it returns."""

    def __init__(self, system: str) -> None:
        super().__init__(f"rbpf_{system}")
        self.tracker = TRACKERS[system](make)
        kinds = {"rbpf/map": MAPS.get(system, "sensor_msgs/msg/PointCloud2")} | KINDS
        self.outputs = {
            topic: self.create_publisher(kind_of(kinds[topic]), topic, qos_profile_system_default)
            for topic in ("rbpf/odometry", "rbpf/path", "rbpf/map", "/tf")
        }
        for topic, callback in self.tracker.callbacks.items():
            kind = kind_of(KINDS[topic.rpartition("/")[2]])
            self.create_subscription(kind, topic, self.passing_on(callback), qos_profile_sensor_data)

    def passing_on(self, callback: Any) -> Any:
        def take(message: Any) -> None:
            for topic, said in callback(message):
                self.outputs[topic].publish(said)

        return take


def main() -> None:
    rclpy.init()
    node = RbpfNode(sys.argv[1])
    rclpy.spin(node)


if __name__ == "__main__":
    main()
