"""Single runs in simulated worlds, and what each says about the filter's honesty: the parts of a Monte-Carlo test."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from rbpf.core.diagnostics import ancestors_by_step, coalescence_steps
from rbpf.core.filter import Filter
from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.sensors.readers import open_log
from rbpf.sensors.readers.log import RobotLog
from rbpf.systems.map_estimate import MapEstimate, estimate_map
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.mono.run import run as run_mono
from rbpf.systems.range_bearing.config import RangeBearingConfig
from rbpf.systems.range_bearing.run import run as run_robot
from rbpf.validation.camera_map import summarise_points
from rbpf.validation.consistency.pose_errors import whitened_errors
from rbpf.validation.run_truth import robot_truth
from rbpf.validation.simulation.features import MONO, Measuring, simulate_features
from rbpf.validation.simulation.point_worlds import DeskWorld
from rbpf.validation.simulation.robot import RobotWorld, simulate_robot


@dataclass(frozen=True)
class Trial:
    """One run; T steps, M landmarks.

    Attributes:
        dim: degrees of freedom of the pose, d.
        distances: (T,) errors of the position, m, without alignment.
        nees: (T,) of the pose; NaN where the filter holds it to be known exactly.
        nis: (T,) normalised innovation squared;  nis_dof: (T,) its degrees of freedom.
        landmark_nees: (M,) of the landmarks at the end;  landmark_dim: degrees of freedom of one.
        ancestors: (T,) how many particles of each step still have descendants at the end.
        coalescence: steps back from the end to the latest ancestor that all particles share; None where there is none.
        log_evidence: of the whole run.
    """

    dim: int
    distances: np.ndarray
    nees: np.ndarray
    nis: np.ndarray
    nis_dof: np.ndarray
    landmark_nees: np.ndarray
    landmark_dim: int
    ancestors: np.ndarray
    coalescence: int | None
    log_evidence: float


@dataclass(frozen=True)
class RobotTrial:
    """Range-bearing SLAM in a simulated world; call it with a seed of world and filter.

    Attributes:
        world: what is simulated.
        config: of the filter.
        spoil: changes what the filter is given, after the simulation; None changes nothing.
    """

    world: RobotWorld
    config: RangeBearingConfig
    spoil: Callable[[RobotLog, np.random.Generator], RobotLog] | None = None

    def __call__(self, seed: int) -> Trial:
        """Simulates and filters."""
        log = simulated_log(self.world, seed)
        truth = robot_truth(log)
        assert truth is not None
        given = log if self.spoil is None else self.spoil(log, np.random.default_rng(seed))
        done = run_robot(given, replace(self.config, seed=seed))
        progress, found = done.progress, estimate_map(done.filter, done.anchored)
        errors = whitened_errors(log.space, progress.mean, progress.cov, truth.poses)
        return Trial(
            log.space.dim,
            np.linalg.norm(
                progress.mean[:, -found.mean.shape[1] :] - truth.poses[:, -found.mean.shape[1] :], axis=1
            ),
            np.where(errors.ranks > 0, errors.nees, np.nan),
            progress.nis,
            progress.rows,
            _landmark_nees(found, truth.landmarks),
            found.mean.shape[1],
            *_genealogy(done.filter),
        )


@dataclass(frozen=True)
class DeskTrial:
    """Monocular SLAM on simulated features; call it with a seed of world and filter.

    Attributes:
        world: what is simulated.
        config: of the filter.
        measuring: how it is measured.
    """

    world: DeskWorld
    config: MonoConfig
    measuring: Measuring = field(default_factory=Measuring)

    def __post_init__(self) -> None:
        """Errors are told without alignment, which takes known points.

        Raises:
            InputError: there are fewer than four.
        """
        if self.measuring.known < 4:
            raise InputError(
                f"a trial needs 4 known points or more to tell errors in one world, got {self.measuring.known}"
            )

    def __call__(self, seed: int) -> Trial:
        """Simulates and filters."""
        log = simulate_features(self.world, self.measuring, MONO, seed)
        assert log.truth is not None
        done = run_mono(log, replace(self.config, seed=seed))
        true = log.truth.world_from_camera
        errors = whitened_errors(SE3, done.world_from_camera, done.cov, true)
        return Trial(
            6,
            np.linalg.norm(SE3.translation(done.world_from_camera) - SE3.translation(true), axis=1),
            np.where(errors.ranks > 0, errors.nees, np.nan),
            done.nis,
            done.rows,
            _landmark_nees(summarise_points(done.filter), log.truth.landmarks),
            3,
            *_genealogy(done.filter),
        )


def simulated_log(world: RobotWorld, seed: int) -> RobotLog:
    """The log of a simulated world, without leaving files."""
    with TemporaryDirectory() as name:
        simulate_robot(world, Path(name), seed)
        return open_log(name)


def _landmark_nees(found: MapEstimate, truth: dict[int, np.ndarray]) -> np.ndarray:
    known = np.array([name in truth for name in found.ids.tolist()], dtype=bool)
    error = np.array([truth[name] for name in found.ids[known].tolist()]).reshape(-1, found.mean.shape[1])
    error = error - found.mean[known]
    return np.einsum("md,mde,me->m", error, np.linalg.pinv(found.cov[known], hermitian=True), error)


def _genealogy(filter_: Filter) -> tuple[np.ndarray, int | None, float]:
    return ancestors_by_step(filter_.history), coalescence_steps(filter_.history), filter_.log_evidence
