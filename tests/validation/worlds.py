"""Small worlds with a tilted sensor, and their batch solution by SciPy in another parametrisation."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple, Self

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import OptimizeResult, least_squares

from rbpf import gaussian
from rbpf.lie import SE2, SE3, Array
from rbpf.runs.trajectory import Trajectory
from rbpf.sensors.readers import Frame, RobotLog, Truth
from rbpf.sensors.readers.measurements import Kind, Measurements
from rbpf.validation.gtsam.solvers import BatchSolution

Index = NDArray[np.int64]

NAMES = np.array([41, 7, 1000, 12, 3, 26])
MOTION = {2: np.array([0.25, 0.5, 0.0]), 3: np.array([0.05, 0.1, 0.25, 0.5, 0.0, 0.0])}
MOUNT = {2: np.array([2.4, 0.3, -0.2]), 3: SE3.exp(np.array([0.2, 0.5, 2.4, 0.3, -0.2, 0.4]))}


def world(
    dim: int,
    kind: Kind,
    singular: bool = False,
    steps: int = 7,
    noise: float = 1.0,
    seed: int = 0,
    winding: bool = False,
) -> Measurements:
    """A drive of half a metre per step among six landmarks, seen by a sensor that looks back and down.
    Bearings cross ±π. With `singular` one direction of motion, not along an axis, is without noise; `noise`
    multiplies all standard deviations. It turns alike all the way unless it is `winding`."""
    rng = np.random.default_rng(seed)
    m, path = _drive(dim, kind, singular, steps, noise, rng, winding)
    points = m.space.translation(path).mean(0) + rng.normal(scale=3.0, size=(len(NAMES), dim))
    at, which = (x.ravel() for x in np.indices((steps, len(NAMES))))
    kept = np.sort(rng.permutation(len(at))[: 4 * len(at) // 5])
    factor = noise * (np.tril(rng.normal(scale=0.02, size=(len(kept), dim, dim))) + 0.03 * np.eye(dim))
    errors = np.einsum("kij,kj->ki", factor, rng.normal(size=(len(kept), dim)))
    z = m.model().predict(path[at[kept]], points[which[kept]]) + errors
    return seen(m, at[kept], NAMES[which[kept]], z, factor @ factor.mT)


def _drive(
    dim: int, kind: Kind, singular: bool, steps: int, noise: float, rng: np.random.Generator, winding: bool
) -> tuple[Measurements, Array]:
    space, d = (SE2, 3) if dim == 2 else (SE3, 6)
    std = np.full(d, 0.03 * noise)
    std[-1] = 0.0 if singular else 0.02 * noise
    turned = space.adjoint(space.exp(0.5 * MOTION[dim]))
    path, deltas = [space.exp(np.linspace(-0.4, 0.9, d))], []
    for slip in rng.normal(size=(steps - 1, d)) * std @ turned.T:
        deltas.append(space.exp(MOTION[dim] * rng.uniform(0.6, 1.4, d if winding else 1)))
        path.append(space.retract(space.compose(path[-1], deltas[-1]), slip))
    cov = gaussian.symmetrise(turned @ np.diag(std**2) @ turned.T)
    m = Measurements(
        recording="small world",
        space=space,
        measurement=kind,
        pitch_sign=-1.0,
        robot_from_sensor=MOUNT[dim],
        start=path[0],
        stamps_ns=1_700_000_000_123_456_789 + 100_000_000 * np.arange(steps),
        deltas=np.array(deltas),
        covs=np.broadcast_to(cov, (steps - 1, d, d)),
        steps=np.empty(0, dtype=int),
        landmarks=np.empty(0, dtype=int),
        z=np.empty((0, dim)),
        cov_z=np.empty((0, dim, dim)),
    )
    return m, np.array(path)


def seen(m: Measurements, steps: Index, landmarks: Index, z: Array, cov_z: Array) -> Measurements:
    """The same drive with other sightings."""
    return replace(m, steps=steps, landmarks=landmarks, z=z, cov_z=cov_z)


class Reference(NamedTuple):
    """Optimum and covariances as in a `BatchSolution`, landmarks in the order of their names."""

    world_from_body: Array
    landmarks: Array
    cov_poses: Array
    cov_landmarks: Array
    error: float

    @classmethod
    def of(
        cls, found: OptimizeResult, slope: Array, space: Any, path_of: Callable[[Array], Array], places: Array
    ) -> Self:
        """By the residuals' slope at the optimum, whose last parameters say where the landmarks (L, D) are."""
        cov, path, size = np.linalg.inv(slope.T @ slope), path_of(found.x), places.size
        spread = slope_of(lambda x: space.local(path, path_of(x)).reshape(len(x), -1), found.x)
        spread = spread.reshape(len(path), space.dim, -1)
        blocks = cov[-size:, -size:].reshape(*places.shape, *places.shape)
        cov_landmarks = np.array([blocks[i, :, i] for i in range(len(places))])
        return cls(path, places, spread @ cov @ spread.mT, cov_landmarks, float(found.cost))


