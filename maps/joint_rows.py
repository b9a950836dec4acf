"""The rows of a step of a joint map, stacked: what a Kalman update needs, and which of them are outliers.

Observations of one Gaussian are judged together, once for all particles, Mathematics (joint-outliers).
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular
from scipy.linalg.blas import dsyrk

from rbpf import gaussian
from rbpf.core.models import Likelihood, Observations, Part
from rbpf.core.particles import weighted_mean
from rbpf.errors import InputError
from rbpf.kernels.dense import add_gram, congruent, mirror, product

QUICK = 30_000_000
"""Multiplications up to which a product is the same on any number of threads; BLAS is ten times as fast on larger ones."""
TINY = float(np.finfo(float).tiny)


class Group(NamedTuple):
    """Observations of a step that are weighed alike: their rows (K, p) among all, and the log-odds (K,) of an inlier."""

    likelihood: Likelihood
    rows: np.ndarray
    log_odds: np.ndarray


class Rows(NamedTuple):
    """All rows of a step: ν (N, R), H (N, R, d), and what all particles share: J (R, c) of columns (c,), S (R, R).

    J is sparse: an observation reads few columns, see `through`. `considered` are columns that the rows count with, but do
    not change.
    """

    nu: np.ndarray
    by_state: np.ndarray
    slopes: list[tuple[np.ndarray, np.ndarray]]
    columns: np.ndarray
    cov: np.ndarray
    groups: list[Group]
    log_factor: float
    considered: np.ndarray

    def inliers(self) -> np.ndarray:
        """The rows that update, those of the surest observations first."""
        if all(group.likelihood.kernel_id == 0 for group in self.groups):
            return np.arange(self.nu.shape[1])
        found = [(-odds, *rows) for _, *part in self.groups for rows, odds in zip(*part, strict=True) if odds >= 0.0]
        return np.array([row for _, *rows in sorted(found, key=lambda each: each[0]) for row in rows], dtype=np.int64)


def through(slopes: list[tuple[np.ndarray, np.ndarray]], matrix: np.ndarray) -> np.ndarray:
    """J (R, c) times (…, c, m): of each group which of the c an observation reads (K, q), and by what slope (K, p, q)."""
    *many, _, m = matrix.shape
    parts = [(slope @ matrix[..., at, :]).reshape(*many, slope.shape[0] * slope.shape[1], m) for at, slope in slopes]
    return np.concatenate([np.zeros((*many, 0, m)), *parts], axis=-2)


def checked_ids(group: Observations) -> np.ndarray | None:
    """Landmarks (K,) of a group, None where it reads none; refused where particles associate differently."""
    name, ids = type(group.model).__name__, group.ids
    if group.updates != frozenset({Part.STATE, Part.LANDMARK}):
        raise InputError(f"a joint map's observations update state and landmarks, {name}'s do not")
    if Part.LANDMARK not in group.model.reads:
        return None
    if ids is None or ids.shape != (group.z.shape[0],):
        shape = None if ids is None else ids.shape
        raise InputError(
            f"a joint map takes one association for all particles: {name} needs ids ({group.z.shape[0]},), got {shape}"
        )
    return ids


def log_det(chol: np.ndarray) -> float:
    """Log |2πS| of S = L Lᵀ."""
    return 2.0 * float(np.log(np.diagonal(chol)).sum()) + len(chol) * float(np.log(2.0 * np.pi))


def diagonal_blocks(matrix: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """The blocks (K, p, p) on the diagonal that belong to rows and columns (K, p)."""
    return matrix[rows[:, :, None], rows[:, None, :]]


def log_odds_of(nu: np.ndarray, cov: np.ndarray, groups: list[Group]) -> list[np.ndarray]:
    """Log-odds (K,) of every group's observations, each given all others that are inliers, of which no change of one adds.

    Begins with those that are inliers when seen alone; then the one that is most at odds with its place changes it.
    """
    alone = [likelihood.log_odds(nu[rows], diagonal_blocks(cov, rows)) for likelihood, rows, _ in groups]
    taken = [odds >= 0.0 for odds in alone]
    inside = np.concatenate([rows[took].ravel() for (_, rows, _), took in zip(groups, taken, strict=True)])
    given = _swept(np.concatenate([cov, nu[:, None]], axis=1), inside, False)
    for _ in range(2 * sum(len(each) for each in taken) + 1):
        found = []
        for (likelihood, rows, _), took in zip(groups, taken, strict=True):
            # An inlier is left out of what it is judged by: ν = Π⁻¹ (S⁻¹ν) with covariance Π⁻¹, Π its block of S⁻¹.
            own, spread = given[rows, -1], diagonal_blocks(given, rows)
            spread[took] = -np.linalg.inv(spread[took])
            own[took] = (spread[took] @ own[took][..., None])[..., 0]
            found.append(likelihood.log_odds(own, gaussian.symmetrise(spread)))
        amiss = [np.where(took, -odds, odds) for took, odds in zip(taken, found, strict=True)]
        worst = max(range(len(groups)), key=lambda g: amiss[g].max(initial=-np.inf))
        if not amiss[worst].max(initial=-np.inf) > 0.0:
            break
        which = amiss[worst].argmax()
        given = _swept(given, groups[worst].rows[which], bool(taken[worst][which]))
        taken[worst][which] ^= True
    return [
        np.where(took, np.maximum(odds, 0.0), np.minimum(odds, -TINY)) for took, odds in zip(taken, found, strict=True)
    ]


def _swept(given: np.ndarray, rows: np.ndarray, back: bool) -> np.ndarray:
    """[S | ν] (R, R + 1) swept by some rows k, or `back`: what is given all rows U that it is swept by.

    Then it has −S_UU⁻¹ in U, S_UU⁻¹ν beside it, and elsewhere covariance and innovation given U (J. Goodnight 1979).
    """
    inverse, sign = np.linalg.inv(given[np.ix_(rows, rows)]), -1.0 if back else 1.0
    gain, beside = given[:, rows] @ inverse, given[rows]
    given = given - gain @ beside
    given[rows], given[:, rows] = sign * (inverse @ beside), sign * gain
    given[np.ix_(rows, rows)] = -inverse
    return given


def beyond_gaussian(rows: Rows, inside: np.ndarray, chol: np.ndarray, white: np.ndarray) -> np.ndarray:
    """What likelihoods other than the Gaussian add to log N (N,) of the inliers, Mathematics (joint-outlier-weight).

    Each inlier's own log-density in place of the Gaussian, given the inliers before it; and each outlier's, given all inliers.
    """
    total, place = np.zeros(len(white)), np.empty(rows.nu.shape[1], dtype=np.int64)
    place[inside] = np.arange(inside.size)
    for likelihood, own, log_odds in rows.groups:
        if likelihood.kernel_id == 0:
            continue
        at = place[own[log_odds >= 0.0]]
        lower = diagonal_blocks(chol, at)
        nu, cov = (lower @ white[:, at][..., None])[..., 0], gaussian.gram(lower)
        total += (likelihood.log_density(nu, cov) - gaussian.log_density(nu, cov)).sum(axis=1)
        out = own[log_odds < 0.0]
        half = whitened(chol, rows.cov[np.ix_(inside, out.ravel())][None])[0]
        nu = (rows.nu[:, out.ravel()] - white @ half).reshape(len(white), *out.shape)
        explained = diagonal_blocks(half.T @ half, np.arange(out.size).reshape(out.shape))
        total += likelihood.log_density(nu, diagonal_blocks(rows.cov, out) - explained).sum(axis=1)
    return total


def whitened(chol: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """L⁻¹ of rows (N, R, k), with one L (R, R) for all."""
    n, count, k = rows.shape
    if not rows.size:
        return rows
    flat = rows.transpose(1, 0, 2).reshape(count, -1)
    solved = solve_triangular(chol, flat, lower=True, check_finite=False)
    return np.asarray(solved).reshape(count, n, k).transpose(1, 0, 2)


def multiplied(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Left (m, k) times right (k, n)."""
    if left.size * right.shape[1] > QUICK:
        return left @ right
    return np.asarray(product(np.ascontiguousarray(left), np.ascontiguousarray(right)))


