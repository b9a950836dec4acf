"""Planar graphs of odometry and landmark positions, as the Victoria Park data set is distributed with GTSAM.

A text file of blank-separated lines:

    ODOMETRY from to dx dy dtheta cxx cxy cxt cyy cyt ctt
    LANDMARK pose landmark x y cxx cxy cyy

The motion is that from pose `from` to pose `to` in the frame of `from`, in metres and radians, with the
upper triangle of its covariance; the lines follow one another without gap or loop. A landmark's position is
given in the robot's frame, x forward and y left, in metres, with the upper triangle of its covariance. Poses
and landmarks share one space of numbers. Association is known, the truth is not.

Every pose is a frame, whose stamp is its index; the names of landmarks are their numbers.
E. Nebot, J. Guivant, Victoria Park data set, Sydney.
"""

import re
from pathlib import Path
from typing import final

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import SE2
from rbpf.sensors.readers import robot_log
from rbpf.sensors.readers.format import Format
from rbpf.sensors.readers.robot_log import LogNoise, RobotLog, assemble
from rbpf.sensors.readers.text import line_error, parse_table, quoted, read_bytes, read_lines

_COLUMNS = {
    "ODOMETRY": ("from", "to", "dx", "dy", "dtheta", "cxx", "cxy", "cxt", "cyy", "cyt", "ctt"),
    "LANDMARK": ("pose", "landmark", "x", "y", "cxx", "cxy", "cyy"),
}
_KEYWORD = re.compile(rb"^(ODOMETRY|LANDMARK)\b", re.MULTILINE)


@final
class VictoriaPark(Format[LogNoise, RobotLog]):
    """Planar graphs; landmark positions take the standard deviation given, if any."""

    kind = "a graph (a text file with lines ODOMETRY and LANDMARK, or a folder with one such .txt)"

    def recognises(self, path: Path) -> bool:
        return bool(_graphs(path))

    def read(self, path: Path, noise: LogNoise) -> RobotLog:
        noise.require_only({"std_position_m", "scale_odometry"}, path, "a graph of landmark positions")
        graphs = _graphs(path)
        if len(graphs) != 1:
            raise InputError(f"{path}: expected {self.kind}; found {len(graphs)}; name one, such as {graphs[0]}.")
        path = graphs[0]
        lines: dict[str, list[tuple[int, str]]] = {keyword: [] for keyword in _COLUMNS}
        for number, line in enumerate(read_lines(path), 1):
            keyword, *rest = line.split(None, 1) or [""]
            if keyword in lines:
                if not rest:
                    raise line_error(path, number, f"expected numbers after {keyword}, found none")
                lines[keyword].append((number, rest[0]))
            elif keyword:
                raise line_error(path, number, f"expected ODOMETRY or LANDMARK, found {quoted(keyword)}")
        odometry, observations = (parse_table(path, _COLUMNS[name], lines[name]) for name in _COLUMNS)
        # Poses (T,), along a path without gap or loop.
        start, stop = odometry.integers("from"), odometry.integers("to")
        if (apart := np.flatnonzero(stop[:-1] != start[1:])).size:
            row = int(apart[0]) + 1
            problem = f"expected odometry from pose {stop[row - 1]}, where the one before ends, found {start[row]}"
            raise odometry.error(row, problem)
        if start[0] in odometry.names("to"):
            problem = f"expected a path without loops, found a return to pose {start[0]}"
            raise odometry.error(int(np.argmax(stop == start[0])), problem)
        poses = np.concatenate([start[:1], stop])
        # Landmarks are observed from these poses, once per pose, and share no number with a pose.
        pose, landmarks = observations.integers("pose"), observations.integers("landmark")
        observations.require(np.isin(pose, poses), "pose", "a pose of the odometry")
        observations.require(~np.isin(landmarks, poses), "landmark", "a landmark's number, not a pose's")
        by_number = np.argsort(poses)
        frame = by_number[np.searchsorted(poses, pose, sorter=by_number)]
        observations.require_distinct(pose, landmarks, "pose")
        z, cov_z = observations.block("x", "y"), robot_log.read_covariances(observations, "cxx", "cyy")
        if noise.std_position_m is not None:
            cov_z = robot_log.diagonal([np.full(len(z), noise.std_position_m)] * 2)
        delta = SE2.normalise(np.roll(odometry.block("dx", "dtheta"), 1, axis=1))
        cov_delta = robot_log.planar_to_chart(delta, robot_log.read_covariances(odometry, "cxx", "ctt"))
        cov_delta = cov_delta * noise.odometry_variance_factor()
        order = np.argsort(frame, kind="stable")
        stamps = np.arange(len(poses))
        return RobotLog(
            name=graphs[0].stem,
            space=SE2,
            measurement="position",
            robot_from_sensor=SE2.identity(),
            frames=assemble(stamps, delta, cov_delta, frame[order], landmarks[order], z[order], cov_z[order]),
        )


def _graphs(path: Path) -> list[Path]:
    files = sorted(path.glob("*.txt")) if path.is_dir() else [path]
    return [file for file in files if file.is_file() and _KEYWORD.search(read_bytes(file))]
