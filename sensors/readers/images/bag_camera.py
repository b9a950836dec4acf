"""Cameras of a ROS bag: sensor_msgs CameraInfo.

Its K, D and its size are the camera's. Where the last part of the topic's name says that the images are rectified
(`image_rect`, `image_rect_color`), which is all that a bag says about it, the camera is that of P, without distortion.
Of two cameras, R and P say where they are.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import Array
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.readers.images.bag_file import Bag
from rbpf.sensors.readers.images.calibration import Calibration
from rbpf.sensors.readers.images.matrices import pose_of_matrix, rigid_motion_error

CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
NO_DISTORTION = (0.0, 0.0, 0.0, 0.0, 0.0)

_RADIAL_TANGENTIAL = "plumb_bob", "rational_polynomial"
"""Models of distortion that begin with k1, k2, p1, p2, k3; the second one goes on with what must be zero."""

_EQUIDISTANT = "equidistant", "fisheye"
"""Models with k1, k2, k3, k4: ROS's name and OpenCV's."""


@dataclass(frozen=True)
class CameraInfo:
    """A camera as its messages tell it.

    Attributes:
        calibration: the camera of the images as they are in the bag.
        turn: (3, 3) R, which rectifies the pair that it belongs to.
        projection: (3, 4) P, of the camera after that turn; its last column tells the baseline.
        is_rectified: whether the images have been turned so.
    """

    calibration: Calibration
    turn: Array
    projection: Array
    is_rectified: bool

    def rectified_from_camera(self) -> Array:
        """R as a pose (7,).

        Raises:
            InputError: it is no rotation.
        """
        placed = np.column_stack([self.turn, np.zeros(3)])
        if not np.isfinite(placed).all() or rigid_motion_error(placed):
            raise InputError(f"{self.calibration.where}: R is no rotation; calibrate the two as a pair.")
        return pose_of_matrix(placed)

    @property
    def shift_m(self) -> float:
        """How far to the right of the pair's left camera this one is, rectified; 0 where it is not told."""
        fx, shift = self.projection[0, [0, 3]]
        return float(-shift / fx) if fx > 0.0 and np.isfinite(shift) else 0.0


def read_info(bag: Bag, image_topic: str) -> CameraInfo:
    """The camera of a topic of images, from the first message about it.

    Raises:
        InputError: there is none, it is not calibrated, or its lens is of another kind.
    """
    topic = _info_topic(bag, image_topic)
    where = f"{bag.path}, {topic}"
    raw = next(bag.messages(topic), None)
    if raw is None:
        raise InputError(f"{where}: no message can be read.")
    message = bag.message(raw)
    _require_whole(message, where)
    turn, projection = _field(message, "R").reshape(3, 3), _field(message, "P").reshape(3, 4)
    is_rectified = _named(image_topic).rpartition("/")[2].startswith("image_rect")
    intrinsics = projection[:, :3] if is_rectified else _field(message, "K").reshape(3, 3)
    lens = {} if is_rectified else _lens(message, where)
    camera = _pinhole(message, intrinsics, lens, where)
    return CameraInfo(Calibration(where, camera), turn, projection, is_rectified)


def _named(image_topic: str) -> str:
    return image_topic.removesuffix("/compressed")


def _info_topic(bag: Bag, image_topic: str) -> str:
    expected = f"{_named(image_topic).rpartition('/')[0]}/camera_info"
    held = bag.of_type(CAMERA_INFO)
    if expected in held:
        return expected
    found = f"found {', '.join(held)}" if held else "found no sensor_msgs/CameraInfo"
    raise InputError(
        f"{bag.path}: expected the camera of {image_topic} in {expected}, {found}; give --calibration camera.yaml."
    )


def _require_whole(message: Any, where: str) -> None:
    roi = message.roi
    if max(message.binning_x, message.binning_y) > 1 or roi.x_offset or roi.y_offset:
        problem = "the images are binned or a part of the sensor's, which K does not describe"
        raise InputError(f"{where}: {problem}; give --calibration with the camera of these images.")


def _field(message: Any, name: str) -> Array:
    """Numbers that ROS 1 names with a capital letter and ROS 2 with a small one."""
    return np.array(getattr(message, name if hasattr(message, name) else name.lower()), np.float64)


def _lens(message: Any, where: str) -> dict[str, Any]:
    """The camera's model of distortion and its coefficients."""
    d, model = _field(message, "D").tolist(), message.distortion_model
    if model in _EQUIDISTANT and len(d) == 4:
        return {"distortion_model": "equidistant", "distortion": tuple(d)}
    if (model in _RADIAL_TANGENTIAL or not (model or any(d))) and not any(d[5:]):
        return {"distortion": (*d[:5], *NO_DISTORTION)[:5]}
    problem = f"the lens is {model[:40]!r} with {len(d)} coefficients"
    expected = "expected plumb_bob with 4 or 5, or equidistant with 4"
    raise InputError(f"{where}: {problem}, {expected}; rectify the images, or give --calibration.")


def _pinhole(message: Any, intrinsics: Array, lens: dict[str, Any], where: str) -> Pinhole:
    fx, fy, cx, cy = intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    if not (np.isfinite(intrinsics).all() and fx > 0.0 and fy > 0.0):
        raise InputError(f"{where}: the camera is not calibrated (fx {fx:g}, fy {fy:g}); give --calibration.")
    try:
        return Pinhole(message.width, message.height, fx, fy, cx, cy, **lens)
    except InputError as error:
        raise InputError(f"{where}: {error}; give --calibration.") from None
