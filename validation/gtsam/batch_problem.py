"""The batch problem of any run: its measurements, from memory or from its folder; the optimum; their likelihood.

Range-bearing measurements are those of `rbpf.sensors.readers.measurements`, a camera's are a `FeatureLog`.
"""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from typing import final

import numpy as np
from numpy.typing import NDArray

from rbpf.errors import InputError
from rbpf.lie import Array
from rbpf.runs.reading import PathAndMap
from rbpf.sensors.camera import RectifiedStereo
from rbpf.sensors.feature_log import FeatureLog, KnownPoints
from rbpf.sensors.readers.measurements import InitialEstimate, Measurements
from rbpf.systems.map_estimate import MapEstimate
from rbpf.validation.gtsam import robot
from rbpf.validation.gtsam.camera import solve_features
from rbpf.validation.gtsam.observations import in_one_piece, observation_table, reprojection
from rbpf.validation.gtsam.solvers import BatchSolution
from rbpf.validation.metrics.gaussian_differences import mahalanobis

Problem = Measurements | FeatureLog
OnIteration = Callable[[int, float], None]  #: Called before each iteration, with its number and the error.
LEAST = 4  #: Least landmarks of a frame, known or shared with other frames: three leave several poses.
#: Exact known points get errors of this fraction of their extent, as constraints take GTSAM far longer.
SOFTENED = 1e-4
#: Number of linearised observations, over all iterations, after which an adjustment is given up: some minutes of work.
#: Work is counted instead of time, so that results do not depend on the machine's load.
WORK = 30_000_000
LEAST_ITERATIONS = 100  #: Iterations allowed for any number of observations.
#: Relative gain that ends the adjustment. Landmarks with little parallax creep on: a thousand times as exact moves the path
#: of `mono_redkitchen_a` by 6 µm (rms; 0.02 standard deviations at most), in six times as many iterations.
TOLERANCE = 1e-6
AFAR = 300  #: Steps from which a robot's batch is initialised incrementally.


@final
@dataclass(frozen=True, eq=False)
class Optimum:
    """The batch optimum of a problem."""

    problem: Problem  #: the solved problem: the connected part.
    #: path and map with marginal covariances; only landmarks determined by the measurements. If not all variables are
    #: determined, poses have no covariances and those of landmarks are NaN.
    estimate: PathAndMap
    steps: NDArray[np.intp]  #: (B,) steps of the run that took part, one per pose.
    error: float  #: half the sum of squared whitened residuals, or the sum of their robust losses.

    @property
    def start(self) -> InitialEstimate:
        """Initial values for a further solver."""
        return InitialEstimate(self.estimate.world_from_body, self.estimate.landmarks.named())


def floats_in_scale(problem: Problem) -> bool:
    """Whether the scale is not measured: one camera without known points."""
    return isinstance(problem, FeatureLog) and problem.known is None and not isinstance(problem.camera, RectifiedStereo)


