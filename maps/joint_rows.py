"""The rows of a step of a joint map: linearised and stacked, what a Kalman update takes of them, and which are outliers.

Observations of one Gaussian are judged together, once for all particles, Mathematics (joint-outliers).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular
from scipy.linalg.blas import dsyrk

from rbpf import gaussian
from rbpf.core.linearisation import linearise
from rbpf.core.models import NEW, NULL, Jacobians, Likelihood, Observations, Part
from rbpf.core.particles import Information, weighted_mean
from rbpf.errors import InputError
from rbpf.kernels.dense import add_gram, congruent, mirror, product
from rbpf.maps.joint_columns import JointColumns
from rbpf.maps.rows import GAUSSIAN, linearised

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

    def factor(self) -> tuple[np.ndarray, np.ndarray]:
        """The `inliers`, and Cholesky's factor of their covariance."""
        inside = self.inliers()
        return inside, gaussian.cholesky(self.cov[np.ix_(inside, inside)]) if inside.size else np.zeros((0, 0))

    def moving(self, gain: np.ndarray, turn: np.ndarray) -> "Rows":
        """The same where all that is held moves with the state, by gain (n, d) times turn (N, d, d)."""
        return self._replace(by_state=self.by_state + through(self.slopes, gain[self.columns] @ turn))

    def information(self) -> Information:
        """What the rows say of the state."""
        inside, chol = self.factor()
        white = whitened(chol, np.concatenate([self.nu[..., None], self.by_state], axis=2)[:, inside])
        nu, by_state = white[..., 0], white[..., 1:]
        turned = np.swapaxes(by_state, 1, 2)
        total = Information.zeros(*by_state.shape[::2])
        total.info += turned @ by_state
        total.vector += (turned @ nu[..., None])[..., 0]
        total.quad += np.square(nu).sum(axis=1)
        total.log_factor += self.log_factor
        total.rows += inside.size
        is_density = np.ones(self.nu.shape[1], dtype=bool)
        for likelihood, own, log_odds in self.groups:
            count = int((log_odds >= 0.0).sum())
            total.log_factor += count * likelihood.log_inlier() + (len(own) - count) * likelihood.log_outlier()
            is_density[own] = likelihood.normalised
        total.log_det += log_det(chol[np.ix_(kept := is_density[inside], kept)])
        return total

    def update(self, cov: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """One gain for all particles: log p(z | x) (N,), by what the means move (N, n), and the covariance (n, n) after."""
        inside, chol = self.factor()
        nu = whitened(chol, self.nu[:, inside, None])[..., 0]
        total = self.log_factor - 0.5 * (np.square(nu).sum(axis=1) + log_det(chol))
        total += beyond_gaussian(self, inside, chol, nu)
        slope = through(self.slopes, cov[self.columns])[inside]
        half = solve_triangular(chol, slope, lower=True, check_finite=False) if inside.size else slope
        moves, after = multiplied(nu, half), plus_gram(cov, half, -1.0)
        fixed = self.considered
        if fixed.size:
            # Their mean over the particles stays, and so does their covariance, Mathematics (considered). Innovations that
            # are wider apart than they are uncertain would take more out of it than there is: they are off, not informative.
            moves[:, fixed] -= moves[:, fixed].mean(axis=0)
            values, vectors = np.linalg.eigh(spread_of(nu, np.full(len(nu), 1.0 / len(nu))))
            root = np.sqrt(np.clip(values, 0.0, 1.0))[:, None] * vectors.T @ half[:, fixed]
            at = np.ix_(fixed, fixed)
            after[at] = cov[at] - gaussian.symmetrise(root.T @ root)
        return total, moves, after


class Given(NamedTuple):
    """What a joint map holds, given states (N, E) in its frame: means (N, n) and a covariance (n, n)."""

    held: JointColumns
    origin: np.ndarray | None  #: (E,) G; None where nothing may be observed in the world.
    compiled: bool  #: use the models' fused kernels where they have one.
    state: np.ndarray
    mean: np.ndarray
    cov: np.ndarray

    def rows(self, groups: Sequence[Observations]) -> Rows:
        """Linearises all groups at the particles' own means; Jacobians by what is held are averaged over the particles."""
        held, state, mean = self.held, self.state, self.mean
        (n, d), space = (len(state), held.space.dim), held.space
        nus, by_states = [np.zeros((n, 0))], [np.zeros((n, 0, d))]
        noises, log_factor, parts = list[np.ndarray](), 0.0, list[Group]()
        considered, read = [np.zeros(0, dtype=np.int64)], list[tuple[np.ndarray, np.ndarray]]()
        for group in groups:
            model, z, noise, ids = group.model, group.z, group.cov, checked_ids(group)
            log_odds = np.full(len(z), np.inf) if group.log_odds is None else group.log_odds
            at, kind, landmarks, anchors, substate = state[:, None], None, None, None, None
            if ids is not None:
                log_factor += group.log_new * int((ids == NEW).sum()) + group.log_clutter * int((ids == NULL).sum())
                z, noise, log_odds, ids = z[ids >= 0], noise[ids >= 0], log_odds[ids >= 0], ids[ids >= 0]
                kind = held.of_one_kind(ids)
                landmarks = mean[:, kind.columns]
                anchors = held.poses(kind, mean) if kind.landmark.anchored else None
            if Part.SUBSTATE in model.reads:
                substate = mean[:, None, d : held.first]
            in_world = model.reads == frozenset({Part.STATE})
            if in_world:
                if self.origin is None:
                    name = type(model).__name__
                    raise InputError(f"{name} observes the pose in the world: sub-maps do not take that")
                at = space.compose(space.retract(self.origin, mean[:, :d]), state)[:, None]
            if landmarks is None or (substate is not None and model.about is None) or not self.compiled:
                nu, jac = linearise(model, space, z, at, landmarks, anchors, substate)
            else:
                nu, *found = linearised(model, space, z, state, landmarks, anchors, True)
                jac = Jacobians(*found)
                if substate is not None:
                    # By what all particles have in common: in the slope they differ in the second order.
                    centre = space.mean(state, np.full(n, 1.0 / n))
                    const = None if kind is None or anchors is None else held.poses(kind, mean.mean(axis=0))
                    by_substate = model.by_substate(centre, landmarks.mean(axis=0), const)
                    nu = nu - np.moveaxis(by_substate @ (substate[:, 0] - model.about).T, -1, 0)
                    jac = jac._replace(substate=by_substate[None])
            count, p = z.shape
            # What each observation reads of the Gaussian, and by what slope.
            used = [(np.zeros((count, 0), dtype=np.int64), np.zeros((count, p, 0)))]
            if kind is not None and jac.landmark is not None:
                slope = jac.landmark.mean(axis=0)
                used.append((kind.columns, slope))
                considered.append(
                    kind.columns[kind.landmark.considered(slope, diagonal_blocks(self.cov, kind.columns))]
                )
            if kind is not None and anchors is not None and jac.state is not None:
                # To move the clone is to move the state the other way: ∂h/∂C = −∂h/∂y Ad(y⁻¹ C), and C = K Exp(δ).
                turn = space.adjoint(space.between(state[:, None], anchors)) @ space.right_jacobian(
                    mean[:, kind.clones]
                )
                used.append((kind.clones, -(jac.state @ turn).mean(axis=0)))
            if jac.substate is not None:
                used.append((np.tile(np.arange(d, held.first), (count, 1)), jac.substate.mean(axis=0)))
            if in_world and jac.state is not None:
                # world_from_robot = G Exp(ξ) y moves by Ad(y⁻¹) J_r(ξ) dξ.
                turn = space.adjoint(space.inverse(state)) @ space.right_jacobian(mean[:, :d])
                used.append((np.tile(np.arange(d), (count, 1)), (jac.state @ turn[:, None]).mean(axis=0)))
            where, slopes = zip(*used, strict=True)
            read.append((np.concatenate(where, axis=1), np.concatenate(slopes, axis=2)))
            by_state = np.zeros((1, 1, 1, d)) if jac.state is None else jac.state
            nus.append(np.broadcast_to(nu, (n, count, p)).reshape(n, -1))
            by_states.append(np.broadcast_to(by_state, (n, count, p, d)).reshape(n, -1, d))
            first = sum(len(each) for each in noises)
            parts.append(Group(group.likelihood or GAUSSIAN, first + np.arange(count * p).reshape(count, p), log_odds))
            noises.extend(noise)
        columns = np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *(at.ravel() for at, _ in read)]))
        sparse = [(np.searchsorted(columns, at), slope) for at, slope in read]
        innovation = gaussian.symmetrise(through(sparse, through(sparse, self.cov[np.ix_(columns, columns)]).T))
        end = 0
        for noise in noises:
            rows = slice(end, end := end + noise.shape[0])
            innovation[rows, rows] += noise
        nu, by_state = np.concatenate(nus, axis=1), np.concatenate(by_states, axis=1)
        return Rows(nu, by_state, sparse, columns, innovation, parts, log_factor, np.unique(np.concatenate(considered)))


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
