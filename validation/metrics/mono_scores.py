"""The true path of a stereo pair at the instants of a run."""

from dataclasses import dataclass

import numpy as np

from rbpf.lie import SE3
from rbpf.runs.truth import poses_at
from rbpf.sensors.feature_log import CameraTruth

LEAST = 3
"""Instants with a true pose that an alignment needs."""


@dataclass(frozen=True)
class TruePath:
    """The truth at the run's own instants.

    Attributes:
        rows: (R,) frames of the run that have a true pose.
        world_from_camera: (R, 7).
    """

    rows: np.ndarray
    world_from_camera: np.ndarray


def true_path(truth: CameraTruth | None, stamps_ns: np.ndarray) -> TruePath | None:
    """The truth interpolated at stamps (T,); None where there is too little of it."""
    if truth is None:
        return None
    rows, poses = poses_at(SE3, truth.stamps_ns, truth.world_from_camera, stamps_ns)
    return TruePath(rows, poses) if rows.size >= LEAST else None
