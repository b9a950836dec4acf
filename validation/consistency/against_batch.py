"""Comparison of a run with the batch optimum of the same measurements: path, map, covariances, likelihood.

Frame and chart. Both are given in the run's own world. A pose's covariance is transformed from the chart at the filter's
pose to that at the optimum's: with δ = Log(T_b⁻¹ T_f), P ← J_r⁻¹(δ) P J_r⁻ᵀ(δ).

Conditioning. The map and the last pose use the same measurements in filter and batch, and are compared as Gaussians; earlier
online poses use only past measurements, see `rbpf.validation.consistency.statistic.posterior_ratio`.

Check of the posterior. The importance weights of draws from a robot's batch posterior (`rbpf.validation.gtsam.path_sampling`)
tell whether it is the Gaussian with which filter and covariances are compared.

Gauge. One camera without known points does not measure the scale: the filter's is that of its prior, the batch's is fixed.
Both start at the same first pose; the filter is scaled about it so that its path fits the optimum's best, and densities are
compared in scale-invariant directions: perpendicular to the line from the first camera (two of a landmark's three, five of a
pose's six).
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import Array
from rbpf.runs.reading import PathAndMap, RunFolder
from rbpf.runs.run import Run
from rbpf.sensors.feature_log import FeatureLog
from rbpf.validation.consistency.comparison import RESIDUALS, Comparison, distance
from rbpf.validation.consistency.statistic import NOISE_FACTOR, Statistic, posterior_ratio, variance_ratio
from rbpf.validation.gtsam.batch_problem import OnIteration, Optimum, Problem, fit_of, floats_in_scale, solve_problem
from rbpf.validation.gtsam.observations import HUBER
from rbpf.validation.gtsam.path_sampling import draw_posterior
from rbpf.validation.gtsam.stated import DOUBTFUL, measured_calibration
from rbpf.validation.metrics import gaussian_differences as gaussians
from rbpf.validation.metrics.accuracy import AbsoluteError, ate

POSES, LANDMARKS = "poses against the batch optimum", "landmarks against the batch optimum"
LEAST_STEPS = 3  #: Least steps of a run for a comparison.
DRAWS = 200  #: Number of paths and maps drawn from a robot's batch posterior.
LEAST_COUNT = 0.1  #: Least effective fraction of them for the posterior to be used as reference.
SAME = "one world: nothing to fix"
SCALED = "the filter scaled about the first camera onto the optimum; densities across the line from that camera"


@final
@dataclass(frozen=True, eq=False)
class AgainstBatch:
    """A run and its batch optimum."""

    name: str  #: of the recording.
    gauge: str  #: description of the alignment of the two worlds.
    scale: float  #: factor applied to the filter; 1 if the scale is measured.
    filter: PathAndMap  #: the run, in that scale.
    optimum: Optimum  #: the batch.
    path: AbsoluteError  #: distances of the filter's online positions from the optimum's, per step, without alignment.
    landmarks: gaussians.Differences  #: Gaussians of the map.
    poses: gaussians.Differences  #: Gaussians of the last pose; none without covariances.
    #: fit of the observations of common landmarks, see `fit_of`, by the filter's online poses and its last map.
    fit_filter: dict[str, float]
    fit_batch: dict[str, float]  #: by the optimum.

    @property
    def ours(self) -> PathAndMap:
        """The filter at the steps of the optimum."""
        return self.filter.at(self.optimum.steps)

    def statistics(self) -> list[Statistic]:
        """Consistency statistics of poses and landmarks, with the batch's posterior instead of the truth."""
        both = self.landmarks
        poses = posterior_ratio(POSES, *self.pose_errors())
        landmarks = posterior_ratio(LANDMARKS, both.cov, both.cov_other, both.delta, same_data=True)
        return [statistic for statistic in (poses, landmarks) if statistic is not None]

    def pose_errors(self) -> tuple[Array, Array, Array]:
        """Of B steps the filter's covariances (B, d, d), the batch's, and its poses from the filter's (B, d).

        All in the chart at the filter's poses; none where the optimum has no covariances.
        """
        ours, theirs = self.ours, self.optimum.estimate
        delta = ours.space.local(ours.world_from_body, theirs.world_from_body)
        if not (len(theirs.cov_poses) and len(ours.cov_poses)):
            return ours.cov_poses[:0], ours.cov_poses[:0], delta[:0]
        carry = ours.space.right_jacobian_inverse(delta)
        found = ours.cov_poses, np.asarray(carry @ theirs.cov_poses @ carry.mT), delta
        if self.gauge == SAME:
            return found
        basis = gaussians.across_of(gaussians.away_from_first(ours.world_from_body))
        own, batch, apart = (gaussians.projected(basis, part) for part in found)
        return own, batch, apart


def compare_run(run: Run) -> AgainstBatch:
    """Compares a run in memory with its batch optimum; see `compare`."""
    return compare(PathAndMap.of_run(run), run.system.measurements(run.name, run.log))


def compare_folder(folder: Path) -> AgainstBatch:
    """Compares a run with its batch optimum; see `compare`. The folder must be that of a finished run of this version."""
    record = RunFolder.open(folder)
    return compare(record.estimate, record.measurements)


