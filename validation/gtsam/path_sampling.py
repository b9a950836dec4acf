"""Whole paths and maps drawn from the batch's posterior, and the evidence of the measurements.

A draw is the solution of the least-squares problem, linearised at the optimum, with noise as residuals:
ξ = H⁻¹ Jᵀ η, η ~ N(0, I), with J its whitened Jacobian and H = JᵀJ, so that no root of H⁻¹ is needed (G. Papandreou,
A. Yuille, "Gaussian sampling by local perturbations", 2010). The weight of a draw, and where it follows the posterior more
closely than N(0, H⁻¹), are in Mathematics (batch-weight).

Motions are kept out of H, so that directions without noise need no care: with A their whitened derivatives and D the
identity, but zero for such directions, and J that of the observations,

    [ D    A  ] [ y ]   [ D η ]
    [ Aᵀ −JᵀJ ] [ ξ ] = [−Jᵀη']

whose determinant is that of H over the motions' own (up to sign).
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.sparse import block_array, bsr_array, csc_array, diags_array, hstack
from scipy.sparse.linalg import splu

from rbpf.lie import Array
from rbpf.sensors.readers.measurements import InitialEstimate, Measurements
from rbpf.validation.gtsam.robot import RobotProblem

DRAWS = 400
#: Rms nonlinearity of a motion's whitened noise, over the draws, from which on the motion itself is drawn.
BENT = 0.1
_BLOCK = 300_000  #: Number of observations predicted at once.


@final
@dataclass(frozen=True, eq=False)
class PosteriorDraws:
    """S weighted draws of a path of T poses and a map of L landmarks."""

    world_from_robot: Array  #: (S, T, E) poses.
    names: NDArray[np.int64]  #: (L,) names of the landmarks.
    landmarks: Array  #: (S, L, D) positions.
    log_ratio: Array  #: (S,) joint density of draw and measurements over the draw's own.

    @property
    def weights(self) -> Array:
        """(S,) normalised weights; resample by them for equally weighted draws."""
        ratio = np.exp(self.log_ratio - self.log_ratio.max())
        return np.asarray(ratio / ratio.sum())

    @property
    def log_evidence(self) -> float:
        """Log-evidence of the measurements, in nats."""
        return float(np.logaddexp.reduce(self.log_ratio)) - float(np.log(self.log_ratio.size))

    @property
    def error(self) -> float:
        """Standard error of the log-evidence, reliable if the effective sample size is large."""
        return float((self.weights * self.weights.size).std(ddof=1) / np.sqrt(self.weights.size))

    @property
    def ess(self) -> float:
        """Effective sample size: the equivalent number of draws from the posterior itself."""
        return float(1.0 / np.square(self.weights).sum())


def draw_posterior(m: Measurements, optimum: InitialEstimate, rng: Generator, draws: int = DRAWS) -> PosteriorDraws:
    """Draws S whole paths and maps, two or more, from the posterior of a robot's measurements, taken as Gaussian.

    `optimum` has poses (T, E) and the position of every landmark; far from the batch optimum the weights scatter.
    Raises InputError: a measurement's covariance is singular, or the optimum lacks something.
    """
    problem, path, size = RobotProblem(m), optimum.world_from_body, m.z.shape[1]
    places = np.array([optimum.landmarks[name] for name in problem.names.tolist()]).reshape(-1, size)
    # Derivatives of the whitened motions by all moves, of the whitened observations by the landmarks' and the poses'.
    dim, (ahead, back, _) = m.space.dim, _linear_noise(problem, path)
    along = problem.axes.mT / np.sqrt(np.where(problem.null, 1.0, problem.variances))[..., None]
    count = len(ahead)
    pairs = np.stack([-along @ back, along @ ahead], axis=1).reshape(-1, dim, dim)
    columns = np.stack([np.arange(count), np.arange(1, count + 1)], axis=1).ravel()
    # Columns of all poses, of which the first does not move.
    by_pose = bsr_array((pairs, columns, 2 * np.arange(count + 1)), shape=(dim * count, dim * (count + 1)))
    motions = hstack([csc_array((dim * count, places.size)), by_pose.tocsc()[:, dim:]], format="csc")
    slopes = problem.sensor.slopes(path[m.steps], places[problem.index])
    whiten, each = np.linalg.inv(np.linalg.cholesky(m.cov_z)), np.arange(len(m.z) + 1)
    robot = bsr_array((whiten @ slopes[0], m.steps, each), shape=(m.z.size, dim * len(path))).tocsc()[:, dim:]
    points = bsr_array((whiten @ slopes[1], problem.index, each), shape=(m.z.size, places.size)).tocsc()
    seen = hstack([points, robot], format="csc")
    # Moves ξ of the landmarks, then of the poses after the first.
    noisy = np.where(problem.null, 0.0, 1.0).ravel()
    system = block_array([[diags_array(noisy), motions], [motions.T, -(seen.T @ seen)]], format="csc")
    factor = splu(system)
    shaken = noisy[:, None] * rng.standard_normal((noisy.size, draws))
    moves = factor.solve(np.vstack([shaken, -(seen.T @ rng.standard_normal((seen.shape[0], draws)))]))[noisy.size :]
    squares = np.square(noisy[:, None] * (motions @ moves)).sum(axis=0) + np.square(seen @ moves).sum(axis=0)
    free = len(moves) - (noisy == 0.0).sum()
    log_draw = 0.5 * (np.log(np.abs(factor.U.diagonal())).sum() - squares - free * np.log(2.0 * np.pi))
    xi = np.zeros((draws, len(path), dim))
    xi[:, 1:] = moves[places.size :].T.reshape(draws, -1, dim)
    poses, log_motion = _driven(problem, path, xi)
    # Landmarks: their scatter about where the poses' moves would have them, and where the true residuals do.
    information = (points.T @ points).tobsr((size, size)).data

    def pulled(force: Array) -> Array:
        """How far forces (L D, s) move the landmarks, (s, L, D)."""
        return np.moveaxis(np.linalg.solve(information, force.reshape(*places.shape, force.shape[1])), -1, 0)

    linear = -pulled(points.T @ (seen[:, places.size :] @ moves[places.size :]))
    scatter = np.moveaxis(moves[: places.size].reshape(*places.shape, draws), -1, 0) - linear
    landmarks = places + linear
    for some, residual in _residuals(problem, poses, landmarks):
        landmarks[some] -= pulled(points.T @ residual)
    landmarks += scatter
    log_seen = np.full(draws, -0.5 * np.linalg.slogdet(2.0 * np.pi * m.cov_z)[1].sum())
    for some, residual in _residuals(problem, poses, landmarks):
        log_seen[some] -= 0.5 * np.square(residual).sum(axis=0)
    return PosteriorDraws(poses, problem.names, landmarks, log_motion + log_seen - _log_first(m) - log_draw)


def _linear_noise(problem: RobotProblem, path: Array) -> tuple[Array, Array, Array]:
    """The linear noise of every motion of a path, at + ahead ξ_t − back ξ_{t−1}: ahead, back and at."""
    m, space = problem.m, problem.m.space
    at = space.local(space.compose(path[:-1], m.deltas), path[1:])
    back = space.left_jacobian_inverse(at) @ space.adjoint(space.inverse(m.deltas))
    return space.right_jacobian_inverse(at), back, at


def _driven(problem: RobotProblem, path: Array, xi: Array) -> tuple[Array, Array]:
    """Poses (S, T, E) by the moves (S, T, d) of a path, and the log-density (S,) of their motions by the moves."""
    m, space, axes = problem.m, problem.m.space, problem.axes
    variances, noisy = np.where(problem.null, 1.0, problem.variances), ~problem.null
    poses = space.retract(path, xi)
    noise = space.local(space.compose(poses[:, :-1], m.deltas), poses[:, 1:])
    ahead, back, at = _linear_noise(problem, path)
    linear = at + np.einsum("tab,stb->sta", ahead, xi[:, 1:]) - np.einsum("tab,stb->sta", back, xi[:, :-1])
    # Motions that bend too much, or have a direction without noise: the linear part is the motion.
    bend = np.square(np.einsum("sta,tab->stb", noise - linear, axes)) / variances
    bound = problem.null.any(axis=1) | (bend.sum(axis=-1).mean(axis=0) > BENT**2)
    drawn = np.where(noisy, np.einsum("sta,tab->stb", linear, axes), 0.0)
    for t in np.flatnonzero(bound):
        poses[:, t + 1] = space.retract(space.compose(poses[:, t], m.deltas[t]), drawn[:, t] @ axes[t].T)
    # All others are as drawn, around the path.
    free = ~bound
    noise = space.local(space.compose(poses[:, :-1][:, free], m.deltas[free]), poses[:, 1:][:, free])
    drawn[:, free] = np.einsum("sta,tab->stb", noise, axes[free])
    out = -0.5 * (np.square(drawn) / variances + noisy * np.log(2.0 * np.pi * variances)).sum(axis=(1, 2))
    out += (_log_det(xi[:, 1:][:, free]) - _log_det(noise)).sum(axis=1) - _log_det(at[bound]).sum()
    return poses, out


def _log_det(xi: Array) -> Array:
    """Logarithm of |J_r(ξ)| of SE(2) and SE(3)."""
    turn, times = (xi[..., :1], 2) if xi.shape[-1] == 3 else (xi[..., :3], 4)
    return times * np.log(np.sinc(np.linalg.norm(turn, axis=-1) / (2.0 * np.pi)))


def _residuals(problem: RobotProblem, poses: Array, landmarks: Array) -> Iterator[tuple[slice, Array]]:
    """Whitened residuals (K p, s) of all observations, some draws at a time."""
    m, block = problem.m, max(1, _BLOCK // max(len(problem.m.z), 1))
    whiten = np.linalg.inv(np.linalg.cholesky(m.cov_z))
    for first in range(0, len(poses), block):
        some = slice(first, first + block)
        found = problem.sensor.residual(poses[some][:, m.steps], landmarks[some][:, problem.index], m.z)
        yield some, (whiten @ np.moveaxis(found, 0, -1)).reshape(m.z.size, len(found))


def _log_first(m: Measurements) -> float:
    """Σ log E|∂l/∂z| of the first sightings: E[r] in the plane, E[r² cos(pitch)] in space, and 1 of positions."""
    if m.measurement == "position" or not m.landmarks.size:
        return 0.0
    order = np.argsort(m.steps, kind="stable")
    first = order[np.unique(m.landmarks[order], return_index=True)[1]]
    z, cov = m.z[first], m.cov_z[first]
    if z.shape[1] == 2:
        return float(np.log(z[:, 0]).sum())
    swung = np.exp(1j * z[:, 2] - 0.5 * cov[:, 2, 2]) * ((z[:, 0] + 1j * cov[:, 0, 2]) ** 2 + cov[:, 0, 0])
    return float(np.log(swung.real).sum())
