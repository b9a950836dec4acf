"""Range-bearing SLAM in the plane and in space: odometry motion, a mounted sensor, point landmarks."""

from collections.abc import Callable

import numpy as np

from rbpf.core.filter import Filter
from rbpf.core.models import Sensor
from rbpf.lie import SE2Group
from rbpf.maps.landmark_map import LandmarkMap
from rbpf.maps.point import Point
from rbpf.motion.odometry import Odometry, OdometryMotion
from rbpf.sensors.landmark_sensor import AnonymousLandmarkSensor, NamedLandmarkSensor
from rbpf.sensors.range_bearing import RangeBearing, RelativePosition, RigidPointModel
from rbpf.sensors.readers.log import Frame, RobotLog
from rbpf.systems.range_bearing.config import RangeBearingConfig


def build_filter(
    log: RobotLog, config: RangeBearingConfig, wrapped: Callable[[Sensor], Sensor] | None = None
) -> Filter:
    """The filter for a log; the robot starts at the origin of the world.

    Args:
        log: the recording.
        config: all settings.
        wrapped: puts a sensor around the usual one, to change what it observes or starts.
    """
    landmark_map = LandmarkMap(log.space, evidence=config.association == "ml", compiled=config.compiled)
    landmark_map.register(build_point(log))
    sensor = build_sensor(log, config)
    return Filter(
        OdometryMotion(log.space),
        sensor if wrapped is None else wrapped(sensor),
        landmark_map,
        config.proposal.build(),
        config.resampling.build(),
        config.particles,
        np.random.default_rng(config.seed),
        lag=config.lag,
    )


def build_model(log: RobotLog, config: RangeBearingConfig) -> RigidPointModel:
    """How this log's sensor measures a point."""
    max_range = np.inf if config.unknown.max_range_m is None else config.unknown.max_range_m
    if log.measurement == "position":
        return RelativePosition(log.space, log.robot_from_sensor, max_range)
    view = np.deg2rad(config.unknown.half_field_of_view_deg)
    return RangeBearing(log.space, log.robot_from_sensor, log.pitch_sign, max_range, view)


def build_sensor(log: RobotLog, config: RangeBearingConfig) -> Sensor:
    """The sensor, with the log's names or without."""
    model, point, likelihood = build_model(log, config), build_point(log), config.likelihood.build()
    if config.association == "known":
        return NamedLandmarkSensor(model, point, likelihood)
    unknown = config.unknown
    return AnonymousLandmarkSensor(model, point, unknown.gates(model.dim), unknown.existence(), likelihood)


def control_of(frame: Frame) -> Odometry | None:
    """The odometry that led to a frame; none leads to the first."""
    if frame.delta is None or frame.cov_delta is None:
        return None
    return Odometry(frame.delta, frame.cov_delta)


def build_point(log: RobotLog) -> Point:
    """The landmarks' parametrisation."""
    return Point(2 if isinstance(log.space, SE2Group) else 3)
