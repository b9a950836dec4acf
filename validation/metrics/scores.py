"""Scores of a run against ground truth: positions at the run's own instants, with and without alignment."""

from dataclasses import dataclass

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import SE2Group, SE3Group
from rbpf.runs.trajectory import Trajectory
from rbpf.sensors.readers.log import RobotLog, Truth
from rbpf.validation.metrics.accuracy import ate, landmark_errors, rpe
from rbpf.validation.metrics.matching import match_points

LONGEST_GAP_NS = 500_000_000
"""Truth is interpolated between poses no further apart than this; an instant in a longer gap is not scored."""


@dataclass(frozen=True)
class Scores:
    """Errors of an estimate; metres and degrees, None where there is nothing to compare.

    Attributes:
        ate_rmse_m: positions after rigid alignment.
        path_rmse_m: positions without alignment.
        rpe_translation_rmse_m: motion from one scored instant to the next.
        rpe_rotation_rmse_deg: likewise.
        scored_instants: how many instants have a true pose.
        landmark_error_mean_m: landmarks without alignment.
        landmark_error_aligned_mean_m: landmarks after their own rigid alignment.
    """

    ate_rmse_m: float | None = None
    path_rmse_m: float | None = None
    rpe_translation_rmse_m: float | None = None
    rpe_rotation_rmse_deg: float | None = None
    scored_instants: int = 0
    landmark_error_mean_m: float | None = None
    landmark_error_aligned_mean_m: float | None = None


def as_trajectory(log: RobotLog, stamps_ns: np.ndarray, world_from_robot: np.ndarray) -> Trajectory:
    """Poses (T, E) of the log's group as a trajectory in space."""
    if isinstance(log.space, SE2Group):
        return Trajectory.from_planar(stamps_ns, world_from_robot)
    return Trajectory(stamps_ns, world_from_robot)


def truth_at(
    space: SE2Group | SE3Group, truth: Truth, stamps_ns: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Rows of `stamps_ns` that lie inside the truth, and the interpolated true poses there."""
    return poses_at(space, truth.stamps_ns, truth.world_from_robot, stamps_ns)


def poses_at(
    space: SE2Group | SE3Group, true_ns: np.ndarray, poses: np.ndarray, stamps_ns: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Rows of `stamps_ns` that lie inside true stamps (T,), and the interpolated true poses (T, E) there.

    Stamps that count steps are met exactly; between poses the geodesic is followed.
    """
    last = true_ns.size - 1
    after = np.searchsorted(true_ns, stamps_ns, side="left")
    exact = np.minimum(after, last)
    met = true_ns[exact] == stamps_ns
    before = np.clip(np.where(met, exact, after - 1), 0, last)
    after = np.clip(np.where(met, exact, after), 0, last)
    gap = true_ns[after] - true_ns[before]
    inside = (true_ns[before] <= stamps_ns) & (stamps_ns <= true_ns[after])
    rows = np.flatnonzero(met | (inside & (gap <= LONGEST_GAP_NS)))
    fraction = (stamps_ns[rows] - true_ns[before[rows]]) / np.maximum(gap[rows], 1)
    return rows, space.interpolate(poses[before[rows]], poses[after[rows]], fraction)


def score(
    log: RobotLog,
    world_from_robot: np.ndarray,
    landmarks: dict[int, np.ndarray] | None = None,
    anonymous: bool = False,
) -> Scores:
    """Scores poses (T, E) at the log's frames, and landmarks by the log's names.

    Args:
        log: the recording, with its truth.
        world_from_robot: (T, E) estimated poses.
        landmarks: name to (D,) position; None scores the path alone.
        anonymous: the names are the map's own; each landmark is scored as the true one nearest to it once the path
            is aligned, one to one.
    """
    if log.truth is None:
        return Scores()
    stamps = np.array([frame.stamp_ns for frame in log.frames])
    rows, true_poses = truth_at(log.space, log.truth, stamps)
    values: dict[str, float | int | None] = {"scored_instants": int(rows.size)}
    alignment = None
    if rows.size > 2:
        estimate = as_trajectory(log, stamps[rows], world_from_robot[rows])
        reference = as_trajectory(log, stamps[rows], true_poses)
        relative = rpe(estimate, reference)
        aligned = ate(estimate, reference, "rigid")
        alignment = aligned.alignment
        values |= {
            "ate_rmse_m": aligned.rmse,
            "path_rmse_m": ate(estimate, reference).rmse,
            "rpe_translation_rmse_m": relative.translation_rmse,
            "rpe_rotation_rmse_deg": relative.rotation_rmse_deg,
        }
    if landmarks and log.truth.landmarks:
        dim = 2 if isinstance(log.space, SE2Group) else 3
        truth = {name: point[:dim] for name, point in log.truth.landmarks.items()}
        if anonymous:
            landmarks = match_points(np.array(list(landmarks.values())), truth, alignment)
        try:
            values["landmark_error_mean_m"] = landmark_errors(landmarks, truth).mean
            values["landmark_error_aligned_mean_m"] = landmark_errors(landmarks, truth, "rigid").mean
        except InputError:
            return Scores(**values)  # type: ignore[arg-type]
    return Scores(**values)  # type: ignore[arg-type]
