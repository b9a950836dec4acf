"""`sensor.yaml` of a camera in the ASL layout."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rbpf.lie import Array
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.readers.images.calibration import Calibration, coefficients
from rbpf.sensors.readers.images.mapping import YamlValue, read_yaml
from rbpf.sensors.readers.images.matrices import pose_of_matrix, rigid_motion_error

_REQUIRED = (
    "T_BS",
    "resolution",
    "camera_model",
    "intrinsics",
    "distortion_model",
    "distortion_coefficients",
)
_LENSES = {
    "radial-tangential": "radial-tangential",
    "radtan": "radial-tangential",
    "equidistant": "equidistant",
}
_MOUNT = "a sensor.yaml with T_BS, the pose of the sensor on the body"


@dataclass(frozen=True)
class AslCamera:
    """A camera and where it sits.

    Attributes:
        calibration: the camera.
        body_from_camera: (7,) T_BS.
    """

    calibration: Calibration
    body_from_camera: Array


def read_camera(path: Path, hint: str) -> AslCamera:
    """Read a camera.

    Args:
        path: the file.
        hint: what is expected to lie there, for the message.

    Raises:
        InputError: the file is missing, or is no pinhole camera with radial-tangential or equidistant distortion.
    """
    whole = read_yaml(path, hint)
    entries = whole.entries()
    whole.require_keys(entries, _REQUIRED)
    entries["camera_model"].choice(["pinhole"])
    model = _LENSES[entries["distortion_model"].choice(list(_LENSES))]
    width, height = entries["resolution"].items(2)
    fx, fy, cx, cy = entries["intrinsics"].items(4)
    camera = Pinhole(
        width=width.size(),
        height=height.size(),
        fx=fx.positive(),
        fy=fy.positive(),
        cx=cx.number(),
        cy=cy.number(),
        distortion=coefficients(entries["distortion_coefficients"], model),
        distortion_model=model,
    )
    return AslCamera(Calibration(str(path), camera), _mount(entries["T_BS"]))


def read_mount(path: Path) -> Array:
    """body_from_sensor (7,) of any sensor.

    Raises:
        InputError: the file is missing, or has no T_BS.
    """
    whole = read_yaml(path, _MOUNT)
    entries = whole.entries()
    whole.require_keys(entries, ["T_BS"])
    return _mount(entries["T_BS"])


def _mount(value: YamlValue) -> Array:
    entries = value.entries()
    value.require_keys(entries, ["data"])
    numbers = [item.number() for item in entries["data"].items(16)]
    matrix = np.reshape(numbers, (4, 4))
    if (problem := rigid_motion_error(matrix)) is not None:
        raise value.error(f"T_BS: {problem}")
    return pose_of_matrix(matrix)