def compare(filtered: PathAndMap, problem: Problem, optimum: Optimum | None = None) -> AgainstBatch:
    """Compares a filter's path and map, T poses, with the batch optimum of the same T measurements.

    If it is not given, it is solved for with Gaussian errors, as in the filter. Raises InputError: path
    and measurements are not of one run, or the batch cannot be solved.
    """
    name, stamps = problem.name if isinstance(problem, FeatureLog) else problem.recording, problem.stamps_ns
    if len(stamps) != len(filtered.stamps_ns) or (stamps != filtered.stamps_ns).any():
        raise InputError(f"{name}: path and measurements do not share their time stamps; take both from one run.")
    if len(stamps) < LEAST_STEPS:
        raise InputError(f"{name} has {len(stamps)} steps, expected {LEAST_STEPS} or more to compare with a batch.")
    if optimum is None:
        optimum = solve_problem(problem, filtered.world_from_body)
    floats = floats_in_scale(problem)
    scaled, scale = filtered, 1.0
    if floats:
        scaled, scale = gaussians.scaled_onto(filtered, optimum.steps, optimum.estimate, name)
    shared = np.intersect1d(scaled.landmarks.ids, optimum.estimate.landmarks.ids)
    ours = scaled.at(optimum.steps)
    return AgainstBatch(
        name=name,
        gauge=SCALED if floats else SAME,
        scale=scale,
        filter=scaled,
        optimum=optimum,
        path=ate(ours.trajectory, optimum.estimate.trajectory),
        landmarks=gaussians.compare_maps(ours, optimum.estimate, floats),
        poses=gaussians.compare_last_pose(ours, optimum.estimate, int(optimum.steps[-1]), floats),
        fit_filter=fit_of(optimum.problem, ours, shared),
        fit_batch=fit_of(optimum.problem, optimum.estimate, shared),
    )


def solve_run(record: RunFolder, most: int | None = None, on_iteration: OnIteration | None = None) -> Optimum:
    """The batch optimum of a run's measurements: with Huber's loss for matches in images, which include false ones.

    `most`, `on_iteration` and errors as of `solve_problem`.
    """
    robust = HUBER if isinstance(record.measurements, FeatureLog) else None
    return solve_problem(record.measurements, record.path.world_from_body, robust, most, on_iteration)


def compare_with_batch(record: RunFolder, optimum: Optimum | None = None) -> tuple[Comparison, AgainstBatch]:
    """Comparison with the batch posterior of the same measurements, from `solve_run` if not given; errors as of that."""
    problem = record.measurements
    found = compare(record.estimate, problem, optimum=optimum or solve_run(record))
    figures: dict[str, Any] = {
        "gauge": found.gauge,
        "scale": found.scale,
        "filter_minus_batch_rmse_m": found.path.rmse,
        "filter_minus_batch_max_m": found.path.max,
        "path_spread_m": found.optimum.estimate.trajectory.spread,
        "batch_error": found.optimum.error,
    }
    statistics, said = found.statistics(), ""
    if not isinstance(problem, FeatureLog):
        residuals = problem.z.size - found.optimum.estimate.landmarks.mean.size
        figures["batch_error_right"] = 0.5 * residuals
        # Outliers of the run are not informative about the noise of the rest.
        likelihood = record.config.get("likelihood")
        if residuals > 0 and not (isinstance(likelihood, dict) and likelihood.get("kind") == "outliers"):
            value = 2.0 * found.optimum.error / residuals
            statistics.insert(0, variance_ratio(RESIDUALS, value, residuals, NOISE_FACTOR))
        draws = draw_posterior(problem, found.optimum.start, np.random.default_rng(0), DRAWS)
        names = "log_evidence_batch", "log_evidence_batch_error", "posterior_draws_ess"
        values = draws.log_evidence, draws.error, draws.ess
        figures |= {name: value for name, value in zip(names, values, strict=True) if np.isfinite(value)}
        if not draws.ess >= LEAST_COUNT * DRAWS:
            statistics = [s for s in statistics if s.name not in (POSES, LANDMARKS)]
            said = (
                f"; that posterior is not Gaussian (of {DRAWS} draws from its Gaussian {draws.ess:.0f} count), so that it is "
                "no witness of the uncertainty"
            )
    accuracy = f"The path is {distance(found.path.rmse)} (rms) from the batch optimum of the same measurements"
    calibration = [one for one in measured_calibration(found.optimum) if np.isfinite(one.std)]
    figures |= {f"{one.name}, measured": one.found for one in calibration}
    figures |= {f"{one.name}, standard deviation": one.std for one in calibration}
    for one in calibration:
        if one.apart > DOUBTFUL:
            ends, zone = (one.apart - DOUBTFUL, one.apart + DOUBTFUL), (-np.inf, DOUBTFUL)
            statistics.append(Statistic(one.said, one.apart, *ends, zone, 1.0, "calibration"))
    # Single numbers of the Gaussians for the page; the rows behind them are `AgainstBatch.as_dict`'s.
    for name, rows in (("landmarks", found.landmarks), ("poses", found.poses)):
        figures |= {f"{name}_{key}": value for key, value in rows.as_dict().items() if not isinstance(value, list)}
    for name, fit in (("filter", found.fit_filter), ("batch", found.fit_batch)):
        figures |= {f"{name}_{key}": value for key, value in fit.items()}
    return Comparison("gtsam", f"{accuracy}{said}.", figures, statistics), found
