"""Conversion of GTSAM's poses, optimisation loops over its factor graphs, and marginal covariances at the optimum.

Pose2 has the tangent [v, ω], Pose3 [ω, v]. In GTSAM 4.3 both retract by the exponential map on the right, so
only the order differs from ours, and a BetweenFactor's residual is Log(δ⁻¹ x⁻¹ y) with exact derivatives.
The tests check this for the installed build.

The loops are here because GTSAM's own optimisers copy all values at every call of a factor written in
Python, a hundred times the cost; linearisation, elimination and retraction are GTSAM's.
"""

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, final

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import bsr_array, csc_array

from rbpf.errors import InputError
from rbpf.lie import Array
from rbpf.validation.gtsam.observations import Residuals

ROUGH = 1e-4  #: Fraction of the error that still counts as progress far from the optimum.
EXACT = 1e-11  #: The same near the optimum.
ITERATIONS = 200  #: Maximum iterations.
OnMisfit = Callable[[float], None]  #: Called before each iteration, with the current error.
_DAMPING = 1e-5
_MIN_DAMPING = 1e-10
_MAX_DAMPING = 1e10
MOST_POSES = 1_500  #: Maximum poses for covariances from the dense reduced system: 9,000 unknowns, 650 MB.
_POSE, _POINT = 6, 3
_SYMBOL = re.compile(r"\(Symbol: ([xl])(\d+)\)")


@final
@dataclass(frozen=True, eq=False)
class BatchSolution:
    """Most probable trajectory and map, with covariances from the Gauss-Newton Hessian there."""

    world_from_body: Array  #: (T, E) poses, of a robot or of a (left) camera.
    landmarks: dict[int, Array]  #: name of each adjusted landmark to its (D,) position [m].
    cov_poses: Array  #: (T, d, d) marginal covariances in the right chart, order [omega, v]; no rows if not asked for.
    cov_landmarks: dict[int, Array]  #: name of each landmark to its (D, D) marginal covariance; empty if not asked for.
    #: half the sum of squared whitened residuals, or the sum of their robust losses. Where the noise is right about
    #: half the number of measured scalars less half that of the landmarks' coordinates.
    error: float
    #: for cameras, ascending: names of landmarks that the measurements do not determine: those observed in one frame by a
    #: single camera, and those drawn into their camera by an outlier, which are both left out, and those of undetermined
    #: depth for lack of parallax, which have a weak prior.
    undetermined: Sequence[int] = ()


@final
@dataclass(frozen=True)
class Chart:
    """GTSAM's representation of the poses of a group."""

    order: NDArray[np.intp]  #: (d,) GTSAM's tangent is ours[order].
    pose: Callable[[Array], Any]  #: our storage (E,) to GTSAM's object.
    storage: Callable[[Any, int], Array]  #: values and key to our storage (E,).
    point: Callable[[Any, int], Array]  #: values and key to a landmark (D,).
    between: type  #: class of the native odometry factor.
    prior: type  #: class of the factor that holds the start.


def _storage2(values: Any, key: int) -> Array:
    pose = values.atPose2(key)
    return np.array([pose.theta(), pose.x(), pose.y()])


def _storage3(values: Any, key: int) -> Array:
    pose = values.atPose3(key)
    return np.concatenate([pose.rotation().toQuaternion().coeffs(), pose.translation()])


PLANAR = Chart(
    order=np.array([1, 2, 0]),
    pose=lambda x: gtsam.Pose2(x[1], x[2], x[0]),
    storage=_storage2,
    point=gtsam.Values.atPoint2,
    between=gtsam.BetweenFactorPose2,
    prior=gtsam.PriorFactorPose2,
)
SPATIAL = Chart(
    order=np.arange(6),
    pose=lambda x: gtsam.Pose3(gtsam.Rot3.Quaternion(x[3], x[0], x[1], x[2]), x[4:]),
    storage=_storage3,
    point=gtsam.Values.atPoint3,
    between=gtsam.BetweenFactorPose3,
    prior=gtsam.PriorFactorPose3,
)


@contextmanager
def explaining(name: str, pose: str, landmarks: NDArray[np.int64], advice: str) -> Iterator[None]:
    """GTSAM's complaint about a recording as an InputError in words, with the variable that it names.

    `pose` is the recording's word for the step of a pose, `landmarks` are the landmarks' names in order of the keys; `advice`
    is appended.
    """
    try:
        yield
    except RuntimeError as error:
        symbol = _SYMBOL.search(str(error))
        if symbol is None:
            raise InputError(f"GTSAM could not solve {name}: {' '.join(str(error).split())}") from error
        where = f"landmark {landmarks[int(symbol[2])]}" if symbol[1] == "l" else f"{pose} {symbol[2]}"
        problem = f"the measurements do not determine everything near {where}"
        raise InputError(f"GTSAM could not solve {name}: {problem}; {advice}.") from error


