"""Deliberate faults: what a filter is told wrongly, to see whether its verdict notices."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from rbpf.lie import SE2
from rbpf.sensors.readers.log import Frame, RobotLog


def scale_sensor_noise(log: RobotLog, factor: float) -> RobotLog:
    """Claims standard deviations of all sightings that are `factor` times the right ones."""
    return _changed(log, lambda frame: replace(frame, cov_z=factor**2 * frame.cov_z))


def scale_odometry_noise(log: RobotLog, factor: float) -> RobotLog:
    """Claims standard deviations of all motions that are `factor` times the right ones."""

    def change(frame: Frame) -> Frame:
        return frame if frame.cov_delta is None else replace(frame, cov_delta=factor**2 * frame.cov_delta)

    return _changed(log, change)


def bias_odometry(log: RobotLog, sigmas: float) -> RobotLog:
    """Adds a constant forward motion of so many of its standard deviations to each step's odometry."""
    forward = 1 if log.space.dim == SE2.dim else 3

    def change(frame: Frame) -> Frame:
        if frame.delta is None or frame.cov_delta is None:
            return frame
        shift = np.zeros(log.space.dim)
        shift[forward] = sigmas * np.sqrt(frame.cov_delta[forward, forward])
        return replace(frame, delta=log.space.retract(frame.delta, shift))

    return _changed(log, change)


def swap_names(log: RobotLog, fraction: float, rng: np.random.Generator) -> RobotLog:
    """Gives a fraction of the sightings the name of another landmark, one that is not seen in the same step."""
    every = np.unique(np.concatenate([frame.landmarks for frame in log.frames]))

    def change(frame: Frame) -> Frame:
        names = frame.landmarks.copy()
        for k in np.flatnonzero(rng.random(names.size) < fraction):
            names[k] = rng.choice(np.setdiff1d(every, names))
        return replace(frame, landmarks=names)

    return _changed(log, change)


def _changed(log: RobotLog, change: Callable[[Frame], Frame]) -> RobotLog:
    return replace(log, frames=[change(frame) for frame in log.frames])