def solve_problem(
    problem: Problem,
    start: Array,
    robust: float | None = None,
    most: int | None = None,
    on_iteration: OnIteration | None = None,
    marginals: bool = True,
    twice: bool = True,
) -> Optimum:
    """GTSAM's optimum of a robot's run, or of all frames of a camera's run that landmarks connect with the first one.

    A camera's adjustment is initialised at `start` (T, E), poses of the filter, a robot's at its odometry. With `twice`
    and known points it is also initialised at these with the filter's motions, and the better optimum is taken, so that
    it does not depend on the filter's path; not needed near the optimum. `robust` is Huber's threshold in standard
    deviations; None is Gaussian, as in the filter. A camera's adjustment is given up after `most` iterations, by default
    as many as `WORK` allows; `on_iteration` is called before each, with its number and the error. Without `marginals`
    poses have no covariances, and those of landmarks are NaN.

    Raises InputError: the measurements do not determine everything, too few frames are connected, it takes too many
    iterations, or it does not converge.
    """
    if not isinstance(problem, FeatureLog):
        steps = np.arange(len(problem.stamps_ns))
        return _optimum(problem, robot.solve(problem, robust, marginals, incremental=steps.size > AFAR), steps)
    log, frames = problem, connected_frames(problem)
    if frames.size < 2:
        raise InputError(f"{log.name}: no two frames share the {LEAST} landmarks that a batch adjustment needs of each")
    part = replace(log, frames=[log.frames[t] for t in frames], known=softened(log.known))
    size = sum(frame.landmarks.size for frame in part.frames)
    limit = max(LEAST_ITERATIONS, WORK // max(size, 1)) if most is None else most
    iterations = count(1)

    def watch(error: float) -> None:
        done = next(iterations)
        if on_iteration is not None:
            on_iteration(done, error)
        if done > limit:
            raise InputError(f"batch adjustment given up after {limit} iterations: allow more with --batch-limit")

    solve = partial(solve_features, part, robust=robust, on_iteration=watch, tolerance=TOLERANCE)
    # A start that fails is ignored if another one succeeds.
    solutions, problems = [], []
    first = InitialEstimate(start[frames], {})
    for from_known in [False, True] if twice and log.known is not None else [False]:
        try:
            solutions.append(solve(first, from_known=from_known, marginals=False))
        except InputError as error:
            problems.append(error)
    if not solutions:
        raise problems[-1]
    found = min(solutions, key=lambda solution: solution.error)
    if marginals:
        with suppress(InputError):  # no covariances if not all is determined
            found = solve(InitialEstimate(found.world_from_body, found.landmarks))
    return _optimum(replace(part, known=log.known), found, frames)


def fit_of(problem: Problem, estimate: PathAndMap, names: NDArray[np.int64]) -> dict[str, float]:
    """Fit of an estimate's own poses and landmarks to the observations of the named landmarks.

    Σ log N(z − h(x̂, m̂); 0, R) [nats], root mean square of a whitened residual per measured number, number of
    observations.
    """
    places = estimate.landmarks.named()
    if isinstance(problem, FeatureLog):
        table = observation_table(problem)
        table = table.rows(np.isin(table.names, names)[table.index])
        points = np.array([places[name] for name in table.names.tolist()]).reshape(-1, 3)
        residuals, cov = reprojection(table, estimate.world_from_body, points)[0], table.cov_z
    else:
        rows, model = np.flatnonzero(np.isin(problem.landmarks, names)), problem.model()
        size = problem.z.shape[1]
        points = np.array([places[name] for name in problem.landmarks[rows].tolist()]).reshape(-1, size)
        predicted = model.predict(estimate.world_from_body[problem.steps[rows]], points)
        residuals, cov = model.residual(problem.z[rows], predicted), problem.cov_z[rows]
    square = np.square(mahalanobis(residuals, cov))
    log_norm = np.linalg.slogdet(2.0 * np.pi * cov)[1]
    rms = float(np.sqrt(square.sum() / max(residuals.size, 1)))
    log_likelihood = float(-0.5 * (square + log_norm).sum())
    return {"log_likelihood": log_likelihood, "rms_sigmas": rms, "sightings": len(residuals)}


def softened(known: KnownPoints | None) -> KnownPoints | None:
    """The known points, with small errors if they are exact."""
    if known is None or known.cov.any():
        return known
    extent = float(np.ptp(known.positions, axis=0).max())
    return replace(known, cov=np.tile((SOFTENED * extent) ** 2 * np.eye(3), (known.names.size, 1, 1)))


def connected_frames(log: FeatureLog) -> NDArray[np.intp]:
    """Frames (B,) that can be adjusted together with the first one, or with most of the others.

    Each observes `LEAST` landmarks that are known or observed in another of them, and they are connected by these.
    """
    counts = np.array([frame.landmarks.size for frame in log.frames])
    steps = np.repeat(np.arange(counts.size), counts)
    names, index = np.unique(np.concatenate([f.landmarks for f in log.frames]), return_inverse=True)
    known = np.isin(names, () if log.known is None else log.known.names)
    kept = np.ones(counts.size, dtype=bool)
    while True:
        rows = kept[steps]
        shared = known | (np.bincount(index[rows], minlength=names.size) > 1)
        rows &= shared[index]
        enough = np.bincount(steps[rows], minlength=counts.size) >= LEAST
        now = kept & enough & in_one_piece(steps[rows], index[rows], counts.size, known)
        if (now == kept).all() or not now.any():
            return np.flatnonzero(now)
        kept = now


def _optimum(problem: Problem, found: BatchSolution, steps: NDArray[np.intp]) -> Optimum:
    names = sorted(found.landmarks.keys() - set(found.undetermined))
    dim = 3 if isinstance(problem, FeatureLog) else problem.z.shape[1]
    unknown = np.full((dim, dim), np.nan)
    points = MapEstimate(
        np.array(names, dtype=np.int64),
        np.array([found.landmarks[name] for name in names]).reshape(-1, dim),
        np.array([found.cov_landmarks.get(name, unknown) for name in names]).reshape(-1, dim, dim),
    )
    estimate = PathAndMap(problem.stamps_ns, found.world_from_body, found.cov_poses, points)
    return Optimum(problem, estimate, steps, found.error)
