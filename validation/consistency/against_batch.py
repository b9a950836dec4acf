"""A run beside the batch optimum of the same measurements: path, map, covariances, likelihood.

Frame and chart. Both are given in the run's own world. A pose's covariance is carried from the chart at the filter's
pose to that at the optimum's: with δ = Log(T_b⁻¹ T_f), P ← J_r⁻¹(δ) P J_r⁻ᵀ(δ).

What is conditioned on what. The map and the last pose know the same measurements in filter and batch. An earlier online
pose knows its past only, the optimum's also its future: poses are therefore compared, at a few instants, with the
optimum of what had been measured until then.

Gauge. One camera without known points does not measure the scale: the filter's is its prior's, the batch's is held.
Both begin at the same first pose; the filter is scaled about it, so that its path fits the optimum's best, and
densities are compared in the directions that a change of scale does not move: across the line from the first camera
(two of a landmark's three, five of a pose's six).
"""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, final

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import Array
from rbpf.runs.reading import PathAndMap, RunFolder
from rbpf.runs.run import Run
from rbpf.validation.gtsam.batch_problem import (
    Fit,
    Optimum,
    Problem,
    first_steps,
    fit_of,
    floats_in_scale,
    name_of,
    problem_of,
    read_problem,
    solve_problem,
    stamps_of,
)
from rbpf.validation.metrics.accuracy import AbsoluteError, ate
from rbpf.validation.metrics.gaussian_differences import (
    Differences,
    compare_last_pose,
    compare_maps,
    joined,
    no_differences,
    rescaled,
    scale_onto,
)

INSTANTS = 3
"""At how many instants poses are compared, the last one among them."""

MOST_ITERATIONS = 150
"""Of the batch at an earlier instant; where landmarks are still too far off to settle, that instant is left out."""

LEAST_STEPS = 3
"""Of a run that is compared."""

SAME = "one world: nothing to fix"
SCALED = (
    "the filter scaled about the first camera onto the optimum; densities across the line from that camera"
)


@final
@dataclass(frozen=True, eq=False)
class AgainstBatch:
    """A run beside its batch optimum.

    Attributes:
        name: of the recording.
        gauge: how the two worlds were made one, in words.
        scale: by which the filter was multiplied; 1 where the scale is measured.
        filter: the run, in that scale.
        optimum: the batch.
        path: distances of the filter's online positions from the optimum's, per step, without alignment.
        landmarks: Gaussians of the map.
        poses: Gaussians of the poses at a few instants; none where the covariances are not known.
        fit_filter: of the observations of landmarks that both have, by the filter's online poses and its last map.
        fit_batch: by the optimum.
    """

    name: str
    gauge: str
    scale: float
    filter: PathAndMap
    optimum: Optimum
    path: AbsoluteError
    landmarks: Differences
    poses: Differences
    fit_filter: Fit
    fit_batch: Fit

    def as_dict(self) -> dict[str, Any]:
        """Everything for JSON."""
        return {
            "recording": self.name,
            "gauge": self.gauge,
            "scale": self.scale,
            "steps": len(self.path.keys),
            "path_rmse_m": self.path.rmse,
            "path_max_m": self.path.max,
            "path_distances_m": self.path.distances.tolist(),
            "landmarks": self.landmarks.as_dict(),
            "poses": self.poses.as_dict(),
            "fit_filter": asdict(self.fit_filter),
            "fit_batch": asdict(self.fit_batch),
            "batch_error": self.optimum.error,
        }


def compare_run(run: Run, instants: int = INSTANTS, robust: float | None = None) -> AgainstBatch:
    """A run in memory beside its batch optimum; see `compare`."""
    return compare(PathAndMap.of_run(run), problem_of(run), instants, robust)


def compare_folder(folder: Path, instants: int = INSTANTS, robust: float | None = None) -> AgainstBatch:
    """A run folder beside its batch optimum; see `compare`.

    Raises:
        InputError: also if the folder is not that of a finished run of this version.
    """
    return compare(RunFolder.open(folder).estimate, read_problem(folder), instants, robust)


def compare(
    filtered: PathAndMap,
    problem: Problem,
    instants: int = INSTANTS,
    robust: float | None = None,
    optimum: Optimum | None = None,
) -> AgainstBatch:
    """A filter's path and map beside the batch optimum of the same measurements.

    Args:
        filtered: T poses, one per step of the problem.
        problem: the measurements.
        instants: at how many poses are compared, each with a batch of its own; 0 compares none.
        robust: Huber's threshold of the batch in standard deviations; None takes all as Gaussian, as the filter does.
        optimum: of the whole problem, with covariances, where it is known already.

    Raises:
        InputError: path and measurements are not of one run, or the batch cannot be solved.
    """
    name = name_of(problem)
    _require_one_run(filtered, problem)
    if optimum is None:
        optimum = solve_problem(problem, filtered.world_from_body, robust)
    floats = floats_in_scale(problem)
    scale = scale_onto(filtered.at(optimum.steps), optimum.estimate, name) if floats else 1.0
    scaled = rescaled(filtered, scale)
    shared = np.intersect1d(scaled.landmarks.ids, optimum.estimate.landmarks.ids)
    ours = scaled.at(optimum.steps)
    return AgainstBatch(
        name=name,
        gauge=SCALED if floats else SAME,
        scale=scale,
        filter=scaled,
        optimum=optimum,
        path=ate(ours.trajectory, optimum.estimate.trajectory),
        landmarks=compare_maps(ours, optimum.estimate, floats),
        poses=_compare_poses(filtered, problem, optimum, instants, robust),
        fit_filter=fit_of(optimum.problem, ours, shared),
        fit_batch=fit_of(optimum.problem, optimum.estimate, shared),
    )


def _compare_poses(
    filtered: PathAndMap, problem: Problem, optimum: Optimum, instants: int, robust: float | None
) -> Differences:
    """Online poses beside the last ones of the optima of what had been measured until then."""
    floats, last = floats_in_scale(problem), int(optimum.steps[-1])
    start = filtered.world_from_body.copy()
    start[optimum.steps] = optimum.estimate.world_from_body  # nearer than the filter's own path
    if not len(filtered.cov_poses) or instants < 1:
        return no_differences(filtered.space.dim)
    parts = []
    for step in np.unique(np.linspace(0, last, instants + 1).astype(int)[1:]).tolist():
        then = optimum if step == last else _until(problem, step, start, robust)
        if then is not None and int(then.steps[-1]) == step:
            ours = filtered.at(then.steps)
            scale = scale_onto(ours, then.estimate, name_of(problem)) if floats else 1.0
            parts.append(compare_last_pose(rescaled(ours, scale), then.estimate, step, floats))
    return joined(parts, filtered.space.dim)


def _until(problem: Problem, step: int, start: Array, robust: float | None) -> Optimum | None:
    """The optimum of what had been measured until then; None where so little does not determine one."""
    try:
        part = first_steps(problem, step + 1)
        return solve_problem(part, start[: step + 1], robust, most_iterations=MOST_ITERATIONS)
    except InputError:
        return None


def _require_one_run(filtered: PathAndMap, problem: Problem) -> None:
    stamps, name = stamps_of(problem), name_of(problem)
    if len(stamps) != len(filtered.stamps_ns) or (stamps != filtered.stamps_ns).any():
        raise InputError(
            f"{name}: path and measurements do not share their time stamps; take both from one run."
        )
    if len(stamps) < LEAST_STEPS:
        raise InputError(
            f"{name} has {len(stamps)} steps, expected {LEAST_STEPS} or more to compare with a batch."
        )
