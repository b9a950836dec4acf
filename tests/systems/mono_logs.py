"""Small simulated recordings of one camera, and parts of them."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from examples.studies.point_worlds import MONO, DeskWorld, Measuring, simulate_features
from rbpf.lie import SE3
from rbpf.runs.run import Run
from rbpf.runs.trajectory import Trajectory
from rbpf.sensors.feature_log import FeatureFrame, FeatureLog
from rbpf.systems.mono.config import MonoConfig
from rbpf.validation.metrics.accuracy import ate
from rbpf.validation.simulation.paths import HandHeld

SMALL = MonoConfig(particles=20, map="particles")


def desk(seed: int = 0, frames: int = 8, measurements: int = 12, **options: float) -> FeatureLog:
    """A hand-held camera over a desk, ten images a second."""
    world = DeskWorld(frames=frames, rate_hz=10.0, points=60, blocks=0, hand=HandHeld(start_s=0.1))
    measuring = Measuring(measurements=measurements, new_per_frame=2, **options)
    return simulate_features(world, measuring, MONO, seed)


def without_known(log: FeatureLog) -> FeatureLog:
    return replace(log, known=None)


def changed(log: FeatureLog, frame: int, change: Callable[[FeatureFrame], FeatureFrame]) -> FeatureLog:
    frames = [change(f) if t == frame else f for t, f in enumerate(log.frames)]
    return replace(log, frames=frames)


def rows(frame: FeatureFrame, keep: np.ndarray) -> FeatureFrame:
    """Some of a frame's measurements."""
    return replace(frame, landmarks=frame.landmarks[keep], z=frame.z[keep], cov_z=frame.cov_z[keep])


def errors(run: Run) -> np.ndarray:
    """(T, 6) of the online estimates in the charts at them."""
    truth = run.source.log.truth  # type: ignore[attr-defined]
    return SE3.local(run.log.poses, truth.poses)


def off(done_path: np.ndarray, truth: np.ndarray, stamps_ns: np.ndarray) -> float:
    """Error after an alignment with scale, m."""
    return ate(Trajectory(stamps_ns, done_path), Trajectory(stamps_ns, truth), "similarity").rmse


def nees(run: Run) -> np.ndarray:
    """(T,) normalised squared errors."""
    pairs = zip(errors(run), run.log.covs, strict=True)
    return np.array([error @ np.linalg.solve(cov, error) for error, cov in pairs])
