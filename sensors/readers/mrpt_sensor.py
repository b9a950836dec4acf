"""`sensor.yaml` of an MRPT log.

    robot_from_sensor: {x_m: 0, y_m: 0, z_m: 0, yaw_deg: 0, pitch_deg: 0, roll_deg: 0}
    std: {range_m: 0.01, yaw_deg: 0.1}
    positive_pitch: down

The rotation is Rz(yaw) Ry(pitch) Rx(roll). `std` is optional and for people to read: every observation brings
its own standard deviations. `positive_pitch` is up or down.
"""

from pathlib import Path

import numpy as np
import yaml

from rbpf.lie import SE2, SE3, Array
from rbpf.sensors.readers.table import parse_number
from rbpf.sensors.readers.text import line_error, quoted, read_text
from rbpf.sensors.readers.yaml_nodes import compose

_MOUNT = ("x_m", "y_m", "z_m", "yaw_deg", "pitch_deg", "roll_deg")
_SIGNS = {"up": 1.0, "down": -1.0}


def read_sensor(path: Path, planar: bool, hint: str) -> tuple[Array, float]:
    """Mounting of the sensor and sign of pitch.

    Args:
        path: the file.
        planar: whether the robot moves in the plane; the height of the sensor is then left out.
        hint: what is expected to lie there, for the message.

    Returns:
        robot_from_sensor, (3,) in the plane and (7,) in space, and +1 where positive pitch points up, else
        -1.

    Raises:
        InputError: the file is missing or not as described above.
    """
    keys = ("robot_from_sensor", "positive_pitch")
    node = compose(path, read_text(path, hint), " and ".join(keys))
    fields = _mapping(path, node, keys, optional=("std",))
    mount = _mapping(path, fields["robot_from_sensor"], _MOUNT)
    values = np.array([_number(path, key, mount[key]) for key in _MOUNT])
    yaw, pitch, roll = np.deg2rad(values[3:])
    sign = _sign(path, fields["positive_pitch"])
    if not planar:
        return SE3.from_ypr(values[:3], yaw, pitch, roll), sign
    if pitch or roll:
        problem = "expected pitch_deg and roll_deg to be 0, as the odometry is planar"
        raise line_error(path, _line(fields["robot_from_sensor"]), problem)
    return SE2.normalise(np.array([yaw, values[0], values[1]])), sign


def _mapping(
    path: Path, node: yaml.Node, keys: tuple[str, ...], optional: tuple[str, ...] = ()
) -> dict[str, yaml.Node]:
    expected = f"expected the keys {', '.join(keys)}"
    if not isinstance(node, yaml.MappingNode):
        raise line_error(path, _line(node), f"{expected}, found no mapping")
    found: dict[str, yaml.Node] = {}
    for key, value in node.value:
        name = _scalar(path, key)
        if name not in keys + optional or name in found:
            raise line_error(path, _line(key), f"{expected}, each once, found {quoted(name)}")
        found[name] = value
    if missing := [key for key in keys if key not in found]:
        raise line_error(path, _line(node), f"{expected}, found no {missing[0]}")
    return found


def _sign(path: Path, node: yaml.Node) -> float:
    direction = _scalar(path, node)
    if direction not in _SIGNS:
        problem = f"expected positive_pitch to be up or down, found {quoted(direction)}"
        raise line_error(path, _line(node), problem)
    return _SIGNS[direction]


def _number(path: Path, key: str, node: yaml.Node) -> float:
    return parse_number(path, _line(node), key, _scalar(path, node))


def _scalar(path: Path, node: yaml.Node) -> str:
    if not isinstance(node, yaml.ScalarNode):
        raise line_error(path, _line(node), "expected a single value, found a list or a mapping")
    return str(node.value)


def _line(node: yaml.Node) -> int:
    return int(node.start_mark.line) + 1
