"""Monocular SLAM on features (E06): constant velocity, a camera, points and rays."""

from collections.abc import Callable

import numpy as np

from rbpf.core.anchoring import Anchored
from rbpf.core.filter import Filter
from rbpf.core.models import Conditional, MotionModel, Records, Sensor
from rbpf.core.substate import KalmanSubstate
from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.maps.constellation import Constellation, UncertainConstellation
from rbpf.maps.landmark_map import LandmarkMap
from rbpf.maps.point import Point
from rbpf.motion.constant_velocity import MarginalVelocity, PosePrior, SampledVelocity
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.camera.resection import resect
from rbpf.sensors.feature_log import FeatureFrame, FeatureLog, KnownPoints
from rbpf.systems.mono.config import MonoConfig, VelocityConfig
from rbpf.systems.mono.feature_sensor import CONSTELLATION, FeatureSensor
from rbpf.systems.mono.known_start import KnownStart, first_records


def build_filter(
    log: FeatureLog, config: MonoConfig, wrapped: Callable[[FeatureSensor], Sensor] | None = None
) -> Filter:
    """The filter for a log, with its known points in the map; `start_prior` says where it starts.

    Args:
        log: of one camera.
        config: all settings.
        wrapped: puts a sensor around the usual one, to change what it observes or starts.

    Raises:
        InputError: the log is not a monocular one.
    """
    features, start = features_of(log, config)
    return assemble(config, features, start, None if wrapped is None else wrapped(features))


def features_of(log: FeatureLog, config: MonoConfig) -> tuple[FeatureSensor, KnownStart | None]:
    """What turns the features of a log into observations, and what its first frame shows of known points.

    Raises:
        InputError: the log is not a monocular one.
    """
    if not isinstance(log.camera, Pinhole):
        raise InputError(f"{log.name}: monocular SLAM needs a log of one camera, this is a stereo log")
    if any((frame.landmarks < 0).any() for frame in log.frames):
        raise InputError(f"{log.name}: a landmark has a negative name, number the landmarks from 0 on")
    start = None if log.known is None else _known_start(log)
    return build_features(log.camera, config, start), start


def build_features(
    camera: Pinhole, config: MonoConfig, start: KnownStart | None, fixed: bool = False
) -> FeatureSensor:
    """What turns found features into observations; with `fixed` of a map that is known and stays as it is."""
    group = start if config.known == "frame" else None
    return FeatureSensor(camera, config.inverse_depth, config.max_new_per_frame, group, fixed)


def assemble(
    config: MonoConfig,
    features: FeatureSensor,
    start: KnownStart | None,
    sensor: Sensor | None = None,
    mapped: KnownPoints | None = None,
) -> Filter:
    """The filter, with the known points in its map.

    Args:
        config: all settings.
        features: what turns found features into observations.
        start: known points, if there are any.
        sensor: what finds features and hands them to `features`; by default the features come as they are.
        mapped: points of a map that the camera is to be found in, in the world of the particles.
    """
    motion = build_motion(config.velocity)
    landmark_map = LandmarkMap(motion.space, compiled=config.compiled)
    landmark_map.register(Point(3))
    landmark_map.register(features.inverse_depth)
    parts: list[Conditional] = [landmark_map]
    if config.velocity.mode == "marginal":
        parts.append(KalmanSubstate(SE3, np.zeros(6), np.diag(start_std(config.velocity) ** 2)))
    filter_ = Filter(
        motion,
        sensor or features,
        parts,
        config.proposal.build(),
        config.resampling.build(),
        config.particles,
        np.random.default_rng(config.seed),
        lag=config.lag,
    )
    if mapped is not None:
        add_known_points(landmark_map, mapped, config.particles)
    elif start is not None and config.known == "frame":
        add_constellation(landmark_map, features.camera, start, config)
    elif start is not None:
        add_known_points(landmark_map, start.points, config.particles)
    return filter_


def build_motion(config: VelocityConfig) -> MotionModel:
    """Constant velocity in one of the three modes."""
    walk = walk_std(config)
    if config.mode == "marginal":
        return MarginalVelocity(walk)
    return SampledVelocity(walk, config.mode, start_std(config))


def add_known_points(landmark_map: LandmarkMap, known: KnownPoints, n: int) -> None:
    """They enter once, with their σ, and are ordinary landmarks from then on."""
    mean = np.broadcast_to(known.positions, (n, *known.positions.shape))
    cov = np.broadcast_to(known.cov, (n, *known.cov.shape))
    ids = landmark_map.add_records(Records(mean, cov), Point(3))
    landmark_map.catalogue.update(zip(ids.tolist(), known.names.tolist(), strict=True))


def add_constellation(
    landmark_map: LandmarkMap, camera: Pinhole, start: KnownStart, config: MonoConfig
) -> None:
    """The known points as one landmark, as seen from the first camera."""
    records, group = first_records(camera, start, config.particles, start_cov(config))
    ids = landmark_map.add_records(records, group)
    landmark_map.catalogue[int(ids[0])] = CONSTELLATION


def world_of(filter_: Filter) -> Anchored | None:
    """The known points' frame in each particle's own world, which starts at its first camera; None without one."""
    held = _constellation(filter_)
    if held is None:
        return None
    group, records = held
    return Anchored(*group.frame(records))


def _constellation(filter_: Filter) -> tuple[Constellation | UncertainConstellation, Records] | None:
    """The known points' landmark and its records. It was the first one: no other one has to be asked."""
    landmark_map = filter_.belief().map
    first = next(iter(landmark_map.catalogue), None)
    if first is None or landmark_map.catalogue[first] != CONSTELLATION:
        return None
    return landmark_map.landmark_of(first), landmark_map.read(np.array([first]))


def start_prior(log: FeatureLog, config: MonoConfig) -> PosePrior:
    """Where the camera is at first, before the known points are measured: at the origin, exactly, unless they say it.

    The law is wide: the measurements of the first frame, not the resection, say where in it the camera is.

    Raises:
        InputError: fewer than four known points are seen in the first frame, or they do not determine the camera.
    """
    if log.known is None or config.known == "frame":
        return PosePrior(SE3.identity(), np.zeros((6, 6)))
    return PosePrior(_known_start(log).world_from_camera, start_cov(config))


def _known_start(log: FeatureLog) -> KnownStart:
    """What the first frame shows of the known points, and where its camera is."""
    assert isinstance(log.camera, Pinhole) and log.known is not None
    first = log.frames[0]
    inside = np.flatnonzero(log.camera.inside(first.z))
    _, rows, which = np.intersect1d(log.known.names, first.landmarks[inside], return_indices=True)
    k = inside[which]
    sight = FeatureFrame(first.stamp_ns, first.landmarks[k], first.z[k], first.cov_z[k])
    return KnownStart(log.known, resect(log.camera, log.known.positions[rows], sight.z), rows, sight)


def start_cov(config: MonoConfig) -> np.ndarray:
    """Covariance (6, 6) of the wide law of the start."""
    return np.diag(np.repeat([config.start_std_rad**2, config.start_std_m**2], 3))


def start_std(config: VelocityConfig) -> np.ndarray:
    """Standard deviation (6,) of a velocity of which nothing is known."""
    return np.repeat([config.start_rad_s, config.start_m_s], 3)


def walk_std(config: VelocityConfig) -> np.ndarray:
    """Standard deviation (6,) of the velocity's walk in one second, (rad/s, m/s)/√s."""
    return np.repeat([config.walk_rad_s, config.walk_m_s], 3)