def solve_by_scipy(m: Measurements, robust: float | None = None) -> Reference:
    """Least squares over the odometry's noises w, x_t = x_{t-1} δ Exp(L w): singular ones need no care."""
    names = np.unique(m.landmarks)
    place = np.searchsorted(names, m.landmarks)
    factors = np.array([_thin_factor(cov) for cov in m.covs])
    split = len(factors) * factors.shape[-1]
    model, whiten = m.model(), np.linalg.inv(np.linalg.cholesky(m.cov_z))

    def path_of(x: Array) -> Array:
        lead = x.shape[:-1]
        path = [np.broadcast_to(m.start, (*lead, m.start.size))]
        noises = np.moveaxis(x[..., :split].reshape(*lead, len(factors), -1), -2, 0)
        for delta, factor, noise in zip(m.deltas, factors, noises, strict=True):
            path.append(m.space.retract(m.space.compose(path[-1], delta), noise @ factor.T))
        return np.stack(path, axis=-2)

    def sightings(x: Array) -> Array:
        points = x[..., split:].reshape(*x.shape[:-1], len(names), -1)
        predicted = model.predict(path_of(x)[..., m.steps, :], points[..., place, :])
        return np.einsum("kij,...kj->...ki", whiten, model.residual(m.z, predicted))

    def residuals(x: Array) -> Array:
        seen = shrunk(sightings(x), robust).reshape(*x.shape[:-1], -1)
        return np.concatenate([x[..., :split], seen], axis=-1)

    first = [np.flatnonzero(m.landmarks == name)[0] for name in names]
    start = path_of(np.zeros(split))
    x0 = np.concatenate([np.zeros(split), model.invert(start[m.steps[first]], m.z[first]).ravel()])
    found = least_squares(
        residuals, x0, lambda x: slope_of(residuals, x), xtol=1e-15, ftol=1e-15, gtol=1e-15, max_nfev=300
    )
    slope = slope_of(residuals, found.x) if robust is None else found.jac
    return Reference.of(found, slope, m.space, path_of, found.x[split:].reshape(len(names), -1))


def _thin_factor(cov: Array) -> Array:
    values, vectors = np.linalg.eigh(cov)
    kept = values > 1e-12 * values[-1]
    return vectors[:, kept] * np.sqrt(values[kept])


# A robot whose heading is known, and that measures positions: a linear-Gaussian world for every optimiser.

TURN_STD = 1e-4
MOVE_STD, SEEN_STD = 0.1, 0.15


def linear_log(steps: int = 12, landmarks: int = 5, seed: int = 0) -> RobotLog:
    """Steps of half a metre along x; every landmark is seen in two of three steps."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([0.0, -3.0], [0.5 * steps, 3.0], (landmarks, 2))
    cov_delta = np.diag([TURN_STD, MOVE_STD, MOVE_STD]) ** 2
    at, path, frames = np.zeros(2), [], []
    for step in range(steps):
        delta = np.array([0.0, 0.5, 0.0])
        if step:
            at = at + delta[1:] + MOVE_STD * rng.normal(size=2)
        path.append(np.array([0.0, *at]))
        names = np.flatnonzero((rng.random(landmarks) < 2 / 3) | (step == 0))
        z = points[names] - at + SEEN_STD * rng.normal(size=(len(names), 2))
        cov = np.repeat(SEEN_STD**2 * np.eye(2)[None], len(names), axis=0)
        moved, cov_moved = (delta, cov_delta) if step else (None, None)
        frames.append(Frame(step, moved, cov_moved, names.astype(np.int64), z, cov))
    truth = Truth(np.arange(steps), np.array(path), dict(enumerate(points)))
    return RobotLog("linear world", SE2, "position", SE2.identity(), frames, truth=truth)


# Numeric derivatives and robust weights that the tests of batch optimisers compare with.


def slope_of(function: Callable[[np.ndarray], np.ndarray], x: np.ndarray, step: float = 1e-5) -> np.ndarray:
    """∂function/∂x (m, n) by central differences, of a function (…, n) → (…, m) of many places at once."""
    moves = step * np.eye(len(x))
    return ((function(x + moves) - function(x - moves)) / (2 * step)).T


def shrunk(whitened: np.ndarray, robust: float | None) -> np.ndarray:
    """Residuals (…, p) of which half the square is Huber's loss with this bound; None leaves them."""
    if robust is None:
        return whitened
    norm = np.linalg.norm(whitened, axis=-1, keepdims=True)
    beyond = np.maximum(norm, robust)
    return whitened * np.sqrt(robust * (2 * beyond - robust)) / beyond


def assert_same(
    found: BatchSolution, expected: Reference, space: Any, error: float, path: float, points: float, cov: float
) -> None:
    """The same error and covariances up to fractions, of each matrix's largest entry, and the same places [m, rad]."""
    assert found.error == pytest.approx(expected.error, rel=error)
    assert np.abs(space.local(expected.world_from_body, found.world_from_body)).max() < path
    names = sorted(found.landmarks)
    np.testing.assert_allclose([found.landmarks[name] for name in names], expected.landmarks, atol=points)
    cov_landmarks = [found.cov_landmarks[name] for name in names]
    for covs, others in ((found.cov_poses, expected.cov_poses), (cov_landmarks, expected.cov_landmarks)):
        for one, other in zip(covs, others, strict=True):
            np.testing.assert_allclose(one, other, rtol=cov, atol=cov * np.abs(other).max())


def wander(length: int, seed: int) -> Trajectory:
    """A trajectory far from the origin, with steps of about 0.3 m and 10 degrees."""
    rng = np.random.default_rng(seed)
    poses = [SE3.retract(SE3.identity(), rng.normal(scale=[1.0, 1.0, 1.0, 50.0, 50.0, 50.0]))]
    for step in rng.normal(scale=[0.1, 0.1, 0.1, 0.3, 0.1, 0.1], size=(length - 1, 6)):
        poses.append(SE3.retract(poses[-1], step))
    return Trajectory(1_400_000_000_000_000_000 + 100_000_000 * np.arange(length), np.array(poses))