def noise(cov: Array) -> Any:
    """Gaussian noise of a positive definite covariance."""
    # False, because GTSAM's search for diagonal matrices drops every covariance below 1e-8.
    return gtsam.noiseModel.Gaussian.Covariance(cov, False)


def huber(base: Any, threshold: float | None) -> Any:
    """Huber's loss on the norm of the whitened residual, in standard deviations; None leaves it Gaussian."""
    if threshold is None:
        return base
    if not threshold > 0:
        raise InputError(f"Expected a robust threshold above 0 standard deviations, found {threshold}.")
    return gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(threshold), base)


def together(evaluate: Callable[[Any], Residuals]) -> Callable[[int, list[int], Any], Any]:
    """Makes factors by row, keys and noise; the first evaluated one computes the residuals of all, which are cached.

    GTSAM passes the same values object to every factor as long as Python holds it, as the loops below do. An optimiser that
    changes its values in place, such as ISAM2, would get outdated residuals.
    """
    held: Any = None
    found: Residuals = np.empty(0), []

    def factor(row: int, keys: list[int], model: Any) -> Any:
        def error(factor: Any, values: Any, jacobians: Any) -> Array:
            nonlocal held, found
            if values is not held:
                held, found = values, evaluate(values)
            residuals, slopes = found
            if jacobians is not None:
                for place, slope in enumerate(slopes):
                    jacobians[place] = slope[row]
            return residuals[row]

        return gtsam.CustomFactor(model, keys, error)

    return factor


def levenberg_marquardt(
    graph: Any, values: Any, tolerance: float, iterations: int = ITERATIONS, on_iteration: OnMisfit | None = None
) -> tuple[Any, int, bool]:
    """Damped Gauss-Newton from some values; returns the values, the number of iterations, and whether it converged.

    It ends when the relative gain of a step is below `tolerance`. `on_iteration` is called with the error before
    each iteration; its exceptions end the optimisation.
    """
    error, damping = graph.error(values), _DAMPING
    for count in range(1, iterations + 1):
        if on_iteration is not None:
            on_iteration(error)
        linear, slack = graph.linearize(values), tolerance * max(1.0, error)
        while damping <= _MAX_DAMPING:
            damped, zero = gtsam.GaussianFactorGraph(), values.zeroVectors()
            damped.push_back(linear)
            for key in values.keys():  # noqa: SIM118, no mapping
                dim = len(zero.at(key))
                unit, root = gtsam.noiseModel.Unit.Create(dim), np.sqrt(damping) * np.eye(dim)
                damped.push_back(gtsam.JacobianFactor(key, root, np.zeros(dim), unit))
            moved = _step(damped, values)
            before, after = error, graph.error(moved)
            if after <= before + slack:
                break
            damping *= 10
        else:
            return values, count, False
        values, error = moved, after
        if before - after <= slack:
            return values, count, True
        damping = max(damping / 10, _MIN_DAMPING)
    return values, iterations, False


def gauss_newton(graph: Any, values: Any) -> tuple[Any, int, bool]:
    """Full steps, all accepted: while converging to hard constraints the error may rise. See `levenberg_marquardt`."""
    error = graph.error(values)
    for count in range(1, ITERATIONS + 1):
        before, values = error, _step(graph.linearize(values), values)
        error = graph.error(values)
        if abs(before - error) <= EXACT * max(1.0, before):
            return values, count, True
    return values, ITERATIONS, False


def marginals(graph: Any, values: Any, keys: Iterable[int]) -> list[Array]:
    """Marginal covariance of each key at the values, from one elimination of the whole graph.

    The conditionals' own square roots are used, because a constrained variable has no information matrix.
    """
    linear = graph.linearize(values)
    tree = linear.eliminateMultifrontal(gtsam.Ordering.ColamdGaussianFactorGraph(linear), gtsam.EliminateQR)

    def marginal(key: int) -> Array:
        conditional = tree.marginalFactor(key, gtsam.EliminateQR)
        factor = np.linalg.inv(conditional.R()) * conditional.get_model().sigmas()
        return np.asarray(factor @ factor.T)

    return [marginal(key) for key in keys]


