"""True poses of a ROS bag: geometry_msgs PoseStamped, PoseWithCovarianceStamped, TransformStamped, nav_msgs Odometry.

They are taken as world_from_camera, of the camera's optical frame (x to the right, y down, z ahead). A bag whose poses
are those of another frame, such as `base_link`, has to be converted first; where its names show that, a logged message
says so.
"""

import logging
from typing import Any

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.sensors.feature_log import CameraTruth
from rbpf.sensors.readers.images.bag_file import Bag
from rbpf.sensors.readers.images.truth import LONGEST, truth_between

_PLACES = {
    "geometry_msgs/msg/PoseStamped": "pose",
    "geometry_msgs/msg/PoseWithCovarianceStamped": "pose.pose",
    "nav_msgs/msg/Odometry": "pose.pose",
    "geometry_msgs/msg/TransformStamped": "transform",
}
"""Where a message holds its pose."""

_log = logging.getLogger(__name__)


def read_poses(bag: Bag, topic: str, images_ns: np.ndarray, camera_frame: str) -> CameraTruth:
    """The truth that a topic holds.

    Args:
        bag: the open bag.
        topic: of the poses.
        images_ns: (T,) times of the images.
        camera_frame: name of the images' frame, which the poses should be those of.

    Raises:
        InputError: there is no such topic, it holds no poses, they run backwards, or are of another clock.
    """
    kind = bag.topics.get(topic, "")
    if kind not in _PLACES:
        held = bag.of_type(*_PLACES)
        found = f"found {', '.join(held)}" if held else "found none"
        raise InputError(f"{bag.path}: expected poses in the topic {topic}, {found} with poses in the bag.")
    stamps, poses = list[int](), list[list[float]]()
    for raw in bag.messages(topic):
        message = bag.message(raw)
        if not poses:
            _warn_of_frame(bag, topic, getattr(message, "child_frame_id", ""), camera_frame)
        stamps.append(raw.stamp_ns)
        poses.append(_pose(_at(message, _PLACES[kind])))
    where = f"{bag.path}, {topic}"
    if not poses:
        raise InputError(f"{where}: no pose can be read.")
    stamps_ns, world_from_camera = np.array(stamps, np.int64), np.array(poses)
    if (late := np.flatnonzero(np.diff(stamps_ns) < 0)).size:
        raise InputError(f"{where}: the stamp of pose {late[0] + 1} is before the one it follows.")
    length = np.linalg.norm(world_from_camera[:, :4], axis=1)
    wrong = np.flatnonzero(~(np.abs(length - 1.0) <= LONGEST) | ~np.isfinite(world_from_camera).all(axis=1))
    if wrong.size:
        raise InputError(
            f"{where}: pose {wrong[0]} has a quaternion of length {length[wrong[0]]:.6g}, expected 1."
        )
    return truth_between(bag.path, stamps_ns, SE3.normalise(world_from_camera), images_ns)


def _at(message: Any, place: str) -> Any:
    for name in place.split("."):
        message = getattr(message, name)
    return message


def _pose(given: Any) -> list[float]:
    """qx, qy, qz, qw, x, y, z of a Pose or a Transform."""
    turn = given.orientation if hasattr(given, "orientation") else given.rotation
    place = given.position if hasattr(given, "position") else given.translation
    return [turn.x, turn.y, turn.z, turn.w, place.x, place.y, place.z]


def _warn_of_frame(bag: Bag, topic: str, frame: str, camera_frame: str) -> None:
    if frame and camera_frame and frame.strip("/") != camera_frame.strip("/"):
        _log.warning(
            "%s: the poses of %s are those of %s and are taken as those of the camera %s",
            bag.path, topic, frame, camera_frame,
        )  # fmt: skip
