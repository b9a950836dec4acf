"""The measurements of a recording whose association is known."""

import numpy as np

from rbpf import gaussian
from rbpf.lie import Array
from rbpf.sensors.readers import RobotLog
from rbpf.sensors.readers.measurements import KINDS, Measurements, point_dim


def from_log(log: RobotLog, start: Array | None = None) -> Measurements:
    """All measurements of a log; landmarks keep the log's names. It starts at the origin, if nothing else is given."""
    space, point = log.space, point_dim(log.space)

    def stacked(field: str, shape: tuple[int, ...]) -> Array:
        return np.concatenate([np.reshape(getattr(frame, field), (-1, *shape)) for frame in log.frames])

    moves = log.frames[1:]
    return Measurements(
        recording=log.name,
        space=space,
        measurement=KINDS[log.measurement],
        pitch_sign=log.pitch_sign,
        robot_from_sensor=log.robot_from_sensor,
        start=space.identity() if start is None else start,
        stamps_ns=np.array([frame.stamp_ns for frame in log.frames], dtype=np.int64),
        deltas=np.array([frame.delta for frame in moves]).reshape(-1, space.size),
        covs=gaussian.symmetrise(np.array([frame.cov_delta for frame in moves]).reshape(-1, space.dim, space.dim)),
        steps=np.repeat(np.arange(len(log.frames)), [len(frame.z) for frame in log.frames]),
        landmarks=stacked("landmarks", ()).astype(np.int64),
        z=stacked("z", (point,)),
        cov_z=gaussian.symmetrise(stacked("cov_z", (point, point))),
    )
