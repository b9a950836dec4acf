"""A robot whose heading is known, and that measures positions: a linear-Gaussian world for every optimiser."""

import numpy as np

from rbpf.lie import SE2
from rbpf.sensors.readers import Frame, RobotLog, Truth

TURN_STD = 1e-4
MOVE_STD, SEEN_STD = 0.1, 0.15


def linear_log(steps: int = 12, landmarks: int = 5, seed: int = 0) -> RobotLog:
    """Steps of half a metre along x; every landmark is seen in two of three steps."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([0.0, -3.0], [0.5 * steps, 3.0], (landmarks, 2))
    cov_delta = np.diag([TURN_STD, MOVE_STD, MOVE_STD]) ** 2
    at, path, frames = np.zeros(2), [], []
    for step in range(steps):
        delta = np.array([0.0, 0.5, 0.0])
        if step:
            at = at + delta[1:] + MOVE_STD * rng.normal(size=2)
        path.append(np.array([0.0, *at]))
        names = np.flatnonzero((rng.random(landmarks) < 2 / 3) | (step == 0))
        z = points[names] - at + SEEN_STD * rng.normal(size=(len(names), 2))
        cov = np.repeat(SEEN_STD**2 * np.eye(2)[None], len(names), axis=0)
        moved, cov_moved = (delta, cov_delta) if step else (None, None)
        frames.append(Frame(step, moved, cov_moved, names.astype(np.int64), z, cov))
    truth = Truth(np.arange(steps), np.array(path), dict(enumerate(points)))
    return RobotLog("linear world", SE2, "position", SE2.identity(), frames, truth=truth)