def plus_gram(cov: np.ndarray, rows: np.ndarray, sign: float = 1.0) -> np.ndarray:
    """Cov (n, n) ± rowsᵀ rows, of rows (k, n); exactly symmetric, and of cov the lower triangle counts."""
    if rows.size * len(cov) > QUICK:
        out = dsyrk(sign, rows.T, beta=1.0, c=cov.T).T  # of the transposed, the upper triangle
    else:
        out = cov.copy()
        add_gram(out, np.ascontiguousarray(rows), sign)
    mirror(out)
    return np.asarray(out)


def turned(cov: np.ndarray, blocks: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """The lower triangle of T P Tᵀ; T is the identity but for blocks (K, m, m) on its diagonal, in rows (K, m) one by one."""
    first = np.concatenate([rows[:, 0] for rows, _ in blocks])
    size = np.concatenate([np.full(len(rows), rows.shape[1]) for rows, _ in blocks])
    padded, done = np.zeros((first.size, int(size.max()), int(size.max()))), 0
    for rows, each in blocks:
        padded[done : (done := done + len(rows)), : rows.shape[1], : rows.shape[1]] = each
    return np.asarray(congruent(cov, first, size, padded))


def spread_of(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Covariance (k, k) that weighted values (N, k) are a sample of: Σ W δδᵀ / (1 − ΣW²); of one particle, zero."""
    return plus_gram(np.zeros((values.shape[1],) * 2), apart(values, weights))


def apart(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """A factor (N, k) of `spread_of`, which is factorᵀ factor."""
    left = 1.0 - float(np.square(weights).sum())
    return np.sqrt(weights / left if left > 0.0 else 0.0 * weights)[:, None] * (values - weighted_mean(values, weights))