def marginals_by_schur(
    graph: Any, values: Any, poses: list[int], points: list[int], held: list[int], name: str
) -> tuple[Array, Array]:
    """Covariances (P, 6, 6) of poses and (L, 3, 3) of points from the poses' reduced system; zero for fixed variables.

    Landmarks are coupled only through the poses. With the information matrix in blocks

        H = [ H_pp  H_pl ]      S = H_pp − H_pl H_ll⁻¹ H_lp,     Σ_pp = S⁻¹
            [ H_lp  H_ll ]      Σ_ll = H_ll⁻¹ + H_ll⁻¹ H_lp Σ_pp H_pl H_ll⁻¹

    H_ll is block-diagonal, so a landmark costs the square of the number of poses that observe it. (B. Triggs et al., "Bundle
    adjustment: a modern synthesis", 2000, §6.) The information matrix squares the condition number: this is for problems with
    a measured scale, not for those in which a stiff prior fixes it.

    The graph of a recording has only factors between P poses and L points, some of which are fixed by hard constraints.
    Raises InputError: the measurements do not determine all variables.
    """
    undetermined = InputError(
        f"The measurements of {name} do not determine all poses and landmarks, so that they have no covariance; "
        "add known points, or leave out what is seen too seldom."
    )
    # The whitened Jacobian J by the free keys in ascending order, in columns of poses and of points.
    sizes = dict.fromkeys(poses, _POSE) | dict.fromkeys(points, _POINT)
    keys = sorted(sizes)
    widths = [sizes[key] for key in keys]
    free = [key for key in keys if key not in held]
    rows, columns, entries = graph.linearize(values).sparseJacobian_()
    kept = np.append(np.repeat(np.isin(keys, free), widths), False)  # the last column is the residual
    inside = kept[columns.astype(int) - 1]
    at = rows[inside].astype(int) - 1, columns[inside].astype(int) - 1
    jacobian = csc_array((entries[inside], at), shape=(int(rows.max()), sum(widths)))[:, kept[:-1]]
    is_pose = np.repeat([sizes[key] == _POSE for key in free], [sizes[key] for key in free])
    of_poses, of_points = jacobian[:, is_pose], jacobian[:, ~is_pose]
    # H_ll and its inverse by blocks, S, and S⁻¹ scaled to a diagonal of ones.
    blocks, count = (of_points.T @ of_points).tobsr((_POINT, _POINT)), of_points.shape[1] // _POINT
    if len(blocks.data) < count:
        raise undetermined
    try:
        inverse = np.linalg.inv(blocks.data)
        seen = csc_array(of_points.T @ of_poses)
        weights = csc_array(bsr_array((inverse, blocks.indices, blocks.indptr), shape=blocks.shape) @ seen)
        reduced = (of_poses.T @ of_poses).toarray() - (seen.T @ weights).toarray()
        diagonal = np.diagonal(reduced)
        if not (diagonal > 0.0).all():
            raise undetermined
        scale = 1.0 / np.sqrt(diagonal)
        factor = cho_factor(scale[:, None] * reduced * scale, lower=True)
    except np.linalg.LinAlgError as error:
        raise undetermined from error
    cov = np.asarray(scale[:, None] * cho_solve(factor, np.eye(len(reduced))) * scale)
    of_each, by_row = np.empty((count, _POINT, _POINT)), weights.tocsr()
    for index in range(count):
        part = by_row[_POINT * index : _POINT * (index + 1)]
        used = np.unique(part.indices)
        dense = part[:, used].toarray()
        of_each[index] = inverse[index] + dense @ cov[np.ix_(used, used)] @ dense.T
    every = np.arange(len(cov) // _POSE)
    of_every = cov.reshape(every.size, _POSE, -1, _POSE)[every, :, every]
    cov_poses, cov_points = np.zeros((len(poses), _POSE, _POSE)), np.zeros((len(points), _POINT, _POINT))
    # The columns are in the order of the keys.
    for out, given, covs in ((cov_poses, poses, of_every), (cov_points, points, of_each)):
        out[[row for row in np.argsort(given).tolist() if given[row] not in held]] = covs
    return cov_poses, cov_points


def _step(linear: Any, values: Any) -> Any:
    # Cholesky is seven times as fast as QR, but GTSAM's refuses neighbours whose standard deviations differ by a
    # factor above 4096.
    ordering = gtsam.Ordering.ColamdGaussianFactorGraph(linear)
    try:
        return values.retract(linear.optimize(ordering))
    except RuntimeError:
        return values.retract(linear.optimize(ordering, gtsam.EliminateQR))
