"""Runs the filter over a log of features, and tells the results in the known points' world."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from rbpf.core.anchoring import Anchored, relative_estimate
from rbpf.core.estimate import Estimate, mixture_estimate
from rbpf.core.filter import Filter, StepReport
from rbpf.core.models import Sensor
from rbpf.core.particles import uniform_log_weights
from rbpf.core.proposals import Prior
from rbpf.lie import SE3
from rbpf.sensors.feature_log import FeatureLog
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.mono.feature_sensor import FeatureSensor
from rbpf.systems.mono.system import assemble, features_of, start_prior, world_of
from rbpf.systems.mono.unknown_start import UnknownStart


@dataclass
class MonoRun:
    """A finished run; T frames.

    Attributes:
        log: what was filtered.
        config: with what settings.
        filter: in its final state.
        stamps_ns: (T,).
        world_from_camera: (T, 7) online filtered mean, in the world of the known points, else of the first camera; the
            frames of a start without known points are told anew at its end, when there is a scale to tell them in.
        cov: (T, 6, 6) of it in the right chart at the mean, order [ω, v].
        ess: (T,) effective sample size before resampling.
        resampled: (T,) bool.
        log_evidence: (T,) increments.
        nis: (T,) normalised innovation squared.
        rows: (T,) its degrees of freedom.
        seconds: (T,) time of the filter's step.
    """

    log: FeatureLog
    config: MonoConfig
    filter: Filter
    stamps_ns: np.ndarray
    world_from_camera: np.ndarray
    cov: np.ndarray
    ess: np.ndarray
    resampled: np.ndarray
    log_evidence: np.ndarray
    nis: np.ndarray
    rows: np.ndarray
    seconds: np.ndarray


def run(
    log: FeatureLog,
    config: MonoConfig,
    on_step: Callable[[int, Filter, StepReport], None] | None = None,
    wrapped: Callable[[FeatureSensor], Sensor] | None = None,
) -> MonoRun:
    """Filters a whole log.

    Args:
        log: of one camera.
        config: all settings.
        on_step: called after each frame with its number, the filter and what the step did.
        wrapped: puts a sensor around the usual one, see `build_filter`; the particles are then not drawn anew at a
            start without known points, which would not be what that sensor observes.

    Raises:
        InputError: the log or a setting does not fit, or no particle explains the observations.
    """
    features, known = features_of(log, config)
    filter_ = assemble(config, features, known, None if wrapped is None else wrapped(features))
    start = UnknownStart(config, needed=log.known is None and wrapped is None)
    control = start_prior(log, config)
    total = len(log.frames)
    numbers = [np.zeros(total) for _ in range(6)]
    stamps = np.array([frame.stamp_ns for frame in log.frames], dtype=np.int64)
    done = MonoRun(log, config, filter_, stamps, np.zeros((total, 7)), np.zeros((total, 6, 6)), *numbers)
    for t, frame in enumerate(log.frames):
        started = time.perf_counter()
        report = filter_.step(frame, control if t == 0 else None, frame.stamp_ns)
        estimate = pose_estimate(filter_, report)
        done.world_from_camera[t], done.cov[t] = estimate.mean, estimate.cov
        if start.due(t + 1, lost=False):
            path = done.world_from_camera[: t + 1]
            drawn = start.redrawn(filter_, features, log.frames[: t + 1], path)
            if drawn is not None:
                done.filter = filter_ = drawn[0]
                done.world_from_camera[: t + 1], done.cov[: t + 1] = told_anew(drawn[1])
        done.seconds[t] = time.perf_counter() - started
        done.ess[t], done.resampled[t], done.log_evidence[t] = (
            report.ess,
            report.resampled,
            report.log_evidence,
        )
        done.nis[t], done.rows[t] = report.nis, report.rows
        if on_step is not None:
            on_step(t, filter_, report)
    return done


def pose_estimate(filter_: Filter, report: StepReport) -> Estimate:
    """Mean and covariance of world_from_camera after a step.

    With known points it is that of the samples, each with its own uncertain world: the pose and the world's place are
    correlated before sampling. Without them it is that of the refined mixture.
    """
    return estimate_in(world_of(filter_), filter_, report)


def told_anew(paths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Means (T, 7) and covariances (T, 6, 6) of paths (T, N, 7) of equal weight."""
    log_weights = uniform_log_weights(paths.shape[1])
    told = [mixture_estimate(Prior.exactly(SE3, poses), None, log_weights) for poses in paths]
    return np.array([each.mean for each in told]), np.array([each.cov for each in told])


def estimate_in(world: Anchored | None, filter_: Filter, report: StepReport) -> Estimate:
    """The same, where the known points' frame is has been asked already."""
    if world is None:
        return Estimate(report.estimate.mean[:7], report.estimate.cov[:6, :6])
    particles = filter_.particles
    return relative_estimate(SE3, world, particles.state[:, :7], particles.log_weights)


def landmark_cloud(filter_: Filter, ids: Sequence[int]) -> np.ndarray:
    """Each particle's own mean of point landmarks (N, K, 3), in the world of the known points."""
    points = filter_.belief().read(np.asarray(ids)).mean
    world = world_of(filter_)
    return points if world is None else SE3.inverse_transform(world.mean[:, None], points)
