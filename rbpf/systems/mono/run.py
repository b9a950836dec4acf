"""Takes a log of features through `MonoSlam`, and gathers what it reports."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rbpf.core.filter import Filter, StepReport
from rbpf.core.models import Sensor
from rbpf.errors import InputError
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.feature_log import FeatureLog
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.mono.slam import MonoSlam
from rbpf.systems.mono.slam import particle_points as landmark_cloud  # noqa: F401


@dataclass
class MonoRun:
    """A finished run; T frames.

    Attributes:
        log: what was filtered.
        config: with what settings.
        filter: in its final state.
        stamps_ns: (T,).
        world_from_camera: (T, 7) online filtered mean, in the world of the known points, else of the first camera; the
            frames of a start without known points are revised at its end, when there is a scale to report them in.
        cov: (T, 6, 6) of it in the right chart at the mean, order [ω, v].
        ess: (T,) effective sample size before resampling.
        resampled: (T,) bool.
        log_evidence: (T,) increments.
        nis: (T,) normalised innovation squared.
        rows: (T,) its degrees of freedom.
        seconds: (T,) time of the frame.
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
    wrapped: Callable[[Sensor], Sensor] | None = None,
) -> MonoRun:
    """Filters a whole log.

    Args:
        log: of one camera.
        config: all settings.
        on_step: called after each frame with its number, the filter and what the step did.
        wrapped: see `MonoSlam`.

    Raises:
        InputError: the log or a setting does not fit, or no particle explains the observations.
    """
    if not isinstance(log.camera, Pinhole):
        raise InputError(f"{log.name}: monocular SLAM needs a log of one camera, this is a stereo log")
    slam = MonoSlam(log.camera, config, log.known, wrapped=wrapped)
    total = len(log.frames)
    numbers = [np.zeros(total) for _ in range(6)]
    stamps = np.array([frame.stamp_ns for frame in log.frames], dtype=np.int64)
    done = MonoRun(log, config, slam.filter, stamps, np.zeros((total, 7)), np.zeros((total, 6, 6)), *numbers)
    for t, frame in enumerate(log.frames):
        started = time.perf_counter()
        tracked = slam.take(frame)
        done.seconds[t] = time.perf_counter() - started
        done.world_from_camera[t], done.cov[t] = tracked.pose, tracked.cov
        if tracked.revision is not None:
            done.world_from_camera[: t + 1] = tracked.revision.poses
            done.cov[: t + 1] = tracked.revision.covs
        for name in ("ess", "resampled", "log_evidence", "nis"):
            getattr(done, name)[t] = tracked.values[name]
        done.rows[t] = tracked.values["nis_dof"]
        done.filter = slam.filter
        if on_step is not None:
            assert slam.report is not None
            on_step(t, slam.filter, slam.report)
    return done
