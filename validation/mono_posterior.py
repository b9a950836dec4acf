"""The posterior over whole trajectories at the end of a run: every particle's path along its ancestors."""

from pathlib import Path

import numpy as np

from rbpf.core.checkpoint import save_arrays
from rbpf.lie import SE3
from rbpf.runs.trajectory import Trajectory, write_tum
from rbpf.systems.mono.slam import world_of
from rbpf.systems.mono.video import VideoRun

PATHS, MEAN = "posterior.npz", "posterior.tum"


def posterior_paths(run: VideoRun) -> np.ndarray:
    """(T, N, 7) world_from_camera of each particle of the last frame along its ancestors, in the reported world.

    With `MonoConfig.lag` those of the last frames. Where there are known points, each particle's path is told from
    its own mean of their world's place.
    """
    paths, world = run.filter.history.paths()[..., :7], world_of(run.filter)
    return paths if world is None else SE3.between(world.mean, paths)


def write_posterior(run: VideoRun, out: Path) -> None:
    """posterior.npz with all paths and the particles' log-weights, posterior.tum with their weighted mean."""
    paths, log_weights = posterior_paths(run), run.filter.particles.log_weights
    stamps_ns = run.filter.history.stamps_ns
    arrays = {"stamps_ns": stamps_ns, "world_from_camera": paths, "log_weights": log_weights}
    save_arrays(out / PATHS, arrays)
    weights = np.exp(log_weights)
    mean = np.array([SE3.mean(poses, weights) for poses in paths])
    write_tum(out / MEAN, Trajectory(stamps_ns, mean))
