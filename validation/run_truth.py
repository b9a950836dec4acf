"""Ground truth of recordings, at the steps of a run and, where that can be said exactly, in the filter's own world."""

import numpy as np

from rbpf.lie import SE2Group
from rbpf.runs.truth import RunTruth
from rbpf.sensors.range_bearing import RelativePosition
from rbpf.sensors.readers.log import RobotLog
from rbpf.validation.metrics.scores import truth_at


def robot_truth(log: RobotLog) -> RunTruth | None:
    """The truth of a log relative to its first true pose, where the filter's world begins.

    Without a true pose of the first step only an alignment brings the two together.
    """
    if log.truth is None:
        return None
    space = log.space
    rows, poses = truth_at(space, log.truth, np.array([frame.stamp_ns for frame in log.frames]))
    dim = 2 if isinstance(space, SE2Group) else 3
    landmarks = {name: np.asarray(point, dtype=float)[:dim] for name, point in log.truth.landmarks.items()}
    if not rows.size or rows[0] != 0:
        return RunTruth(rows, poses, landmarks, "rigid")
    model, start = RelativePosition(space), poses[0]
    moved = {name: model.predict(start, point) for name, point in landmarks.items()}
    return RunTruth(rows, space.between(start, poses), moved, "none")
