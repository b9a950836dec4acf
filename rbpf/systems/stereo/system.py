"""Stereo SLAM (S05): visual odometry moves the particles, landmarks of a shared map weigh them."""

import numpy as np

from rbpf.core.filter import Filter
from rbpf.core.models import Sensor
from rbpf.lie import SE3
from rbpf.maps.landmark_map import LandmarkMap
from rbpf.maps.point import Point
from rbpf.motion.stereo_odometer import StereoOdometer
from rbpf.motion.stereo_odometry import StereoOdometry
from rbpf.sensors.camera import RectifiedStereo
from rbpf.systems.stereo.config import StereoConfig
from rbpf.systems.stereo.dead_reckoning import DeadReckoning


def build_filter(sensor: Sensor, config: StereoConfig) -> Filter:
    """The filter; the first camera is the world."""
    landmark_map = LandmarkMap(SE3, compiled=config.compiled)
    landmark_map.register(Point(3))
    added = np.repeat([config.odometry.std_added_rad, config.odometry.std_added_m], 3)
    return Filter(
        StereoOdometry(config.dof, added),
        sensor,
        landmark_map,
        config.proposal.build(),
        config.resampling.build(),
        config.particles,
        np.random.default_rng(config.seed),
        lag=config.lag,
    )


def build_reckoning(rig: RectifiedStereo, config: StereoConfig) -> DeadReckoning:
    """What moves the particles between updates."""
    odometry = config.odometry
    odometer = StereoOdometer(rig, np.random.default_rng(config.seed), odometry.estimate, odometry.prediction)
    return DeadReckoning(odometer, config.dof)
