"""Monocular SLAM on features (E06): constant velocity, a camera, points and rays."""

import numpy as np

from rbpf.anchoring import Anchored
from rbpf.errors import InputError
from rbpf.filter import Filter
from rbpf.lie import SE3
from rbpf.maps.constellation import Constellation
from rbpf.maps.landmark_map import LandmarkMap
from rbpf.maps.point import Point
from rbpf.models import Conditional, MotionModel, Records
from rbpf.motion.constant_velocity import MarginalVelocity, PoseLaw, SampledVelocity
from rbpf.sensors.features import FeatureLog, KnownPoints
from rbpf.sensors.pinhole import Pinhole
from rbpf.sensors.resection import resect
from rbpf.substate import KalmanSubstate
from rbpf.systems.mono.config import MonoConfig, VelocityConfig
from rbpf.systems.mono.feature_sensor import CONSTELLATION, FeatureSensor


def build_filter(log: FeatureLog, config: MonoConfig) -> Filter:
    """The filter for a log, with its known points in the map; `start_law` says where it starts.

    Raises:
        InputError: the log is not a monocular one.
    """
    if not isinstance(log.camera, Pinhole):
        raise InputError(f"{log.name}: monocular SLAM needs a log of one camera, this is a stereo log")
    motion = build_motion(config.velocity)
    landmark_map = LandmarkMap(motion.space, compiled=config.compiled)
    as_frame = log.known is not None and config.known == "frame"
    sensor = FeatureSensor(log.camera, config.ray, config.births_per_frame, log.known if as_frame else None)
    landmark_map.register(Point(3))
    landmark_map.register(sensor.inverse_depth)
    parts: list[Conditional] = [landmark_map]
    if config.velocity.mode == "marginal":
        parts.append(KalmanSubstate(SE3, np.zeros(6), np.diag(_start_std(config.velocity) ** 2)))
    filter_ = Filter(
        motion,
        sensor,
        parts,
        config.proposal.build(),
        config.resampling.build(),
        config.particles,
        np.random.default_rng(config.seed),
    )
    if as_frame:
        add_constellation(landmark_map, log, config)
    elif log.known is not None:
        add_known_points(landmark_map, log.known, config.particles)
    return filter_


def build_motion(config: VelocityConfig) -> MotionModel:
    """Constant velocity in one of the three modes."""
    walk = np.repeat([config.walk_rad_s, config.walk_m_s], 3)
    if config.mode == "marginal":
        return MarginalVelocity(walk)
    return SampledVelocity(walk, config.mode, _start_std(config))


def add_known_points(landmark_map: LandmarkMap, known: KnownPoints, n: int) -> None:
    """They enter once, with their σ, and are ordinary landmarks from then on."""
    mean = np.broadcast_to(known.positions, (n, *known.positions.shape))
    cov = np.broadcast_to(known.cov, (n, *known.cov.shape))
    ids = landmark_map.add_records(Records(mean, cov), Point(3))
    landmark_map.catalogue.update(zip(ids.tolist(), known.names.tolist(), strict=True))


def add_constellation(landmark_map: LandmarkMap, log: FeatureLog, config: MonoConfig) -> None:
    """The known points as one landmark: their frame, as seen from the first camera."""
    assert log.known is not None
    group = Constellation(log.known.positions, log.known.cov)
    records = group.started(config.particles, SE3.inverse(_resected(log)), _start_cov(config))
    ids = landmark_map.add_records(records, group)
    landmark_map.catalogue[int(ids[0])] = CONSTELLATION


def world_of(filter_: Filter) -> Anchored | None:
    """The known points' frame in each particle's own world, which starts at its first camera; None without one."""
    landmark_map = filter_.belief().map
    for landmark, name in landmark_map.catalogue.items():
        if name == CONSTELLATION:
            group = landmark_map.landmark_of(landmark)
            records = landmark_map.read(np.array([landmark]))
            return Anchored(group.frame(records.mean[:, 0], records.const[:, 0]), group.frame_factor(records))
    return None


def start_law(log: FeatureLog, config: MonoConfig) -> PoseLaw:
    """Where the camera is at first, before the known points are measured: at the origin, exactly, unless they say it.

    The law is wide: the measurements of the first frame, not the resection, say where in it the camera is.

    Raises:
        InputError: fewer than four known points are seen in the first frame, or they do not determine the camera.
    """
    if log.known is None or config.known == "frame":
        return PoseLaw(SE3.identity(), np.zeros((6, 6)))
    return PoseLaw(_resected(log), _start_cov(config))


def _resected(log: FeatureLog) -> np.ndarray:
    """world_from_camera of the first frame, from the known points."""
    assert isinstance(log.camera, Pinhole) and log.known is not None
    first = log.frames[0]
    inside = log.camera.inside(first.z)
    names, z = first.landmarks[inside], first.z[inside]
    _, in_known, in_frame = np.intersect1d(log.known.names, names, return_indices=True)
    return resect(log.camera, log.known.positions[in_known], z[in_frame])


def _start_cov(config: MonoConfig) -> np.ndarray:
    return np.diag(np.repeat([config.start_std_rad**2, config.start_std_m**2], 3))


def _start_std(config: VelocityConfig) -> np.ndarray:
    return np.repeat([config.start_rad_s, config.start_m_s], 3)
