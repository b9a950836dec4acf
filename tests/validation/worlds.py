"""Small worlds with a tilted sensor, and their batch solution by SciPy in another parametrisation."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from rbpf import gaussian
from rbpf.lie import SE2, SE3, Array
from rbpf.sensors.readers.measurements import Kind, Measurements
from tests.validation.numeric import shrunk, slope_of

Index = NDArray[np.int64]

NAMES = np.array([41, 7, 1000, 12, 3, 26])
MOTION = {2: np.array([0.25, 0.5, 0.0]), 3: np.array([0.05, 0.1, 0.25, 0.5, 0.0, 0.0])}
MOUNT = {2: np.array([2.4, 0.3, -0.2]), 3: SE3.exp(np.array([0.2, 0.5, 2.4, 0.3, -0.2, 0.4]))}


def world(
    dim: int, kind: Kind, singular: bool = False, steps: int = 7, noise: float = 1.0, seed: int = 0
) -> Measurements:
    """A drive of half a metre per step among six landmarks, seen by a sensor that looks back and down.

    Bearings cross ±π. With `singular` one direction of motion, not along an axis, is without noise; `noise`
    multiplies all standard deviations.
    """
    rng = np.random.default_rng(seed)
    m, path = _drive(dim, kind, singular, steps, noise, rng)
    points = m.space.translation(path).mean(0) + rng.normal(scale=3.0, size=(len(NAMES), dim))
    at, which = (x.ravel() for x in np.indices((steps, len(NAMES))))
    kept = np.sort(rng.permutation(len(at))[: 4 * len(at) // 5])
    factor = noise * (np.tril(rng.normal(scale=0.02, size=(len(kept), dim, dim))) + 0.03 * np.eye(dim))
    errors = np.einsum("kij,kj->ki", factor, rng.normal(size=(len(kept), dim)))
    z = m.model().predict(path[at[kept]], points[which[kept]]) + errors
    return seen(m, at[kept], NAMES[which[kept]], z, factor @ factor.mT)


def _drive(
    dim: int, kind: Kind, singular: bool, steps: int, noise: float, rng: np.random.Generator
) -> tuple[Measurements, Array]:
    space, d = (SE2, 3) if dim == 2 else (SE3, 6)
    std = np.full(d, 0.03 * noise)
    std[-1] = 0.0 if singular else 0.02 * noise
    turned = space.adjoint(space.exp(0.5 * MOTION[dim]))
    path, deltas = [space.exp(np.linspace(-0.4, 0.9, d))], []
    for slip in rng.normal(size=(steps - 1, d)) * std @ turned.T:
        deltas.append(space.exp(MOTION[dim] * rng.uniform(0.6, 1.4)))
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
    """Optimum and covariances as in a `BatchSolution`, landmarks in the order of their names.

    The log-evidence is Laplace's, with a flat prior of the landmarks.
    """

    world_from_robot: Array
    landmarks: Array
    cov_poses: Array
    cov_landmarks: Array
    error: float
    log_evidence: float


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
    optimum, path = found.x, path_of(found.x)
    slope = slope_of(residuals, optimum) if robust is None else found.jac
    cov = np.linalg.inv(slope.T @ slope)
    spread = slope_of(lambda x: m.space.local(path, path_of(x)).reshape(len(x), -1), optimum)
    spread = spread.reshape(len(path), m.space.dim, -1)
    blocks = cov[split:, split:].reshape(len(names), m.z.shape[1], len(names), -1)
    cov_landmarks = np.array([blocks[i, :, i] for i in range(len(names))])
    points = optimum[split:].reshape(len(names), -1)
    log_evidence = -found.cost + 0.5 * (np.linalg.slogdet(cov)[1] + points.size * np.log(2 * np.pi))
    log_evidence -= 0.5 * np.linalg.slogdet(2 * np.pi * m.cov_z)[1].sum()
    cost = float(found.cost)
    return Reference(path, points, spread @ cov @ spread.mT, cov_landmarks, cost, float(log_evidence))


def _thin_factor(cov: Array) -> Array:
    values, vectors = np.linalg.eigh(cov)
    kept = values > 1e-12 * values[-1]
    return vectors[:, kept] * np.sqrt(values[kept])
